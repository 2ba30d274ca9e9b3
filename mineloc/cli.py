"""The command line: arguments in, a stage called, errors printed on one line.

Heavy imports live inside the commands: `mineloc --help` must answer at once.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from mineloc.errors import MinelocError

app = typer.Typer(
    name="mineloc",
    help="Where a drone is in a mine: survey flights in, maps, localization and accuracy reports out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file of configuration keys.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="Override one key: section.key=value. Repeatable.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable results on stdout; all else on stderr.")]


@app.callback()
def _root() -> None:  # pyright: ignore[reportUnusedFunction]  # typer keeps subcommands even if there is only one
    pass


@app.command()
def evaluate(
    estimate: Annotated[str, typer.Argument(help="Run folder, TUM, KITTI or MCAP file (FILE.mcap:/topic).")],
    reference: Annotated[
        str | None, typer.Option("--reference", help="Flight, TUM, KITTI or MCAP file; a run may bring its own.")
    ] = None,
    align: Annotated[
        Literal["none", "origin", "posyaw", "se3"] | None,
        typer.Option("--align", help="One alignment; without it none, origin and se3 are shown."),
    ] = None,
    as_json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """How far an estimate is from a reference: APE, RPE, REP-k, KITTI, with the coverage."""
    from mineloc.config import load_config
    from mineloc.stages.evaluate import evaluate as run

    section = load_config(config, overrides or ()).evaluate
    evaluation = run(estimate, reference, align=align, config=section)
    if as_json:
        sys.stdout.write(json.dumps(evaluation.to_dict(), indent=1, allow_nan=False) + "\n")
        return
    from rich.console import Console

    from mineloc.stages.evaluation_table import heading, tables

    console = Console(highlight=False)
    for line in heading(evaluation):
        console.print(line, soft_wrap=True, markup=False)
    for table in tables(evaluation):
        console.print(table)


def main() -> None:
    """Entry point: exit code 0 done, 1 mineloc said no (one line), 2 usage, 130 interrupted."""
    try:
        app(standalone_mode=True)
    except MinelocError as error:
        sys.stderr.write(f"mineloc: {error}\n")
        raise SystemExit(1) from None
    except KeyboardInterrupt:
        sys.stderr.write("mineloc: interrupted; nothing half-written was left\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
