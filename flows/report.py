"""Runs become what people look at."""

from __future__ import annotations

from prefect.artifacts import create_link_artifact

from flows.step import side_task, stage_task
from mineloc.survey.engine import Engine

record = stage_task("record")
report = stage_task("report")


@side_task("link", run_name="report link")
def link(work: Engine) -> None:
    """Leave a link to the report."""
    create_link_artifact(link=work.plan.report.absolute().as_uri(), key="report", link_text="Accuracy report")
