"""Scheduled reprocessing: `python -m flows.serve SURVEY.toml --out FOLDER`, which `mineloc serve` becomes.

A survey's flow runs at set times, and whenever recordings have landed in the inbox; one run at a time, until the
process is told to stop. What was interrupted goes on at the next run: what is done is in the store.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import threading
from pathlib import Path
from typing import cast

from flows.server import prefect_api
from mineloc.errors import MinelocError
from mineloc.survey.inbox import Inbox
from mineloc.survey.service import Service

log = logging.getLogger("mineloc.serve")


def main() -> int:
    """Serve until told to stop."""
    parser = argparse.ArgumentParser(prog="mineloc serve")
    parser.add_argument("survey", type=Path)
    parser.add_argument("--out", type=Path, required=True)
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
        inbox = None if given.watch is None else Inbox(given.watch, settle_s=given.settle_s)
        service = Service(given.survey, inbox)
        with prefect_api(given.server, given.out / ".mineloc" / "prefect") as wait:
            wait()
            _serve(given, service)
    except MinelocError as error:
        log.error("%s", error.line())
        return 1
    return 0


def _serve(given: argparse.Namespace, service: Service) -> None:
    from prefect import serve
    from prefect.deployments.runner import RunnerDeployment
    from prefect.schedules import Cron
    from prefect.types.entrypoint import EntrypointType

    from flows.survey import survey

    words = {"runner": given.runner, "address": given.address, "patient": True}
    deployment = survey.to_deployment(
        name=service.name,
        schedules=[Cron(given.cron, timezone=given.timezone)] if given.cron else [],
        parameters={"path": str(given.survey.absolute()), "out": str(given.out.absolute()), **words},
        entrypoint_type=EntrypointType.MODULE_PATH,
    )
    log.info("serving %s at %s", given.survey, os.environ["PREFECT_API_URL"].removesuffix("/api"))
    stop = threading.Event()
    watching = threading.Thread(target=_watch, args=(service, given.every_s, stop), daemon=True)
    watching.start()
    try:
        serve(cast("RunnerDeployment", deployment), limit=1, print_starting_message=False)
    finally:
        stop.set()


def _watch(service: Service, every_s: float, stop: threading.Event) -> None:
    """Look into the inbox from time to time; a share that is gone for a minute ends no service."""
    from prefect.deployments import run_deployment

    while not stop.is_set():
        try:
            if service.is_due():
                run_deployment(f"survey/{service.name}", timeout=0, as_subflow=False)
                log.info("a run of %s was asked for", service.name)
        except Exception:
            log.exception("the inbox could not be looked at; it is tried again")
        stop.wait(every_s)


if __name__ == "__main__":
    sys.exit(main())
