"""The evaluation of a run as a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from mineloc.config import Config
from mineloc.output import new_file
from mineloc.stages.evaluate import SCHEMA, evaluate
from mineloc.stages.run_folder import RunFolder


def score(run: Path, *, reference: Path | None = None, out: Path, config: Config) -> None:
    """Write the evaluation of a run folder as JSON; without any reference it holds no trajectories and says so.

    Args:
        reference: in place of the one that the run brings along.

    Raises:
        EvaluationError, FormatError: as `stages.evaluate`.
        OutputError: `out` cannot be written.
    """
    if reference is None and RunFolder.open(run).reference is None:
        found: dict[str, Any] = {
            "schema": SCHEMA,
            "estimate": run.name,
            "reference": "",
            "trusted_share": None,
            "notes": ["the flight has no reference"],
            "trajectories": [],
        }
    else:
        found = evaluate(run, reference, config=config.evaluate).to_dict()
    # Where the run lies is no part of what was found, and what is unknown is null.
    text = json.dumps(found).replace(f"{run}/", "").replace(str(run), run.name)
    known = json.loads(text, parse_constant=lambda _: None)
    with new_file(out) as temp:
        temp.write_text(json.dumps(known, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
