"""A survey from its file to its figures, with or without Prefect, drawn on a console."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from mineloc.store.store import Store
from mineloc.survey.flow_process import run_flow
from mineloc.survey.local import run_local
from mineloc.survey.plan import Plan, plan_survey
from mineloc.survey.runner import PROCESSES, Runner
from mineloc.survey.screen import Screen, paths, summary_table
from mineloc.survey.spec import Survey, read_survey
from mineloc.survey.summary import summary


def run_survey(
    path: Path,
    console: Console,
    *,
    out: Path | None = None,
    overrides: Sequence[str] = (),
    local: bool = False,
    server: str | None = None,
    runner: Runner = PROCESSES,
) -> list[dict[str, Any]]:
    """Run what a survey file says; the figures of its runs.

    Args:
        console: where it is drawn: steps, the table of figures, what to open.
        out: where the results go, over the file's own word.
        overrides: `section.key=value`.
        local: without Prefect.
        server: a running Prefect server; None starts one for this run.
        runner: which workers; processes of this machine by default.

    Raises:
        MinelocError: the file is wrong, or of the first step that failed, when all that does not need it is done.
    """
    survey = read_survey(path, overrides, out=out)
    plan = plan_survey(survey)
    if not plan.state.exists():
        _refuse_unknown_methods(survey)
    with Screen(console, len(plan.steps)) as screen:
        if local:
            run_local(plan, screen, runner)
        else:
            screen.note(f"[dim]Prefect flow, {f'at {server}' if server else 'with a server of its own'}[/]")
            try:
                run_flow(path, plan, screen, runner, overrides=overrides, server=server)
            finally:
                _sweep(plan)
    rows = summary(plan)
    console.print(summary_table(rows))
    for line in paths(plan):
        console.print(line, highlight=False, soft_wrap=True, markup=False)
    return rows


def _refuse_unknown_methods(survey: Survey) -> None:
    """Before anything is done; later runs find what comes before localization done, and the stage itself says it."""
    from mineloc.localize.method import method_named

    for method in dict.fromkeys(name for flight in survey.flights for name in survey.methods_of(flight)):
        method_named(method)


def _sweep(plan: Plan) -> None:
    """A flow that was stopped in the middle of a stage had no time to tidy up."""
    if plan.store.exists():
        Store(plan.store).sweep()
