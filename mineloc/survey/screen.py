"""A running survey on the terminal: a bar for the whole, one for every step at work, a line for every finished one."""

from __future__ import annotations

from types import TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from mineloc.survey.events import Event
from mineloc.survey.plan import Plan

FIGURES = {
    "coverage_percent": "cover %",
    "ape_rmse_m": "RMSE m",
    "ape_max_m": "max m",
    "ape_rmse_deg": "RMSE °",
    "kitti_percent": "KITTI %",
}
_MARKS = {"done": ("[green]✓[/]", ""), "known": ("[cyan]=[/]", " known"), "failed": ("[red]✗[/]", "")}


class Screen:
    """Listens to a survey and draws it on a console; on one that is no terminal, only the lines.

    Args:
        steps: how many there are.
    """

    def __init__(self, console: Console, steps: int) -> None:
        self._console = console
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            _Amount(),
            _Rate(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._whole = self._progress.add_task("[bold]survey[/]", total=steps, unit="steps")
        self._bars: dict[str, TaskID] = {}

    def __enter__(self) -> Screen:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def __call__(self, event: Event) -> None:
        """Draw what happened; called from any thread."""
        match event.state:
            case "started":
                self._bars[event.step] = self._progress.add_task(event.step, total=None, unit="")
            case "progress":
                self._progress.update(self._bars[event.step], completed=event.done, total=event.total, unit=event.unit)
            case "waiting":
                self._progress.update(
                    self._bars[event.step], description=f"{event.step} [dim](another process is at it)[/]"
                )
            case "done" | "known" | "failed":
                self._finish(event)

    def note(self, text: str) -> None:
        """A line of its own."""
        self._progress.console.print(text, highlight=False, soft_wrap=True)

    def _finish(self, event: Event) -> None:
        bar = self._bars.pop(event.step, None)
        if bar is not None:
            self._progress.remove_task(bar)
        self._progress.advance(self._whole)
        mark, what = _MARKS[event.state]
        told = f"[red]{event.line}[/]" if event.state == "failed" else f"[dim]{event.seconds:.1f} s{what}[/]"
        self.note(f"{mark} {event.step:<36} {told}")


class _Amount(ProgressColumn):
    def render(self, task: Task) -> Text:
        unit = str(task.fields["unit"])
        if not unit:
            return Text("")
        return Text(f"{task.completed:,.0f}{'' if task.total is None else f'/{task.total:,.0f}'} {unit}")


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        if not task.speed or not task.total or not task.fields["unit"] or task.fields["unit"] == "steps":
            return Text("")
        left = task.time_remaining
        return Text(f"{task.speed:.1f}/s{'' if left is None else f', {left:.0f} s left'}", style="dim")


def summary_table(rows: list[dict[str, Any]]) -> Table:
    """The runs' figures; unknown ones are a dash."""
    alignments = sorted({row["alignment"] for row in rows if row["alignment"]})
    table = Table(
        box=None,
        padding=(0, 2, 0, 0),
        header_style="bold",
        caption=f"position errors after alignment: {', '.join(alignments)}" if alignments else None,
        caption_justify="left",
    )
    for title in ("flight", "method", "poses"):
        table.add_column(title, overflow="fold")
    for title in FIGURES.values():
        table.add_column(title, justify="right", no_wrap=True)
    for row in rows:
        words = (row["flight"], row["method"], row["trajectory"], *(row[key] for key in FIGURES))
        table.add_row(*("–" if word is None else str(word) for word in words))
    return table


def paths(plan: Plan) -> list[str]:
    """What to open, line by line."""
    return [
        f"report      {plan.report}",
        *(f"recording   {run.recording}" for run in plan.runs),
        *(f"run         {run.folder}" for run in plan.runs),
    ]
