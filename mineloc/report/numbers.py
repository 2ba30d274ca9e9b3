"""How numbers are written: with the digits that mean something, and with the exact value beside them for machines."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from markupsafe import Markup

NOTHING = "–"
_THIN = " "  # narrow no-break space between thousands


def metres(value: float) -> str:
    """Millimetres below 10 m, centimetres below 100 m, then decimetres."""
    size = abs(value)
    return grouped(value, 3 if size < 10 else 2 if size < 100 else 1)


def three_digits(value: float) -> str:
    """Three significant digits below 10, at most five decimals: 123.4, 12.3, 1.23, 0.0123, 0.00012."""
    size = abs(value)
    decimals = 1 if size >= 10 else 2 if size >= 1 or size == 0 else min(2 - math.floor(math.log10(size)), 5)
    return grouped(value, decimals)


def share(value: float) -> str:
    """A share in [0, 1] as percent. Neither end is reached by rounding."""
    percent = 100 * value
    if 0 < percent < 0.05:
        return "< 0.1 %"
    if 99.95 <= percent < 100:
        return "> 99.9 %"
    return f"{percent:.1f} %"


def grouped(value: float, decimals: int) -> str:
    """Fixed decimals, thousands apart."""
    text = f"{value:,.{decimals}f}".replace(",", _THIN)
    return text.replace("-", "−") if float(f"{value:.{decimals}f}") else text.replace("-", "")


WRITTEN: Mapping[str, Callable[[float], str]] = {
    "m": metres,
    "m0": lambda value: grouped(value, 0),
    "m1": lambda value: grouped(value, 1),
    "ratio": lambda value: grouped(value, 2),
    "deg": lambda value: grouped(value, 2),
    "percent": three_digits,
    "number": three_digits,
    "share": share,
    "s": lambda value: grouped(value, 1),
    "ms": lambda value: grouped(value, 1),
    "count": lambda value: grouped(value, 0),
    "one_in": lambda value: f"1 : {grouped(value, 0)}",
}


class Numbers:
    """Prints values of a document by their path, so that the page cannot say another number than the sidecar.

    Args:
        document: nested dicts and lists of JSON values.
    """

    def __init__(self, document: Mapping[str, Any]) -> None:
        self._document = document

    def value(self, path: str) -> Any:
        """The value at `runs.0.size.sweeps`; None where a step of the path is None.

        Raises:
            KeyError: no such path.
        """
        node: Any = self._document
        for step in path.split("."):
            if node is None:
                return None
            node = node[int(step)] if isinstance(node, list) else node[step]
        return node

    def __call__(self, path: str, kind: str) -> Markup:
        """`<data>` with the written number, its exact value and its path; a dash where it is not known."""
        value = self.value(path)
        if value is None:
            return Markup('<span class="none">{}</span>').format(NOTHING)
        return Markup('<data value="{}" data-path="{}" data-kind="{}">{}</data>').format(
            repr(value), path, kind, WRITTEN[kind](value)
        )
