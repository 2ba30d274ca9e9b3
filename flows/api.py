"""Where Prefect's API is: at the address of a server that runs already, or at a server of our own."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

from flows.server import own_server
from flows.settings import answering, settings


@contextmanager
def prefect_api(server: str | None, home: Path) -> Generator[Callable[[], None]]:
    """Within: the environment names a server, the one at that address or one of our own with its history in `home`.

    Yields what waits until it answers; import what needs prefect within, for settings count at its import.

    Raises:
        SurveyError: nobody answers at the address.
    """
    os.environ.update(settings(None if server else home))
    if server:
        os.environ["PREFECT_API_URL"] = answering(server)
        yield lambda: None
        return
    with own_server(home) as ready:
        os.environ["PREFECT_API_URL"] = ready.address
        yield ready.wait
