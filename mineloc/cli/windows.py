"""What people look at."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mineloc.cli.options import ConfigOption, SetOption, app


@app.command()
def report(
    runs: Annotated[list[Path], typer.Argument(help="Run folders; several are set side by side.")],
    out: Annotated[Path, typer.Option("--out", help="The page to write (.html); the same numbers go to .json.")],
    title: Annotated[str | None, typer.Option("--title", help="Heading of the page.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing page.")] = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """The accuracy report: one HTML file that opens anywhere and prints to A4. E.g. report RUN/ --out report.html."""
    from mineloc.config import load_config
    from mineloc.report.page import write_report
    from mineloc.stages.progress_bar import progress_bar

    settings = load_config(config, overrides or ())
    with progress_bar("report") as progress:
        page = write_report(runs, out, config=settings, title=title, overwrite=overwrite, progress=progress)
    typer.echo(f"{page}\n{page.with_suffix('.json')}")


@app.command()
def view(
    what: Annotated[Path, typer.Argument(help="A run or map folder, a flight (.mcap), or a recording (.rrd).")],
    flight: Annotated[Path | None, typer.Option("--flight", help="The run's flight: its sweeps are shown.")] = None,
    database: Annotated[
        Path | None, typer.Option("--database", help="The run's database: why it recognised what it did.")
    ] = None,
    save: Annotated[Path | None, typer.Option("--save", help="Write the recording (.rrd), open no window.")] = None,
    screenshot: Annotated[Path | None, typer.Option("--screenshot", help="Write a picture (.png).")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """Look at a run or a flight in Rerun: mine, trajectories, sweeps, curves. E.g. view RUN/ --save run.rrd."""
    from mineloc.config import load_config
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.view.show import show

    settings = load_config(config, overrides or ())
    with progress_bar("view") as progress:
        written = show(
            what,
            flight=flight,
            database=database,
            save=save,
            picture=screenshot,
            overwrite=overwrite,
            config=settings,
            progress=progress,
        )
    for path in written:
        typer.echo(path)
