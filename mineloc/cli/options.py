"""The application that commands are added to, and the options that several of them share."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    name="mineloc",
    help="Where a drone is in a mine: survey flights in, maps, localization and accuracy reports out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file of configuration keys.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="Override one key: section.key=value. Repeatable.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable results on stdout; all else on stderr.")]
LocalOption = Annotated[bool, typer.Option("--local", help="Without Prefect.")]
RunnerOption = Annotated[
    str, typer.Option("--runner", help="Where stages run: process (this machine) or dask (a cluster's workers).")
]
AddressOption = Annotated[
    str | None, typer.Option("--address", help="Of the Dask scheduler, tcp://host:8786; the machines share the folder.")
]
ServerOption = Annotated[str | None, typer.Option("--server", help="Address of a running Prefect server.")]


@app.callback()
def _root() -> None:  # pyright: ignore[reportUnusedFunction]  # typer keeps subcommands even if there is only one
    pass


def write_json(value: Mapping[str, Any] | Sequence[Any]) -> None:
    """What a command found, on standard output."""
    sys.stdout.write(json.dumps(value, indent=1, allow_nan=False) + "\n")
