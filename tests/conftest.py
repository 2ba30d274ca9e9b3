"""Fixtures that several rooms' tests share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from synthetic_run import SyntheticRun, write_synthetic_run

RunMaker = Callable[[SyntheticRun], Path]


@pytest.fixture(scope="session")
def synthetic_run(tmp_path_factory: pytest.TempPathFactory) -> RunMaker:
    """Makes a run folder as described, once a session: do not write into it."""
    made: dict[SyntheticRun, Path] = {}

    def make(what: SyntheticRun) -> Path:
        if what not in made:
            made[what] = write_synthetic_run(tmp_path_factory.mktemp("synthetic") / "run", what)
        return made[what]

    return make
