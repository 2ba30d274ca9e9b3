"""Scheduled reprocessing: `python -m flows.serve SURVEY.toml`, which `mineloc serve` becomes.

A survey's flow runs at set times, and whenever recordings have landed in the inbox; one run at a time, until the
process is told to stop. What was interrupted goes on at the next run: what is done is in the store.
"""

from __future__ import annotations

import argparse
import logging
import sys
import warnings
from pathlib import Path

from flows.api import Api
from mineloc.errors import MinelocError
from mineloc.survey.inbox import Inbox
from mineloc.survey.runner import Runner
from mineloc.survey.service import Service
from mineloc.survey.spec import out_of


def main() -> int:
    """Serve until told to stop."""
    parser = argparse.ArgumentParser(prog="mineloc serve")
    parser.add_argument("survey", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--cron")
    parser.add_argument("--timezone", default="UTC")
    parser.add_argument("--watch", type=Path)
    parser.add_argument("--every-s", type=float, default=10.0)
    parser.add_argument("--settle-s", type=float, default=10.0)
    parser.add_argument("--server")
    parser.add_argument("--runner", default="process")
    parser.add_argument("--address")
    given = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", stream=sys.stderr)
    logging.getLogger("httpx").setLevel(logging.WARNING)  # a line a request
    try:
        _serve(given)
    except MinelocError as error:
        sys.stderr.write(f"mineloc: {error}\n")
        return 1
    return 0


def _serve(given: argparse.Namespace) -> None:
    """Everything that can be wrong is looked at before anything starts or is written."""
    inbox = None if given.watch is None else Inbox(given.watch, settle_s=given.settle_s)
    service = Service(given.survey, inbox)
    runner = Runner.named(given.runner, given.address)
    out = out_of(given.survey, given.out)
    api = Api.named(given.server, out / ".mineloc" / "prefect")
    with warnings.catch_warnings():
        # the server makes it, if it comes to that
        warnings.filterwarnings("ignore", "Failed to create the Prefect home")
        from flows.deployment import Deployment
        from flows.schedule import schedule

    deployment = Deployment(service, given.survey, out, runner, schedule(given.cron, given.timezone))
    with api.running() as wait:
        wait()
        deployment.serve(every_s=given.every_s)


if __name__ == "__main__":
    sys.exit(main())
