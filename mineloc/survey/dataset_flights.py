"""`dataset = "name@tag"` in a survey file: where the recordings of that version lie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mineloc.errors import ConfigError, StoreError
from mineloc.store.datasets import Datasets


@dataclass(frozen=True, slots=True)
class DatasetFlights:
    """The flights of a version.

    Attributes:
        store: the store that holds it.
        files: recording and sequence file (None: it has none) by flight.
    """

    store: Path
    files: dict[str, tuple[Path, Path | None]]


def dataset_flights(survey: Path, reference: str, store: str | None) -> DatasetFlights:
    """The flights of a dataset's version, ready to be read.

    Args:
        survey: the file that asks for them.
        reference: `name`, `name@latest`, `name@tag`, or `name@<beginning of an id>`.
        store: as written there, beside the file; None: the one that all commands take.

    Raises:
        ConfigError: no such store or version, or something of it is gone or damaged.
    """
    try:
        datasets = Datasets.open(None if store is None else survey.parent / store)
        version = datasets.get(reference)
        files = {one.flight: (datasets.path(one), datasets.sequence_path(one)) for one in version.recordings}
    except StoreError as error:
        where = f"{survey}: dataset {reference!r}: {error.where}"
        raise ConfigError(where, error.found, expected=error.expected, todo=error.todo) from error
    return DatasetFlights(datasets.store.root.absolute(), {name: _absolute(both) for name, both in files.items()})


def _absolute(both: tuple[Path, Path | None]) -> tuple[Path, Path | None]:
    recording, sequence = both
    return recording.absolute(), None if sequence is None else sequence.absolute()
