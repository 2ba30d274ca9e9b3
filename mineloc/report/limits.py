"""What the numbers of a run do not say: told on the page, so that nobody reads more out of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mineloc.metrics.recognition import PASSED_M, WRONG_DEG, WRONG_M

_ALIGNED = {
    "none": "Nothing was aligned: estimate and reference share one frame.",
    "origin": "In figures and headline the first estimated pose is laid on the reference's; the error that grows from "
    "there is drift. An error of the first reference pose turns the whole flight.",
    "se3": "In figures and headline the whole estimate is fitted to the reference, which hides part of its error.",
}


def limits_of_validity(values: Mapping[str, Any], *, has_reference: bool) -> list[str]:
    """Sentences for one run, from its facts alone.

    Args:
        values: as `RunFacts.values`, without the limits.
        has_reference: whether the run brought one, comparable or not.
    """
    limits = _of_map(values)
    limits += _of_accuracy(values) if values["accuracy"] else _without_reference(values, has_reference=has_reference)
    registration = values["registration"]
    if registration["degenerate_share"] > 0:
        limits.append(
            f"In {_percent(registration['degenerate_share'])} of the sweeps one direction of translation was weakly "
            "observed (smooth, straight roadway): there the position along it rests on inertial data and the past."
        )
    if registration["trusted_share"] < 1:
        limits.append(
            f"In {_percent(1 - registration['trusted_share'])} of the sweeps the registration was refused and the "
            "pose rests on the motion prior alone."
        )
    limits.append(
        "The smoothed estimate uses the whole flight and is known after landing; the online estimate is what was "
        "known at each moment."
    )
    return limits + _of_data(values)


def _of_map(values: Mapping[str, Any]) -> list[str]:
    """What a map that the flight was given does not say of it."""
    known, recognitions = values["map"], values["recognitions"]
    if known is None:
        return []
    if not known["found"]:
        last = known["last_refusals"]
        why = f" The last keyframes were refused: {'; '.join(one['reason'] for one in last)}." if last else ""
        return [
            "The flight was not found in the map: its positions are in a frame of their own, which begins where the "
            "flight does. They say how it flew, not where in the mine. Which intersections it passed could not be "
            f"decided.{why}"
        ]
    return _of_start(known) + _of_recognitions(known, recognitions)


def _of_start(known: Mapping[str, Any]) -> list[str]:
    off_m = known["start_off_m"]
    if off_m is None:
        return []
    return [
        f"The flight was told to begin {off_m:.1f} m from where it did: the map contradicted that, and the flight was "
        "found anew by its intersections. Online positions before that are wrong."
    ]


def _of_recognitions(known: Mapping[str, Any], recognitions: Mapping[str, Any] | None) -> list[str]:
    if recognitions is None or recognitions["places"] is None:
        return []
    if recognitions["score"] is None:
        return [
            "Which intersections were passed is not known without a reference in the map: what was recognised was not "
            "confirmed, and what was missed is not counted."
        ]
    limits = [
        f"An intersection counts as passed when the reference comes within {PASSED_M:g} m of it, and a recognition as "
        f"wrong when its pose is off by more than {WRONG_M:g} m or {WRONG_DEG:g}°."
    ]
    if not known["is_grid"]:
        limits.append("The map does not stand in the mine grid: the reference is taken to be in the map's own frame.")
    return limits


def _of_accuracy(values: Mapping[str, Any]) -> list[str]:
    smoothed = values["accuracy"]["smoothed"]
    limits = [
        "Errors are distances between the body's estimated and reference position; they contain the reference's own "
        "error and any error of the clock.",
    ]
    limits.append(_ALIGNED[values["shown_alignment"]])
    if values["map"] and not values["map"]["found"]:
        limits.append("With nothing aligned, two frames are compared that have nothing to do with each other.")
    covered = smoothed["coverage"]["time"]
    if covered < 0.9995:
        limits.append(f"The scores speak of {_percent(covered)} of the reference's duration, not of the rest.")
    if any(rep["percent_of_path"] == 100 and rep["literal"] for rep in smoothed["rep"]):
        limits.append(
            "The relative error over the whole path counts every start in the first fifth of the flight, as its "
            "authors' toolbox does; the strict value is the one pair from first to last pose."
        )
    limits += [f"{note[0].upper()}{note[1:]}." for note in smoothed["notes"]]
    return limits


def _without_reference(values: Mapping[str, Any], *, has_reference: bool) -> list[str]:
    why = "The reference has no moment in common with the estimate" if has_reference else "There is no reference"
    limits = [f"{why}: the accuracy of this run is not known."]
    if values["uncertainty"]:
        limits.append(
            "The uncertainty shown is what the estimator claims of itself (one standard deviation); nothing here "
            "confirms it."
        )
    return limits


def _of_data(values: Mapping[str, Any]) -> list[str]:
    limits: list[str] = []
    if values["identity"]["source"] == "simulated":
        limits.append("The flight is simulated: walls, sensor noise and motion are models of a mine, not a mine.")
    health = values["health"]
    if health is None:
        limits.append(
            "Nothing is known of gaps, drops or damage of the recording: the flight was not ingested from one."
        )
    elif health.get("recovered"):
        limits.append("The flight was made from a damaged recording and may lack something.")
    limits.append(f"{_coordinates(values)} Speeds depend on the computer.")
    return limits


def _coordinates(values: Mapping[str, Any]) -> str:
    known = values["map"]
    if not known or not known["found"] or not known["is_grid"]:
        return "Coordinates are local metres; no mine grid or height datum is implied."
    x, y, z = (f"{value:.3f}".rstrip("0").rstrip(".") for value in known["grid_origin_m"])
    return (
        f"Coordinates of the figures are the map's: the mine grid less x {x} m, y {y} m, z {z} m. Those of the table "
        "of recognitions are in the mine grid."
    )


def _percent(share: float) -> str:
    text = f"{100 * share:.1f} %"
    # what is not nothing shall not read as nothing
    return "less than 0.1 %" if text == "0.0 %" else text
