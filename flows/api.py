"""Where Prefect's API is: at the address of a server that runs already, or at a server of our own."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from flows.server import free_address, own_server
from flows.settings import answering, settings


@dataclass(frozen=True, slots=True)
class Api:
    """An address, which the environment must name before anything imports prefect: settings count at its import.

    Attributes:
        address: ends with `/api`.
        home: where a server of our own keeps its history; None: the server is there already.
    """

    address: str
    home: Path | None

    @classmethod
    def named(cls, server: str | None, home: Path) -> Self:
        """At that address, or on a free port of this machine.

        Raises:
            SurveyError: nobody answers at the address.
        """
        api = cls(answering(server), None) if server else cls(free_address(), home)
        os.environ.update({**settings(api.home), "PREFECT_API_URL": api.address})
        return api

    @contextmanager
    def running(self) -> Generator[Callable[[], None]]:
        """Within: the server is there. Yields what waits until it answers."""
        if self.home is None:
            yield lambda: None
            return
        with own_server(self.home, self.address) as starting:
            yield starting.wait
