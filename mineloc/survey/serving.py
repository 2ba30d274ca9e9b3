"""From the command line to the service: this process becomes `python -m flows.serve`, which knows Prefect."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from mineloc.errors import ConfigError
from mineloc.output import one_line_errors
from mineloc.survey.inbox import Inbox
from mineloc.survey.runner import Runner
from mineloc.survey.service import Service
from mineloc.survey.spec import out_of

_FIELD = re.compile(r"[-0-9A-Za-z*,/#?]+")


def become_service(survey: Path, out: Path | None, words: Mapping[str, object]) -> None:
    """Check what can be checked before anything starts, then serve; returns to nobody.

    Args:
        words: options of `flows.serve` by name; None: not given.

    Raises:
        MinelocError: the survey, the schedule, the inbox or the runner is wrong.
    """
    cron, watch = words["cron"], words["watch"]
    if cron is not None:
        _check_schedule(str(cron), str(words["timezone"]))
    address = words["address"]
    Runner.named(str(words["runner"]), None if address is None else str(address))
    Service(survey, None if watch is None else Inbox(Path(str(watch))))
    folder = out_of(survey, out)
    with one_line_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    given = [f"--{name}={value}" for name, value in words.items() if value is not None]
    command = [sys.executable, "-P", "-m", "flows.serve", str(survey), "--out", str(folder), *given]
    os.execv(sys.executable, command)


def _check_schedule(cron: str, timezone: str) -> None:
    fields = cron.split()
    if len(fields) != 5 or not all(_FIELD.fullmatch(field) for field in fields):
        raise ConfigError(
            "--cron", repr(cron), expected="five fields: minute hour day month weekday", todo="e.g. '0 2 * * *'"
        )
    try:
        ZoneInfo(timezone)
    except (ZoneInfoNotFoundError, ValueError, OSError):
        raise ConfigError(
            "--timezone", repr(timezone), expected="a name like Europe/Warsaw", todo="correct it"
        ) from None
