"""Curves along the flight: error, uncertainty, methods beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from mineloc.data import F64, I64
from mineloc.report.svg import BLACK, COLUMNS, DASHES, ORANGE, SERIES, WIDTH_IN, draw, keep_peaks


@dataclass(frozen=True, slots=True)
class Band:
    """A stretch of the flight, in metres flown."""

    from_m: float
    to_m: float
    kind: Literal["degenerate", "untrusted"]


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """What metres flown are counted along.

    Attributes:
        stamps_ns: (n,) rising.
        path_m: (n,) metres flown.
    """

    stamps_ns: I64
    path_m: F64

    def metres(self, at_ns: I64 | int) -> F64:
        """Metres flown at a time or times, held at the ends."""
        start = self.stamps_ns[0]
        return np.interp(at_ns - start, self.stamps_ns - start, self.path_m)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A number along the flight: `y` (n,) at `along_m` (n,), not falling."""

    name: str
    along_m: F64
    y: F64


def curves(
    key: str,
    lines: Sequence[Curve],
    *,
    bands: Sequence[Band],
    x_label: str,
    y_label: str,
    alt: str,
    detail: float = 1.0,
) -> str:
    """SVG of curves over the metres flown, from zero, with stretches shaded."""

    def paint(figure: Figure) -> None:
        axes = figure.add_subplot()
        shade(axes, bands)
        for i, line in enumerate(lines):
            pick = keep_peaks(line.along_m, line.y, columns=round(COLUMNS * detail))
            axes.plot(
                line.along_m[pick],
                line.y[pick],
                label=line.name,
                color=SERIES[i % len(SERIES)],
                linestyle=DASHES[i % len(DASHES)],
                marker="o" if len(pick) == 1 else None,  # a line of one pose would be invisible
            )
        top = max((float(line.y.max()) for line in lines), default=0.0)
        axes.set_ylim(0.0, max(1.08 * top, 1e-3))
        axes.margins(x=0.01)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, borderaxespad=0.2)

    return draw(key, (WIDTH_IN, 2.5), paint, alt=alt)


def shade(axes: Axes, bands: Sequence[Band]) -> None:
    """Shade stretches over the whole height: degenerate ones orange, untrusted ones grey."""
    for kind, color, alpha in (("degenerate", ORANGE, 0.3), ("untrusted", BLACK, 0.45)):
        spans = np.array([(band.from_m, band.to_m) for band in bands if band.kind == kind])
        if len(spans):
            # one path for all of them: a figure with hundreds stays small
            corners = np.stack([spans[:, [0, 0, 1, 1, 0]], np.tile([0.0, 1.0, 1.0, 0.0, 0.0], (len(spans), 1))], axis=2)
            codes = np.tile([Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY], len(spans))
            outline = Path(corners.reshape(-1, 2), codes)
            # the line keeps a stretch visible that is shorter than a pixel
            axes.add_patch(
                PathPatch(
                    outline, color=color, alpha=alpha, linewidth=0.6, label=kind, transform=axes.get_xaxis_transform()
                )
            )
