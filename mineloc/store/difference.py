"""What changed from one version to another: flights, and the figures of the runs on them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import polars as pl

from mineloc.store.catalogue import METRICS, rebuild
from mineloc.store.dataset_reader import DatasetReader
from mineloc.store.versions import Recording, Version

ALL = "all flights"
_Key: TypeAlias = tuple[str, str, str, str]


@dataclass(frozen=True, slots=True)
class Delta:
    """A figure in both versions.

    Attributes:
        flight: of a flight with other content (by its newest run in each), or `all flights`: the mean over all flights
            of a version with such a run.
        method, trajectory, alignment: which runs and errors are compared.
        metric: a column of the catalogue, with its unit.
        before, after: the values.
    """

    flight: str
    method: str
    trajectory: str
    alignment: str
    metric: str
    before: float
    after: float

    @property
    def change(self) -> float:
        """After minus before."""
        return self.after - self.before


@dataclass(frozen=True, slots=True)
class Difference:
    """From version `before` to version `after`.

    Attributes:
        added, removed: recordings by flight.
        changed: flights with other content or another sequence file: the recording before and after.
        deltas: figures that differ.
    """

    before: Version
    after: Version
    added: tuple[Recording, ...]
    removed: tuple[Recording, ...]
    changed: tuple[tuple[Recording, Recording], ...]
    deltas: tuple[Delta, ...]


def difference(datasets: DatasetReader, before: str, after: str) -> Difference:
    """What changed between two versions, of one dataset or of two.

    Raises:
        StoreError: no such version, or something of the store is gone or damaged.
    """
    old, new = datasets.get(before), datasets.get(after)
    was, now = old.flights(), new.flights()
    changed = tuple((was[one], now[one]) for one in was if one in now and _content(was[one]) != _content(now[one]))
    runs = rebuild(datasets).runs
    return Difference(
        before=old,
        after=new,
        added=tuple(now[one] for one in now if one not in was),
        removed=tuple(was[one] for one in was if one not in now),
        changed=changed,
        deltas=tuple(_deltas(_newest(runs, old), _newest(runs, new), {one.flight for one, _ in changed})),
    )


def _content(one: Recording) -> tuple[str, str | None]:
    return one.sha256, one.sequence


def _newest(runs: pl.DataFrame, version: Version) -> dict[_Key, dict[str, Any]]:
    """The newest run by flight, method, trajectory and alignment."""
    rows = runs.filter((pl.col("version") == version.id) & pl.col("trajectory").is_not_null()).sort("utc", "run")
    return {
        (row["flight"], row["method"], row["trajectory"], row["alignment"]): row for row in rows.iter_rows(named=True)
    }


def _deltas(
    before: dict[_Key, dict[str, Any]], after: dict[_Key, dict[str, Any]], changed: set[str]
) -> Iterable[Delta]:
    kinds = sorted({key[1:4] for key in before} & {key[1:4] for key in after})
    for flight in (ALL, *sorted(changed)):
        for method, trajectory, alignment in kinds:
            kind = (method, trajectory, alignment)
            old, new = ([row for key, row in rows.items() if _is_of(key, flight, kind)] for rows in (before, after))
            for metric in METRICS:
                was, now = (_mean(row[metric] for row in rows) for rows in (old, new))
                if was is not None and now is not None and was != now:
                    yield Delta(flight, method, trajectory, alignment, metric, was, now)


def _is_of(key: _Key, flight: str, kind: tuple[str, str, str]) -> bool:
    return key[1:] == kind and flight in (ALL, key[0])


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
