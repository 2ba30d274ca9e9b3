"""The mine from above and from the side, with the flight in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from mineloc.data import F64, I64, Bool
from mineloc.report.along import Band, shade
from mineloc.report.density import Density
from mineloc.report.marks import Mark, paint_marks, shown_name
from mineloc.report.svg import BLACK, BLUE, COLUMNS, WIDTH_IN, draw, error_colors, keep_peaks

_MAX_VERTICES = 2000
_LEVELS = 16
_NEARLY_ALL = 0.99


@dataclass(frozen=True, slots=True, eq=False)
class Colored:
    """The part of the estimate for which a number is known.

    Attributes:
        where: (n,) indices into the estimate, rising; a line is not drawn across what is left out.
        value: (n,) what colours it.
        label: what it is, with its unit.
    """

    where: I64
    value: F64
    label: str


def plan_view(
    key: str,
    *,
    background: Density | None,
    reference: F64 | None,
    estimate: F64,
    colored: Colored | None,
    marks: Sequence[Mark] = (),
    detail: float = 1.0,
) -> str:
    """SVG of the flight over the mine, equal aspect.

    Args:
        key: prefix of identifiers.
        background: the points of the mine.
        reference: (n, 3) positions, drawn thin and black.
        estimate: (m, 3) positions.
        colored: what colours the estimate; None for one colour.
        marks: intersections.
        detail: as of `density`.
    """
    x0, x1, y0, y1 = _bounds(background, reference, estimate)
    height = float(np.clip(5.6 * (y1 - y0) / (x1 - x0) + 0.75, 2.0, 6.7))

    def paint(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.set_aspect("equal")
        axes.set_xlim(x0, x1)
        axes.set_ylim(y0, y1)
        if background is not None:
            _paint_density(axes, background)
        if reference is not None:
            thin = reference[_spread(len(reference), detail)]
            axes.plot(thin[:, 0], thin[:, 1], color=BLACK, linewidth=0.5, label="reference")
        if colored is None or len(colored.where) < _NEARLY_ALL * len(estimate):
            thin = estimate[_spread(len(estimate), detail)]
            label = "estimate, smoothed" if colored is None else "estimate, not compared"
            axes.plot(thin[:, 0], thin[:, 1], color=BLUE, linewidth=1.2, label=label)
        if colored is not None:
            _paint_colored(figure, axes, estimate, colored, detail)
        axes.plot(*estimate[0, :2], "o", color=BLACK, markersize=4.5, markerfacecolor="white", label="start", zorder=4)
        axes.plot(*estimate[-1, :2], "s", color=BLACK, markersize=4, label="end", zorder=4)
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")
        _paint_scale(axes, x1 - x0)
        paint_marks(figure, axes, marks)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2)

    alt = "Plan view: the estimated trajectory over the points of the mine"
    names = [shown_name(one.name) for one in marks]
    return draw(key, (WIDTH_IN, height), paint, alt=alt, names=names)


def long_section(
    key: str,
    *,
    along_m: F64,
    smoothed_z: F64,
    reference_z: F64 | None,
    bands: list[Band],
    x_label: str,
    detail: float = 1.0,
) -> str:
    """SVG of the height along the way.

    Args:
        key: prefix of identifiers.
        along_m: (n,) metres flown.
        smoothed_z: (n,) estimated height.
        reference_z: (n,) reference height.
        bands: stretches to shade.
        x_label: of the horizontal axis.
        detail: as of `density`.
    """

    def paint(figure: Figure) -> None:
        axes = figure.add_subplot()
        shade(axes, bands)
        pick = keep_peaks(along_m, smoothed_z, columns=round(COLUMNS * detail))
        if reference_z is not None:
            chosen = keep_peaks(along_m, reference_z, columns=round(COLUMNS * detail))
            axes.plot(along_m[chosen], reference_z[chosen], color=BLACK, linewidth=2.2, alpha=0.35, label="reference")
        axes.plot(along_m[pick], smoothed_z[pick], color=BLUE, linewidth=1.0, label="estimate, smoothed")
        axes.set_xlabel(x_label)
        axes.set_ylabel("height z (m)")
        axes.margins(x=0.01, y=0.12)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2)

    return draw(key, (WIDTH_IN, 1.9), paint, alt="Long section: height along the metres flown")


def _bounds(background: Density | None, reference: F64 | None, estimate: F64) -> tuple[float, float, float, float]:
    corners = [estimate[:, :2].min(axis=0), estimate[:, :2].max(axis=0)]
    if reference is not None:
        corners += [reference[:, :2].min(axis=0), reference[:, :2].max(axis=0)]
    if background is not None:
        x0, x1, y0, y1 = background.extent_m
        corners += [np.array([x0, y0]), np.array([x1, y1])]
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    margin = max(0.02 * float((high - low).max()), 1.0)
    (x0, y0), (x1, y1) = (low - margin).tolist(), (high + margin).tolist()
    # a long straight roadway still gets a strip that can be looked at
    thin = 0.18 * max(x1 - x0, y1 - y0)
    dx, dy = max(thin - (x1 - x0), 0.0) / 2, max(thin - (y1 - y0), 0.0) / 2
    return x0 - dx, x1 + dx, y0 - dy, y1 + dy


def _spread(n: int, detail: float) -> I64:
    return np.unique(np.linspace(0, n - 1, min(n, round(_MAX_VERTICES * detail))).astype(np.int64))


def _paint_density(axes: Axes, density: Density) -> None:
    occupied = density.counts[density.counts > 0]
    full = max(float(np.percentile(occupied, 95)), 1.0)
    # few levels of grey: the picture says where the walls are, and the file stays small
    shade = np.ceil(np.clip(np.sqrt(density.counts / full), 0.0, 1.0) * 6.0) / 6.0
    rgba = np.full((*density.counts.shape, 4), 90, dtype=np.uint8)
    rgba[..., 3] = np.round(190.0 * shade).astype(np.uint8)
    axes.imshow(rgba, extent=density.extent_m, origin="lower", interpolation="none", aspect="equal", zorder=0.5)


def _paint_colored(figure: Figure, axes: Axes, estimate: F64, colored: Colored, detail: float) -> None:
    along = estimate[colored.where, :2]
    step = np.linalg.norm(np.diff(along, axis=0, prepend=along[:1]), axis=1)
    pick = keep_peaks(np.cumsum(step), colored.value, columns=round(_MAX_VERTICES / 2 * detail))
    xy, value = along[pick], colored.value[pick]
    skipped = (colored.where - np.arange(len(colored.where)))[pick]
    top = max(float(colored.value.max()), 1e-3)
    colors = error_colors(_LEVELS)
    level = np.minimum(np.maximum(value[:-1], value[1:]) / top * _LEVELS, _LEVELS - 1).astype(int)
    level[np.diff(skipped) > 0] = -1
    # one path a colour, the worst on top: few elements, and crisp in print
    for k in range(_LEVELS):
        pieces = _pieces(xy, level == k)
        if len(pieces):
            line = PathPatch(pieces, fill=False, edgecolor=colors(k), linewidth=2.2, capstyle="round", zorder=2.5)
            axes.add_patch(line)
    scale = ScalarMappable(Normalize(0.0, top), colors)
    bar = figure.colorbar(scale, cax=axes.inset_axes((1.02, 0.0, 0.025, 1.0)))
    bar.set_label(colored.label)
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]


def _pieces(xy: F64, chosen: Bool) -> Path:
    """The chosen segments of a polyline (n, 2), neighbours joined, as one path."""
    first = np.flatnonzero(chosen & ~np.concatenate([[False], chosen[:-1]]))
    last = np.flatnonzero(chosen & ~np.concatenate([chosen[1:], [False]])) + 1
    runs = [xy[a : b + 1] for a, b in zip(first, last, strict=True)]
    codes = [np.array([Path.MOVETO, *[Path.LINETO] * (len(run) - 1)], dtype=np.uint8) for run in runs]
    empty = np.zeros((0, 2)), np.zeros(0, np.uint8)
    return Path(np.concatenate([empty[0], *runs]), np.concatenate([empty[1], *codes]))


def _paint_scale(axes: Axes, width_m: float) -> None:
    """Above the plan, where no data is: a bar of a round length."""
    length = _round_length(0.2 * width_m)
    right = axes.get_xlim()[1]
    across = axes.get_xaxis_transform()
    axes.plot(
        [right - length, right], [1.03, 1.03], color=BLACK, linewidth=2.5, transform=across, clip_on=False,
        solid_capstyle="butt",
    )  # fmt: skip
    axes.annotate(
        f"{length:g} m",
        (right - length, 1.03),
        xycoords=across,
        xytext=(-5, 0),
        textcoords="offset points",
        ha="right",
        va="center",
        fontsize=7.5,
    )


def _round_length(limit_m: float) -> float:
    power = 10.0 ** np.floor(np.log10(limit_m))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= limit_m) * power)
