"""Intersections in the plan: told apart by their shape, named where there is room."""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mineloc.data import F64
from mineloc.report.facts import RunFacts
from mineloc.report.svg import BLACK, ORANGE, VERMILION, name_token

Kind = Literal["recognised", "partly recognised", "missed", "not passed", "not recognised"]

_SIZE = 5.5
_FONT = 6.5
_NAME = 16  # letters at most
_GAP = 4.0
_EDGES: dict[Kind, dict[str, Any]] = {
    "not passed": {"marker": ".", "color": "#777777", "markersize": 4.0},
    "not recognised": {"marker": ".", "color": "#777777", "markersize": 4.0},
    "missed": {"marker": "D", "markerfacecolor": "white", "markeredgecolor": VERMILION, "markeredgewidth": 1.4},
    "partly recognised": {
        "marker": "D", "fillstyle": "left", "markerfacecolor": ORANGE, "markerfacecoloralt": "white",
        "markeredgecolor": BLACK, "markeredgewidth": 0.8,
    },
    "recognised": {"marker": "D", "markerfacecolor": ORANGE, "markeredgecolor": BLACK, "markeredgewidth": 0.8},
}  # fmt: skip
"""From what matters least to what matters most: later ones lie above."""


@dataclass(frozen=True, slots=True)
class Mark:
    """An intersection in the plan.

    Attributes:
        name: from outside.
        x_m, y_m: in the frame of the figure.
        kind: what became of it.
    """

    name: str
    x_m: float
    y_m: float
    kind: Kind


def marks_of(facts: RunFacts, T_frame_map: F64) -> list[Mark]:
    """The intersections that a run looked for; none when it was not found in the map.

    Args:
        facts: of the run.
        T_frame_map: (4, 4) from the run's map to the frame of the figure.
    """
    told, known = facts.values["recognitions"], facts.run.intersections()
    if told is None or told["places"] is None or known is None or not (facts.values["map"] or {"found": True})["found"]:
        return []
    outcomes: dict[int, set[str]] = {}
    for place in told["places"]:
        outcomes.setdefault(place["id"], set()).add(place["outcome"])
    points = known.select("x_m", "y_m", "z_m").to_numpy() @ T_frame_map[:3, :3].T + T_frame_map[:3, 3]
    return [
        Mark(name, x, y, _kind(outcomes.get(id, set()), is_scored=told["score"] is not None))
        for id, name, (x, y, _) in zip(known["id"].to_list(), known["name"].to_list(), points.tolist(), strict=True)
    ]


def paint_marks(figure: Figure, axes: Axes, marks: Sequence[Mark]) -> None:
    """Draw the marks, the important ones above and named first; a name that would touch another is left out.

    Names are drawn as `name_token` of the number of their mark.
    """
    for kind, look in _EDGES.items():
        xy = np.array([(one.x_m, one.y_m) for one in marks if one.kind == kind])
        if len(xy):
            style: dict[str, Any] = {"markersize": _SIZE, **look}
            axes.plot(xy[:, 0], xy[:, 1], linestyle="none", zorder=3.5, label=kind, **style)
    for number, xy, (dx, dy), side in _room(figure, axes, marks):
        label = axes.annotate(
            name_token(number), xy, xytext=(dx, dy), textcoords="offset points", ha=side, va="center", fontsize=_FONT,
            color="#222222" if marks[number].kind not in ("not passed", "not recognised") else "#666666", zorder=3.8,
        )  # fmt: skip
        label.set_in_layout(False)


def shown_name(name: str) -> str:
    """A name that fits into the plan: one line without control characters, cut where it is long."""
    text = " ".join("".join(c if c.isprintable() else " " for c in name).split())
    return text if len(text) <= _NAME else text[: _NAME - 1] + "…"


def _kind(outcomes: set[str], *, is_scored: bool) -> Kind:
    recognised = bool(outcomes & {"recognised", "wrong"})
    if "missed" in outcomes:
        return "partly recognised" if recognised else "missed"
    if recognised:
        return "recognised"
    return "not passed" if is_scored else "not recognised"


def _room(
    figure: Figure, axes: Axes, marks: Sequence[Mark]
) -> list[tuple[int, tuple[float, float], tuple[float, float], str]]:
    """(mark, its place, offset in points, alignment) of every name that finds room."""
    if not marks:
        return []
    figure.draw_without_rendering()  # only then it is known where the axes lie
    points = axes.transData.transform([(one.x_m, one.y_m) for one in marks]) * 72.0 / figure.dpi
    frame = np.array(axes.get_window_extent().extents) * 72.0 / figure.dpi
    half = _SIZE / 2 + 1.0
    taken = [np.array([x - half, y - half, x + half, y + half]) for x, y in points]
    order = {kind: rank for rank, kind in enumerate(reversed(_EDGES))}
    found: list[tuple[int, tuple[float, float], tuple[float, float], str]] = []
    for number in sorted(range(len(marks)), key=lambda k: (order[marks[k].kind], k)):
        width, x, y = _width(shown_name(marks[number].name)), *points[number]
        for dx, dy, side in ((5, 0, "left"), (-5, 0, "right"), (0, 7, "center"), (0, -7, "center"), (4, 6, "left"),
                             (-4, 6, "right"), (4, -6, "left"), (-4, -6, "right")):  # fmt: skip
            left = x + dx - {"left": 0.0, "center": width / 2, "right": width}[side]
            box = np.array([left, y + dy - _GAP, left + width, y + dy + _GAP])
            inside = box[0] > frame[0] and box[1] > frame[1] and box[2] < frame[2] and box[3] < frame[3]
            if inside and not any(_touch(box, other) for other in taken):
                taken.append(box)
                found.append((number, (marks[number].x_m, marks[number].y_m), (dx, dy), side))
                break
    return found


def _width(text: str) -> float:
    """In points, by the widest of the usual fonts: the reader's browser chooses its own."""
    return _FONT * sum(1.05 if unicodedata.east_asian_width(c) in "WF" else 0.68 for c in text)


def _touch(a: F64, b: F64) -> bool:
    return bool(a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3])
