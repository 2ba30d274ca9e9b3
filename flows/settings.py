"""What is set so that Prefect stays private, quiet and offline, and where its API is."""

from __future__ import annotations

import urllib.error
import urllib.request
from pathlib import Path

from mineloc.errors import SurveyError

START_S = 120.0


def settings(home: Path | None) -> dict[str, str]:
    """Environment variables, to be set before prefect is imported; `home` None keeps the user's own."""
    return {
        "DO_NOT_TRACK": "1",
        "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
        "PREFECT_TELEMETRY_ENABLE_RESOURCE_METRICS": "false",
        "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
        "PREFECT_SERVER_ALLOW_EPHEMERAL_MODE": "false",
        "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": str(int(START_S)),
        "PREFECT_RESULTS_PERSIST_BY_DEFAULT": "false",
        "PREFECT_LOGGING_COLORS": "false",
        **({} if home is None else {"PREFECT_HOME": str(home)}),
    }


def answering(server: str) -> str:
    """The API address of a running server.

    Raises:
        SurveyError: nobody answers there.
    """
    address = server.rstrip("/")
    address = address if address.endswith("/api") or "/api/" in address else f"{address}/api"
    if not answers(address):
        raise SurveyError(
            server, "no Prefect server answers", expected="an address like http://host:4200", todo="or run with --local"
        )
    return address


def answers(address: str) -> bool:
    """Whether a server answers at an API address."""
    try:
        with urllib.request.urlopen(f"{address}/health", timeout=5) as reply:
            return reply.status == 200
    except (urllib.error.URLError, OSError, ValueError):
        return False
