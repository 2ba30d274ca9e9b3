"""Figures as SVG text: one style, no date, no random identifiers, so that equal numbers give equal bytes."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import escape
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.typing import RcKeyType

from mineloc.data import F64, I64

# Okabe and Ito (2008): told apart by the colour-blind, and in grey by the line styles that go with them.
BLACK, ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#000000",
    "#e69f00",
    "#56b4e9",
    "#009e73",
    "#f0e442",
    "#0072b2",
    "#d55e00",
    "#cc79a7",
)
SERIES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
DASHES = ("solid", (0, (5, 1.5)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5)))

WIDTH_IN = 7.1  # the text width of an A4 page
COLUMNS = 1000  # that a curve is thinned to: about 150 a printed inch

_STYLE: dict[RcKeyType, Any] = {
    # Text stays text: it can be searched and read aloud, and the reader's browser knows more scripts than one font.
    # DejaVu is the widest of the family, so a narrower substitute never overlaps.
    "svg.fonttype": "none",
    "svg.hashsalt": "mineloc",
    "font.family": ["DejaVu Sans"],
    "font.size": 8.0,
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": "#555555",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "lines.linewidth": 1.2,
    "path.simplify": True,
    "text.parse_math": False,
    "hatch.linewidth": 0.4,
}
_NO_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}
_LONG_NUMBER = re.compile(r"-?\d+\.\d{2,}")
_PATH_DATA = re.compile(r' d="([^"]*)"')
_AROUND_COMMAND = re.compile(r"\s*([MLCQZz])\s*")
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_BETWEEN_TAGS = re.compile(r">\s+<")
_MARKER = 400
_NAME = re.compile(r'style="([^"]*)"([^>]*)>@name(\d+)@<')
_HALO = "paint-order:stroke;stroke:#fff;stroke-width:1.6px;stroke-linejoin:round;"
_IDENTIFIER = re.compile(r'(\bid="|url\(#|href="#)')


def name_token(number: int) -> str:
    """What stands in a figure for a name from outside until `draw` has made an SVG of it."""
    return f"@name{number}@"


def draw(
    key: str, size_in: tuple[float, float], paint: Callable[[Figure], None], *, alt: str, names: Sequence[str] = ()
) -> str:
    """An inline `<svg>` element.

    Args:
        key: prefix of the identifiers in the figure, unique on the page.
        size_in: width and height.
        paint: draws into the figure.
        alt: what the figure shows, for those who cannot see it; plain text without user input.
        names: from outside, put in place of their `name_token`, escaped: neither our patterns nor the fonts see them.
    """
    buffer = io.StringIO()
    with mpl.rc_context():
        mpl.rcdefaults()  # a reader's own matplotlibrc shall not change the report
        mpl.rcParams.update(_STYLE)
        figure = Figure(figsize=size_in, layout="constrained")
        paint(figure)
        figure.savefig(buffer, format="svg", metadata=_NO_METADATA, transparent=True)
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = _IDENTIFIER.sub(lambda match: f"{match[1]}{key}-", _smaller(svg))
    # the page's style gives the size, the viewBox the shape
    head, rest = svg.split(">", 1)
    head = re.sub(r'\s(width|height)="[^"]*"', "", head)
    rest = _NAME.sub(
        lambda text: f'style="{_HALO}{text[1]}"{text[2]}>{escape(names[int(text[3])])}<', rest
    )  # readable over lines
    return f'{head} role="img" aria-label="{alt}">{rest}'.strip()


def _smaller(svg: str) -> str:
    """The same picture in half the bytes: no comments, no indentation, coordinates as fine as a printer resolves."""
    svg = _BETWEEN_TAGS.sub(">\n<", _COMMENT.sub("", svg))
    return _PATH_DATA.sub(lambda data: f' d="{_path_data(data[1])}"', svg)


def _path_data(data: str) -> str:
    # A figure is 511 points wide: a tenth is finer than a hair. Short paths are markers and keep their roundness.
    decimals = 1 if len(data) > _MARKER else 2
    data = _LONG_NUMBER.sub(lambda number: f"{float(number[0]):.{decimals}f}".rstrip("0").rstrip("."), data)
    return _AROUND_COMMAND.sub(r"\1", data).strip()


def error_colors(levels: int) -> Colormap:
    """Viridis in steps, dark for large, without its pale end: readable on white."""
    return ListedColormap(mpl.colormaps["viridis_r"](np.linspace(0.12, 1.0, levels)), name="error")


def keep_peaks(x: F64, y: F64, *, columns: int = COLUMNS) -> I64:
    """Indices that draw the curve y(x) as it looks with all points: the lowest and highest of each of `columns` bins.

    Args:
        x: (n,) not falling.
        y: (n,).
        columns: about the number of printed pixels; the result has at most `2 * columns + 2` indices.
    """
    n = len(x)
    if n <= 2 * columns:
        return np.arange(n, dtype=np.int64)
    edges = np.linspace(x[0], x[-1], columns + 1)
    bins = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, columns - 1)
    order = np.lexsort((y, bins))
    starts = np.flatnonzero(np.diff(bins[order], prepend=-1))
    ends = np.append(starts[1:], n) - 1
    return np.unique(np.concatenate([[0, n - 1], order[starts], order[ends]])).astype(np.int64)
