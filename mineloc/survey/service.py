"""What a service that reprocesses a survey looks at: recordings that land become versions of the survey's dataset."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

from mineloc.errors import ConfigError, MinelocError, OutputError
from mineloc.store.datasets import Datasets
from mineloc.store.refs import LATEST, split_reference
from mineloc.survey.inbox import Inbox, Landed
from mineloc.survey.spec import read_spec, read_survey, slug

log = logging.getLogger("mineloc.serve")


class Service:
    """Says when a survey is to be run: at the start, for what was interrupted goes on then, and after each landing.

    Args:
        survey: the survey file.
        inbox: where recordings land; None: nothing is watched.
        clock: seconds that only go forward.

    Attributes:
        name: of the survey, in letters, digits and hyphens.

    Raises:
        ConfigError: the survey is wrong, or names no dataset that recordings could be added to.
        OutputError: there is no such inbox.
    """

    def __init__(self, survey: Path, inbox: Inbox | None, *, clock: Callable[[], float] = time.monotonic) -> None:
        spec = read_spec(survey)
        self.name = slug(survey.stem) or "survey"
        self._survey, self._inbox, self._clock = survey, inbox, clock
        self._dataset, self._store = "", None if spec.store is None else survey.parent / spec.store
        self._told: set[Path] = set()
        self._is_first = True
        if inbox is None:
            read_survey(survey)
            return
        if spec.dataset is None or split_reference(spec.dataset)[1] != LATEST:
            raise ConfigError(
                survey,
                f"dataset = {spec.dataset!r}" if spec.dataset else "no dataset",
                expected='dataset = "NAME@latest", to which what lands is added',
                todo="name one",
            )
        self._dataset = split_reference(spec.dataset)[0]

    def is_due(self) -> bool:
        """Take what landed since the last look; whether the survey is to be run because of that.

        Raises:
            MinelocError: the inbox or the store cannot be used just now; what landed is looked at again.
        """
        was_first, self._is_first = self._is_first, False
        if self._inbox is None:
            return was_first
        landed = self._inbox.complete(self._clock())
        for path, error in self._inbox.refused.items():
            if path not in self._told:
                self._told.add(path)
                log.warning("%s", error.line())
        # each on its own: one that is refused holds up no other
        brought = [self._brought(one) for one in landed]
        return any(brought) or (was_first and self._has_flights())

    def _brought(self, landed: Landed) -> bool:
        """Whether a recording is a new part of the dataset."""
        assert self._inbox is not None
        datasets = Datasets.open(self._store, create=True)
        before = datasets.refs.read(self._dataset)
        try:
            version = datasets.add(self._dataset, {landed.flight: landed.path}, note=f"{landed.path.name} landed")
        except OutputError:
            self._inbox.put_back(landed)
            raise
        except MinelocError as error:
            log.warning("%s: not added: %s", landed.path, error.line())
            return False
        if version.id == before:
            log.info("%s: known already", landed.path)
            return False
        log.info("%s: flight %s of %s@%s", landed.path, landed.flight, self._dataset, version.id[:12])
        return True

    def _has_flights(self) -> bool:
        try:
            return bool(Datasets.open(self._store).get(self._dataset).recordings)
        except MinelocError:
            return False
