"""The command line: arguments in, a stage called, errors printed on one line.

Heavy imports live inside the commands: `mineloc --help` must answer at once, and tells them in this order.
"""

from __future__ import annotations

import sys

from mineloc.cli import dataset_files as dataset_files
from mineloc.cli import datasets as datasets
from mineloc.cli import flights as flights
from mineloc.cli import maps as maps
from mineloc.cli import runs as runs
from mineloc.cli import surveys as surveys
from mineloc.cli import windows as windows
from mineloc.cli.options import app
from mineloc.errors import MinelocError

_INTERRUPTED = 130  # what typer makes of Ctrl-C


def main() -> None:
    """Entry point: exit code 0 done, 1 mineloc said no or was interrupted (one line), 2 usage."""
    try:
        app(standalone_mode=True)
    except MinelocError as error:
        sys.stderr.write(f"mineloc: {error}\n")
        raise SystemExit(1) from None
    except SystemExit as end:
        if end.code == _INTERRUPTED:
            sys.stderr.write("mineloc: interrupted; nothing half-written was left, run again to go on\n")
            raise SystemExit(1) from None
        raise
