"""Which of many contours one looks like, and under which turns: all of a database at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mineloc.config import IntersectionsConfig
from mineloc.data import F64, I64, Bool, WallContour
from mineloc.places.wall_contour import curve_where, kernel_table, peaks_of


class ContourMatch(NamedTuple):
    """One contour of the index under one turn.

    Attributes:
        row: of the contour in the index.
        similarity: in [0, 1].
        yaw_rad: turn that takes the seen contour's bearings to the known one's.
    """

    row: int
    similarity: float
    yaw_rad: float


class ContourIndex:
    """Contours, ready to be compared with one that is seen.

    Args:
        contours: all of one size.
        config: `contour_sigma_m`, `contour_known`, `branch_match_deg`, `peak_drop`.

    Raises:
        ValueError: contours of other sizes.
    """

    def __init__(self, contours: Sequence[WallContour], config: IntersectionsConfig) -> None:
        if len({(len(one.distance), one.radius_m) for one in contours}) > 1:
            raise ValueError("contours of other sizes")
        self._config = config
        self._size = (len(contours[0].distance), contours[0].radius_m) if contours else (0, 0.0)
        self._distance = np.array([one.distance for one in contours], np.float32).reshape(len(contours), self._size[0])
        self._sight = np.array([one.sight for one in contours], np.uint8).reshape(len(contours), self._size[0])
        self._branches = [one.branches_rad for one in contours]
        self._kernel = kernel_table(self._size[1], config)

    def __len__(self) -> int:
        return len(self._branches)

    def matches(self, seen: WallContour, among: I64 | None = None) -> list[ContourMatch]:
        """Turns of the contours under which branches fit and walls are most alike, the best first.

        Args:
            seen: of the same size.
            among: (k,) indices to look at; all without.

        Raises:
            ValueError: another size.
        """
        if not len(self):
            return []
        if (len(seen.distance), seen.radius_m) != self._size:
            raise ValueError("contours of other sizes")
        chosen = np.arange(len(self)) if among is None else among
        within = np.radians(self._config.branch_match_deg)
        fits = np.array([turns_that_fit(self._branches[k], seen.branches_rad, self._size[0], within) for k in chosen])
        fits = fits.reshape(len(chosen), self._size[0])
        found: list[ContourMatch] = []
        for k, fit in zip(chosen.tolist(), fits, strict=True):
            if not fit.any():
                continue
            # the turns beside those that fit too: a peak is told from its neighbours
            wanted = fit | np.roll(fit, 1) | np.roll(fit, -1)
            curve = curve_where(
                self._distance[k], self._sight[k], seen.distance, seen.sight, wanted, self._kernel,
                self._config.contour_known,
            )  # fmt: skip
            found += [ContourMatch(k, one.similarity, one.yaw_rad) for one in peaks_of(curve, fit, self._config)]
        return sorted(found, key=lambda one: -one.similarity)


def turns_that_fit(known_rad: F64, seen_rad: F64, bins: int, within_rad: float) -> Bool:
    """(bins,) the turns of the seen bearings under which `branches_fit`."""
    if abs(len(known_rad) - len(seen_rad)) > 1:
        return np.zeros(bins, np.bool_)
    turns = 2 * np.pi * np.arange(bins) / bins
    apart = known_rad[None, :, None] - seen_rad[None, None, :] - turns[:, None, None]
    near = np.abs((apart + np.pi) % (2 * np.pi) - np.pi) < within_rad
    few = 2 if len(known_rad) <= len(seen_rad) else 1
    return np.asarray(np.all(near.any(axis=few), axis=1))
