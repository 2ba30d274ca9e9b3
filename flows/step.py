"""How a step of a survey becomes a Prefect task: the name tells whether the store knew the result already."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from prefect import Task, task
from prefect.cache_policies import NO_CACHE

from mineloc.store.store import Outcome
from mineloc.survey.engine import Engine
from mineloc.survey.plan import Step


def stage_task(name: str) -> Task[..., Outcome]:
    """The task of a stage. Prefect's own cache stays off: the store decides what runs."""
    # Prefect accepts a naming function of the parameters, but says so only to itself.
    naming = cast("Any", _run_name)
    return task(name=name, task_run_name=naming, cache_policy=NO_CACHE, persist_result=False)(_run)


def side_task(name: str, *, run_name: str) -> Callable[[Callable[..., None]], Task[..., None]]:
    """The task of something that is shown, not made: an artifact."""
    return task(name=name, task_run_name=run_name, cache_policy=NO_CACHE, persist_result=False)


def _run(work: Engine, step: Step, made: dict[str, Outcome]) -> Outcome:
    return work.run(step, made)


def _run_name(parameters: dict[str, Any]) -> str:
    work: Engine = parameters["work"]
    known = work.is_known(parameters["step"], parameters["made"])
    return f"{parameters['step'].name} [{'hit' if known else 'miss'}]"
