"""The accuracy report: one HTML file that opens anywhere, and beside it the same numbers as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from mineloc import __version__
from mineloc.config import Config
from mineloc.errors import OutputError
from mineloc.output import new_file
from mineloc.progress import Progress, quiet
from mineloc.report.facts import RunFacts, run_facts
from mineloc.report.figures import RunFigures, methods_figure, run_figures
from mineloc.report.numbers import Numbers
from mineloc.stages.run_folder import RunFolder

SCHEMA = "mineloc.report/1"
MAX_BYTES = 1_000_000
_DETAILS = (1.0, 0.8, 0.6, 0.45, 0.35, 0.25, 0.15, 0.1)
_LEAST_BYTES = 70_000
"""A run's tables and figures with the least detail, about; so many runs that this cannot fit are not all drawn."""
_ROWS = 15
_PLACES, _FEWEST_PLACES = 60, 10
_ALIGNED = {"none": "nothing aligned", "origin": "first pose laid on first pose", "se3": "fitted as a whole"}


def write_report(
    runs: Sequence[Path],
    out: Path,
    *,
    config: Config,
    title: str | None = None,
    overwrite: bool = False,
    progress: Progress = quiet,
) -> Path:
    """Write `out` (HTML, below 1 MB, nothing outside of it is needed) and its JSON sidecar. Equal inputs, equal bytes.

    All runs stand in the table at its head; where they do not all fit, only the worst have sections of their own.

    Args:
        runs: run folders, one or several; several are compared side by side.
        out: `.html` to write; the sidecar has its name and `.json`.
        config: sections `evaluate` and `report`.
        title: heading; the configuration's when None.
        overwrite: replace both files.
        progress: told the runs that are done.

    Returns:
        `out`.

    Raises:
        FormatError: not a run folder.
        OutputError: a file exists or cannot be written; so many runs that the page would be too large.
        ValueError: no runs.
    """
    if not runs:
        raise ValueError("a report needs a run")
    sidecar = out.with_suffix(".json")
    if sidecar == out:
        raise OutputError(out, "is the name of the sidecar", expected="a name ending with .html", todo="rename --out")
    # The page is renamed into place only after the sidecar; a name that is taken is refused before the work.
    with new_file(out, overwrite=overwrite) as html, new_file(sidecar, overwrite=overwrite) as numbers:
        facts: list[RunFacts] = []
        for number, path in enumerate(runs):
            progress(number, len(runs), "runs")
            facts.append(run_facts(RunFolder.open(path), letter_of(number), config.evaluate))
        document = report_document(facts, title if title is not None else config.report.title, config)
        html.write_bytes(_page(facts, document, sidecar.name, where=out))
        text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
        numbers.write_text(text, encoding="utf-8")
    progress(len(runs), len(runs), "runs")
    return out


def report_document(facts: Sequence[RunFacts], title: str, config: Config) -> dict[str, Any]:
    """Everything that the page prints, as JSON values."""
    return {
        "schema": SCHEMA,
        "title": title,
        "mineloc_version": __version__,
        "configuration": {name: getattr(config, name).model_dump(mode="json") for name in ("evaluate", "report")},
        "runs": [one.values for one in facts],
    }


def letter_of(number: int) -> str:
    """A, B … Z, AA, AB …: names that fit into a figure."""
    letters = ""
    number += 1
    while number:
        number, rest = divmod(number - 1, 26)
        letters = chr(ord("A") + rest) + letters
    return letters


def _page(facts: Sequence[RunFacts], document: Mapping[str, Any], sidecar: str, *, where: Path) -> bytes:
    """The page with as much detail in its figures as fits; else with sections of the worst runs alone."""
    worst = sorted(range(len(facts)), key=lambda k: _badness(facts[k].values), reverse=True)
    count = min(len(facts), max(MAX_BYTES // _LEAST_BYTES, 1))
    size, drawn, fitting = 0, 0.0, 1.0 if count == len(facts) else _DETAILS[-1]
    figures: dict[int, RunFigures] = {}
    detail = _DETAILS[-1]

    def rendered(count: int) -> bytes:
        shown = sorted(worst[:count])
        together = methods_figure([facts[k] for k in shown], detail=detail)
        return _rendered(document, {k: figures[k] for k in shown}, together, sidecar).encode()

    for detail in _DETAILS:
        if detail > fitting:
            continue
        figures = {k: run_figures(facts[k], f"run{k}", detail=detail) for k in worst[:count]}
        page = rendered(count)
        before, size = size, len(page)
        if size <= MAX_BYTES:
            return page
        # in proportion at first, then on a line through both: no use in drawing what cannot fit
        a_detail = (before - size) / (drawn - detail) if drawn else size / detail
        fitting = max(detail - (size - MAX_BYTES) / a_detail, _DETAILS[-1]) if a_detail > 0 else _DETAILS[-1]
        drawn = detail
    while count > 1:
        count = max(min(count - 1, count * MAX_BYTES // size), 1)
        page = rendered(count)
        size = len(page)
        if size <= MAX_BYTES:
            return page
    raise OutputError(
        where,
        f"{len(facts)} runs make a page of {size / 1e6:.1f} MB",
        expected=f"at most {MAX_BYTES / 1e6:g} MB",
        todo="report fewer runs at once",
    )


def _badness(run: Mapping[str, Any]) -> tuple[bool, bool, float]:
    """Sorts runs: not found in the map, then without any error known, then by the largest error."""
    is_lost = bool(run["map"]) and not run["map"]["found"]
    if run["accuracy"] is None:
        return is_lost, True, 0.0
    ape = run["accuracy"]["smoothed"]["ape"][run["shown_alignment"]]
    return is_lost, False, float(ape["translation_m"]["max"])


def _rendered(document: Mapping[str, Any], figures: Mapping[int, RunFigures], methods: str | None, sidecar: str) -> str:
    environment = Environment(
        loader=PackageLoader("mineloc.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style = files("mineloc.report").joinpath("templates", "report.css").read_text(encoding="utf-8")
    return environment.get_template("report.html.j2").render(
        document=document,
        number=Numbers(document),
        longest=_longest,
        shown_places=partial(_shown_places, most=max(_PLACES // len(figures), _FEWEST_PLACES)),
        rep_count=max(len(run["accuracy"]["smoothed"]["rep"]) if run["accuracy"] else 0 for run in document["runs"]),
        aligned=_ALIGNED,
        sidecar=sidecar,
        style=Markup(style),
        # drawn by us; the only names from outside, those of intersections, are escaped there
        figures={k: {name: svg and Markup(svg) for name, svg in _named(one)} for k, one in figures.items()},
        methods_figure=methods and Markup(methods),
    )


def _named(figures: RunFigures) -> list[tuple[str, str | None]]:
    return [("plan", figures.plan), ("section", figures.section), ("along", figures.along)]


def _longest(stretches: Sequence[Mapping[str, Any]]) -> list[int]:
    """Indices of the longest in time, in the order of flight."""
    by_length = sorted(range(len(stretches)), key=lambda k: (-stretches[k]["duration_s"], k))
    return sorted(by_length[:_ROWS])


def _shown_places(places: Sequence[Mapping[str, Any]], *, most: int) -> list[int]:
    """Indices of what is worth a row first: wrong, missed, then recognised; in the order of flight."""
    urgency = {"wrong": 0, "missed": 1, "recognised": 2, "refused": 3}
    ranked = sorted(range(len(places)), key=lambda k: (urgency[places[k]["outcome"]], k))
    return sorted(ranked[:most])
