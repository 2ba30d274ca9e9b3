"""Many flights through all stages."""

from __future__ import annotations

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
