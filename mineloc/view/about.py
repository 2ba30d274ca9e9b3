"""The page of text beside the recording: what is seen, and the numbers that matter."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import fields
from typing import cast

from mineloc.data import F64, FlightInfo, IntersectionDatabase
from mineloc.stages.map_folder import MapFolder
from mineloc.view.scene import Scene

_SPECIAL = re.compile(r"([\\`*_{}\[\]()<>#+\-!|~&])")
_LEGEND = """
White: reference. Orange: online estimate, as known at that time. Coloured line: smoothed estimate, brighter where its
error is larger. Yellow: current sweep. Green: keyframes; their edges are vermilion where registration was degenerate.
"""

_MAP_LEGEND = """
Brown: floor. Grey: walls. Dark: roof (hide it to look inside). Yellow: roadways; orange: intersections; white: ends.
Blue: the flight. Green: loop closures.
"""

_DATABASE_LEGEND = """
Orange: invariant points. Yellow: branches. Green: walls of the contour. Blue: neighbours, as the crow
flies. Grey: clouds.
"""


def about_run(scene: Scene, origin_m: F64) -> str:
    """Markdown; names from outside are escaped."""
    run, manifest = scene.run, scene.run.manifest
    flight = manifest["flight"]
    lines = [
        f"# {escaped(flight['name'] or 'unnamed flight')}",
        "",
        f"Method **{escaped(manifest['method'])}**, front end **{escaped(manifest['front_end'])}**, "
        f"mineloc {escaped(manifest['mineloc_version'])}. "
        f"{len(run.sweeps)} sweeps, {len(run.keyframes)} keyframes, {run.smoothed.path_m[-1]:.1f} m.",
        "",
        *_errors(scene),
        "",
        _LEGEND.strip().replace("\n", " "),
    ]
    return "\n".join([*lines, *_subtracted(origin_m)])


def about_flight(info: FlightInfo, health: Mapping[str, object], *, placed_by: str, origin_m: F64) -> str:
    """Markdown of a flight: who, where, what ingest found."""
    facts = [(f.name.replace("_", " "), getattr(info, f.name)) for f in fields(info)]
    rows = [f"| {name} | {escaped(value)} |" for name, value in facts if value]
    found = cast("list[Mapping[str, object]]", health.get("findings", []))
    findings = [f"- {escaped(str(one['severity']))}: {escaped(str(one['detail']))}" for one in found]
    lines = [f"# {escaped(info.flight or 'unnamed flight')}", "", *(["| | |", "| --- | --- |", *rows] if rows else [])]
    lines += ["", f"Sweeps (yellow) are placed by {placed_by}.", "", *findings]
    return "\n".join([*lines, *_subtracted(origin_m)])


def about_map(survey: MapFolder, origin_m: F64) -> str:
    """Markdown of a map: where it comes from, how large and how sure it is."""
    manifest = survey.manifest
    numbers, loops, control = manifest["map"], manifest["loops"], manifest["control"]
    flights = "; ".join(f"{escaped(one['name'])}, {one['path_m']:.0f} m" for one in manifest["flights"])
    complete = numbers["complete_share"]
    lines = [
        "# Map",
        "",
        f"From {flights}. Front end **{escaped(manifest['front_end'])}**, "
        f"mineloc {escaped(manifest['mineloc_version'])}.",
        "",
        "| | |",
        "| --- | --- |",
        f"| points | {numbers['points']:,} |",
        f"| roadways | {numbers['roadways_m']:,.0f} m, {numbers['intersections']} intersections |",
        f"| complete | {'unknown' if complete is None else f'{complete:.0%}'} |",
        f"| loop closures | {loops['accepted']} accepted, {loops['refused']} refused |",
    ]
    weak_m = sum(one["degenerate_m"] for one in manifest["flights"])
    lines += [f"| weakly observed | {weak_m:,.0f} m of the way |"] if weak_m else []
    for role in ("control", "check"):
        summary = None if control is None else control[role]
        if summary is not None:
            lines.append(f"| {role} points | {summary['count']}, RMSE {summary['rmse_3d_m']:.3f} m |")
    lines += ["", _MAP_LEGEND.strip().replace("\n", " ")]
    return "\n".join([*lines, *_subtracted(origin_m)])


def about_database(known: IntersectionDatabase, origin_m: F64) -> str:
    """Markdown of a database of intersections: a row each, in the order of the similarity pictures."""
    twins = ", ".join(f"{a} and {b}" for a, b in known.twins) or "none"
    maps = " and ".join(escaped(one[:12]) for one in known.lineage.maps)
    lines = [
        "# Intersections",
        "",
        f"Version {known.lineage.version}: {len(known)} of map {maps}. "
        f"Contours more alike than {known.contour_threshold:.2f} may be one place. Twins: {twins}.",
        "",
        "| row | id | name | kind | branches (°) | neighbours | quality |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row, one in enumerate(known.intersections):
        branches = " ".join(f"{math.degrees(b):.0f}" for b in one.contour.branches_rad)
        ways = ", ".join(f"{other} ({length_m:.0f} m)" for other, length_m in one.neighbours)
        lines.append(
            f"| {row} | {one.id} | {escaped(one.name)} | {one.kind} | {branches} | {ways} | {one.quality:.0%} |"
        )
    lines += ["", _DATABASE_LEGEND.strip().replace("\n", " ")]
    return "\n".join([*lines, *_subtracted(origin_m)])


def escaped(text: str) -> str:
    """Text that markdown shows as it is, on one line."""
    return _SPECIAL.sub(r"\\\1", " ".join(str(text).split()))


def _errors(scene: Scene) -> list[str]:
    if not scene.comparisons:
        return ["No reference: the curves show the standard deviation that the estimate claims for itself."]
    rows = ["| estimate | RMSE (m) | max (m) | end error (m) | covered |", "| --- | --- | --- | --- | --- |"]
    for name, one in scene.comparisons.items():
        translation = one.shown.translation_m
        rows.append(
            f"| {name} | {translation.rmse:.3f} | {translation.max:.3f} "
            f"| {one.drift.end_error_m:.3f} | {100 * one.scores.coverage.time:.1f} % |"
        )
    return [*rows, "", f"Alignment: {next(iter(scene.comparisons.values())).shown.alignment}."]


def _subtracted(origin_m: F64) -> list[str]:
    if not origin_m.any():
        return []
    x, y, z = origin_m.tolist()
    return ["", f"Subtracted from all coordinates: x {x:.0f} m, y {y:.0f} m, z {z:.0f} m."]
