"""The figures of a run, from its facts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mineloc.data import F64
from mineloc.report.along import Band, Curve, curves
from mineloc.report.density import density
from mineloc.report.facts import RunFacts
from mineloc.report.marks import marks_of
from mineloc.report.plan import Colored, long_section, plan_view
from mineloc.stages.comparison import frame_of

_FLOWN = "distance flown (m)"


@dataclass(frozen=True, slots=True)
class RunFigures:
    """SVG text of one run.

    Attributes:
        plan, section: always there.
        along: error, or the claimed uncertainty without a reference; None when neither is known.
    """

    plan: str
    section: str
    along: str | None


def run_figures(facts: RunFacts, key: str, *, detail: float = 1.0) -> RunFigures:
    """Draw one run.

    Args:
        facts: what to draw.
        key: prefix of identifiers, unique on the page.
        detail: 1 for a page with one run, less for many.
    """
    run, smoothed = facts.run, facts.comparisons.get("smoothed")
    T_frame_map = frame_of(smoothed)
    estimate = (T_frame_map @ run.smoothed.poses)[:, :3, 3]
    reference = run.reference.positions_m if smoothed is not None and run.reference is not None else None
    return RunFigures(
        plan=plan_view(
            f"{key}-plan",
            background=density(run, T_frame_map, detail=detail),
            reference=reference,
            estimate=estimate,
            colored=_colored(facts),
            marks=marks_of(facts, T_frame_map),
            detail=detail,
        ),
        section=_section(facts, f"{key}-section", estimate[:, 2], detail),
        along=_along(facts, f"{key}-along", detail),
    )


def methods_figure(runs: Sequence[RunFacts], *, detail: float = 1.0) -> str | None:
    """The smoothed errors of several runs in one SVG, named by their letters; None below two."""
    lines = [
        Curve(facts.values["letter"], one.shown.path_m, one.shown.error_m)
        for facts in runs
        if (one := facts.comparisons.get("smoothed")) is not None
    ]
    if len(lines) < 2:
        return None
    alt = "Position error of the runs along the flight"
    return curves("methods", lines, bands=[], x_label=_FLOWN, y_label="position error (m)", alt=alt, detail=detail)


def _colored(facts: RunFacts) -> Colored | None:
    run, smoothed = facts.run, facts.comparisons.get("smoothed")
    if smoothed is not None:
        where = np.flatnonzero(np.isin(run.smoothed.stamps_ns, smoothed.shown.stamps_ns))
        return Colored(where, smoothed.shown.error_m, "position error (m)")
    known = run.keyframes.select("stamp_ns", "sigma_xy_m").drop_nulls()
    if known.is_empty():
        return None
    stamps, start = run.smoothed.stamps_ns, run.smoothed.stamps_ns[0]
    sigma = np.interp(stamps - start, known["stamp_ns"].to_numpy() - start, known["sigma_xy_m"].to_numpy())
    return Colored(np.arange(len(stamps)), sigma, "claimed uncertainty, horizontal 1σ (m)")


def _bands(facts: RunFacts) -> list[Band]:
    registration = facts.values["registration"]
    return [Band(one["from_m"], one["to_m"], "degenerate") for one in registration["degenerate"]] + [
        Band(one["from_m"], one["to_m"], "untrusted") for one in registration["untrusted"]
    ]


def _section(facts: RunFacts, key: str, estimate_z: F64, detail: float) -> str:
    smoothed = facts.comparisons.get("smoothed")
    if smoothed is None:
        way = facts.run.smoothed
        return long_section(
            key,
            along_m=way.path_m,
            smoothed_z=estimate_z,
            reference_z=None,
            bands=_bands(facts),
            x_label=_FLOWN,
            detail=detail,
        )
    compared = estimate_z[np.isin(facts.run.smoothed.stamps_ns, smoothed.shown.stamps_ns)]
    return long_section(
        key,
        along_m=smoothed.shown.path_m,
        smoothed_z=compared,
        reference_z=compared - smoothed.shown.offset_m[:, 2],
        bands=_bands(facts),
        x_label=_FLOWN,
        detail=detail,
    )


def _along(facts: RunFacts, key: str, detail: float) -> str | None:
    if facts.comparisons:
        lines = [Curve(name, one.shown.path_m, one.shown.error_m) for name, one in facts.comparisons.items()]
        alt = "Position error along the flight"
        y_label = "position error (m)"
        return curves(key, lines, bands=_bands(facts), x_label=_FLOWN, y_label=y_label, alt=alt, detail=detail)
    keyframes = facts.run.keyframes
    lines: list[Curve] = []
    for column, name in (("sigma_xy_m", "horizontal"), ("sigma_z_m", "vertical")):
        known = keyframes.select("stamp_ns", column).drop_nulls()
        if not known.is_empty():
            along = facts.way.metres(known["stamp_ns"].to_numpy())
            lines.append(Curve(name, along, known[column].to_numpy()))
    if not lines:
        return None
    alt, y_label = "Claimed uncertainty along the flight", "claimed uncertainty, 1σ (m)"
    return curves(key, lines, bands=_bands(facts), x_label=_FLOWN, y_label=y_label, alt=alt, detail=detail)
