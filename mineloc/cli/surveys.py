"""Many flights through all stages."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mineloc.cli.options import (
    AddressOption,
    JsonOption,
    LocalOption,
    RunnerOption,
    ServerOption,
    SetOption,
    app,
    write_json,
)

if TYPE_CHECKING:
    from mineloc.survey.runner import Runner


@app.command()
def run(
    survey: Annotated[Path, typer.Argument(help="survey.toml: the flights and what is done with them.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the results, over the file's own word.")] = None,
    local: LocalOption = False,
    server: ServerOption = None,
    runner: RunnerOption = "process",
    address: AddressOption = None,
    as_json: JsonOption = False,
    overrides: SetOption = None,
) -> None:
    """All stages of all flights of a survey, each executed once; as one Prefect flow."""
    from mineloc.survey.runner import Runner

    on = Runner.named(runner, address)
    _survey(survey, out, local=local, server=server, as_json=as_json, overrides=overrides, runner=on)


@app.command()
def serve(
    survey: Annotated[Path, typer.Argument(help="survey.toml; with --watch it names a dataset.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the results, over the file's own word.")] = None,
    cron: Annotated[str | None, typer.Option("--cron", help="When it runs: five fields, '0 2 * * *' at two.")] = None,
    timezone: Annotated[str, typer.Option("--timezone", help="In which the fields are meant.")] = "UTC",
    watch: Annotated[Path | None, typer.Option("--watch", help="Inbox: what lands is added and processed.")] = None,
    every_s: Annotated[float, typer.Option("--every-s", help="The inbox is looked at so often.", min=0.1)] = 10.0,
    settle_s: Annotated[float, typer.Option("--settle-s", help="A recording that stood still so long.", min=0)] = 10.0,
    server: ServerOption = None,
    runner: RunnerOption = "process",
    address: AddressOption = None,
) -> None:
    """Reprocess a survey for good, at set times or when recordings land. E.g. serve mine.toml --watch INBOX/."""
    if cron is None and watch is None:
        raise typer.BadParameter("--cron, --watch or both")
    words = {
        "out": out, "cron": cron, "timezone": timezone, "watch": watch, "every-s": every_s, "settle-s": settle_s,
        "server": server, "runner": runner, "address": address,
    }  # fmt: skip
    given = [f"--{name}={value}" for name, value in words.items() if value is not None]
    # this process becomes the service, which knows Prefect: signals reach it, and nothing is left behind it
    os.execv(sys.executable, [sys.executable, "-P", "-m", "flows.serve", str(survey), *given])


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder of the results.")] = Path("demo"),
    local: LocalOption = False,
    server: ServerOption = None,
    as_json: JsonOption = False,
) -> None:
    """A mapping flight and an inspection through a built-in mine, from raw recording to accuracy report."""
    from mineloc.survey.demo import write_demo
    from mineloc.survey.runner import PROCESSES

    _survey(write_demo(out), out, local=local, server=server, as_json=as_json, overrides=None, runner=PROCESSES)


def _survey(
    survey: Path,
    out: Path | None,
    *,
    local: bool,
    server: str | None,
    as_json: bool,
    overrides: list[str] | None,
    runner: Runner,
) -> None:
    from rich.console import Console

    from mineloc.survey.run import run_survey

    if local and server is not None:
        raise typer.BadParameter("either --local or --server")
    console = Console(stderr=as_json, highlight=False)
    rows = run_survey(survey, console, out=out, overrides=overrides or (), local=local, server=server, runner=runner)
    if as_json:
        write_json(rows)
