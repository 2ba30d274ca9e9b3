"""One long command on the terminal: a bar with its rate and the time left."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from mineloc import progress


@contextmanager
def progress_bar(what: str, *, console: Console | None = None) -> Generator[progress.Progress]:
    """A listener that draws a bar on stderr while the block lasts; nothing where stderr is no terminal.

    Args:
        what: the command, shown before the bar.
        console: where to draw instead of stderr.
    """
    console = console or Console(stderr=True)
    with RichProgress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=30),
        TaskProgressColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task(what, total=None, rate="")

        def listener(done: float, total: float | None, unit: str) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, total=total, rate=f"{speed:.0f} {unit}/s" if speed else "")

        yield listener
