"""Flights become runs, runs are compared with the reference."""

from __future__ import annotations

from prefect.artifacts import create_table_artifact

from flows.step import side_task, stage_task
from mineloc.survey.engine import Engine
from mineloc.survey.spec import slug
from mineloc.survey.summary import summary

localize = stage_task("localize")
evaluate = stage_task("evaluate")


@side_task("qa", run_name="{flight} qa")
def qa(work: Engine, flight: str) -> None:
    """Leave the figures of a flight's runs as a table."""
    create_table_artifact(
        table=summary(work.plan, flight=flight),
        key=f"qa-{slug(flight)}",
        description=f"Flight {flight}: every method's errors against the reference, and of how much of it they speak.",
    )
