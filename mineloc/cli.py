"""The command line: arguments in, a stage called, errors printed on one line.

Heavy imports live inside the commands: `mineloc --help` must answer at once.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

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
