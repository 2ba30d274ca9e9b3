"""The whole survey as one flow: one task a flight and stage, wired as the plan says."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from prefect import flow
from prefect.futures import PrefectFuture
from prefect.utilities.annotations import opaque

from flows.database import database
from flows.ingest import ingest, simulate
from flows.localize import evaluate, localize, qa
from flows.reconstruct import reconstruct
from flows.report import link, record, report
from mineloc.errors import MinelocError
from mineloc.survey.engine import engine
from mineloc.survey.events import Event
from mineloc.survey.plan import plan_survey
from mineloc.survey.runner import Runner
from mineloc.survey.spec import read_survey

TASKS = {task.name: task for task in (simulate, ingest, reconstruct, database, localize, evaluate, record, report)}


@flow(name="survey", persist_result=False, validate_parameters=False)
def survey(
    path: str,
    *,
    out: str,
    overrides: list[str] | None = None,
    events: int | None = None,
    runner: str = "process",
    address: str | None = None,
    patient: bool = False,
) -> None:
    """Run a survey file.

    Args:
        out: the survey's folder.
        overrides: `section.key=value`.
        events: file descriptor that takes events as lines of JSON.
        runner, address: which workers: "process", or "dask" and where its scheduler is.
        patient: wait for another run in the folder, left behind by a service that was killed.

    Raises:
        MinelocError: of the first step that failed, after everything that does not need it is done.
    """

    def tell(event: Event) -> None:
        if events is not None:
            os.write(events, event.to_line().encode())

    plan = plan_survey(read_survey(Path(path), overrides or (), out=Path(out)))
    futures: dict[str, PrefectFuture[Any]] = {}
    with engine(plan, tell, Runner.named(runner, address), patient=patient) as work:
        for step in plan.steps:
            made = {name: futures[name] for name in step.needs()}
            futures[step.name] = TASKS[step.stage.name].submit(work, opaque(step), made)
        for flight in dict.fromkeys(run.flight for run in plan.runs):
            scored = [futures[s.name] for s in plan.steps if s.flight == flight and s.stage.name == "evaluate"]
            futures[f"{flight} qa"] = qa.submit(work, flight, wait_for=scored)
        futures["link"] = link.submit(work, wait_for=[futures["report"]])
        errors = [error for future in futures.values() if (error := _error(future)) is not None]
    if errors:
        raise next((error for error in errors if isinstance(error, MinelocError)), errors[0])


def _error(future: PrefectFuture[Any]) -> BaseException | None:
    future.wait()
    if not future.state.is_failed():
        return None
    found = future.result(raise_on_failure=False)
    return found if isinstance(found, BaseException) else None
