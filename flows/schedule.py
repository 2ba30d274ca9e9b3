"""When a served flow runs by itself."""

from __future__ import annotations

from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from prefect.schedules import Cron, Schedule

from mineloc.errors import ConfigError


def schedule(cron: str | None, timezone: str) -> Schedule | None:
    """When the flow runs; None: only when it is asked for.

    Raises:
        ConfigError: no such times, or no such zone.
    """
    if cron is None:
        return None
    try:
        ZoneInfo(timezone)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise ConfigError("--timezone", repr(timezone), expected="like Europe/Warsaw", todo="correct it") from error
    try:
        return Cron(cron, timezone=timezone)
    except ValueError as error:
        raise ConfigError("--cron", repr(cron), expected="five fields, like '0 2 * * *'", todo="correct it") from error
