"""A survey's flow as a Prefect deployment: with a schedule, and run when its service says so."""

from __future__ import annotations

import logging
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from prefect import serve
from prefect.deployments import run_deployment
from prefect.deployments.runner import RunnerDeployment
from prefect.schedules import Schedule
from prefect.types.entrypoint import EntrypointType

from flows.survey import survey
from mineloc.survey.runner import Runner
from mineloc.survey.service import Service

log = logging.getLogger("mineloc.serve")


@dataclass(frozen=True, slots=True)
class Deployment:
    """What is served: `service` says when it is due beside the schedule, `out` is the survey's folder."""

    service: Service
    path: Path
    out: Path
    runner: Runner
    schedule: Schedule | None

    def serve(self, *, every_s: float) -> None:
        """Run the flow, once at a time, until this process is told to stop; ask the service so often."""
        words = {"runner": self.runner.kind, "address": self.runner.address, "patient": True}
        made = survey.to_deployment(
            name=self.service.name,
            schedules=[self.schedule] if self.schedule is not None else [],
            parameters={"path": str(self.path.absolute()), "out": str(self.out.absolute()), **words},
            entrypoint_type=EntrypointType.MODULE_PATH,
        )
        log.info("serving %s at %s", self.path, os.environ["PREFECT_API_URL"].removesuffix("/api"))
        stop = threading.Event()
        threading.Thread(target=self._watch, args=(every_s, stop), daemon=True).start()
        try:
            serve(cast("RunnerDeployment", made), limit=1, print_starting_message=False)
        finally:
            stop.set()

    def _watch(self, every_s: float, stop: threading.Event) -> None:
        """A share that is gone for a minute ends no service."""
        due = False
        while not stop.is_set():
            try:
                due = self.service.is_due() or due
                if due:
                    run_deployment(f"survey/{self.service.name}", timeout=0, as_subflow=False)
                    due = False
                    log.info("a run of %s was asked for", self.service.name)
            except Exception:
                log.exception("the inbox could not be looked at; it is tried again")
            stop.wait(every_s)
