"""Holes of a depth image from the LiDAR alone (METHOD 6.1: krige it where the variance passes a gate).

A camera is blind beside edges above all, and there two points of the LiDAR may lie on two surfaces. So a pixel is
filled only from points all around it that lie on one plane, as far as noise and the rock's relief allow, and what they
deviate from it counts as the variance of the field.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from mineloc.config import FusionConfig
from mineloc.data import F64, I64
from mineloc.mapping.depth_projection import Samples
from mineloc.mapping.kriging import krige_near

_NEIGHBOURS = 12
_QUADRANTS = 3
_CELL_PX = 4.0
_FREE = np.diag([1e2, 1.0, 1.0])


class Filled(NamedTuple):
    """What was filled.

    Attributes:
        chosen: (k,) of the pixels asked for.
        inverse_depth, variance: (k,).
    """

    chosen: I64
    inverse_depth: F64
    variance: F64


def fill_from_lidar(at: F64, lidar: Samples, noise: F64, config: FusionConfig) -> Filled:
    """Inverse depth at pixels without any, kriged from the points around each with a free plane.

    Args:
        at: (m, 2) pixels, from the principal point.
        lidar: points in the image.
        noise: (n,) variance of their inverse depth.
        config: `gap_px`, `edge_sigmas`.
    """
    lidar, noise = _spread_out(lidar, noise)
    nothing = Filled(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
    if len(lidar) < _NEIGHBOURS or not len(at):
        return nothing
    gap, near = KDTree(lidar.places_px).query(at, k=_NEIGHBOURS)
    rows = np.flatnonzero(np.asarray(gap)[:, -1] < config.gap_px)
    near = np.asarray(near, dtype=np.int64)[rows]
    bent = _deviation(at[rows], near, lidar)
    quiet = np.sqrt(noise[near].mean(axis=1))
    good = _surrounded(at[rows], near, lidar) & (bent < config.edge_sigmas * quiet)
    rows, near, bent = rows[good], near[good], bent[good]
    if not len(rows):
        return nothing
    value, variance = krige_near(
        lidar.places_px,
        lidar.inverse_depth,
        noise,
        at[rows],
        np.ascontiguousarray(near),
        sill=float(np.mean(bent**2)),
        range_=config.gap_px,
        mean=np.zeros(3),
        prior=_FREE,
    )
    around = lidar.inverse_depth[near]
    inside = (value >= around.min(axis=1)) & (value <= around.max(axis=1))
    return Filled(rows[inside], value[inside], (variance + bent**2)[inside])


def _spread_out(lidar: Samples, noise: F64) -> tuple[Samples, F64]:
    """One point a cell: else the nearest dozen all lie on one row and know nothing of what is above and below."""
    cell = np.floor(lidar.places_px / _CELL_PX).astype(np.int64)
    _, first = np.unique(cell[:, 0] * 100_000 + cell[:, 1], return_index=True)
    return lidar.keep(first), noise[first]


def _deviation(at: F64, near: I64, lidar: Samples) -> F64:
    """(m,) root mean square of the neighbours' inverse depth about their plane."""
    A = np.concatenate([np.ones((*near.shape, 1)), lidar.places_px[near] - at[:, None]], axis=2)
    w = lidar.inverse_depth[near]
    normal = np.einsum("mki,mkj->mij", A, A) + 1e-6 * np.eye(3)
    plane = np.linalg.solve(normal, np.einsum("mki,mk->mi", A, w)[:, :, None])[:, :, 0]
    rest = w - np.einsum("mki,mi->mk", A, plane)
    return np.sqrt((rest**2).sum(axis=1) / (near.shape[1] - 3))


def _surrounded(at: F64, near: I64, lidar: Samples) -> np.ndarray:
    """(m,) whether neighbours lie in at least three of the four quadrants around a pixel."""
    off = lidar.places_px[near] - at[:, None]
    quadrant = (off[:, :, 0] > 0) + 2 * (off[:, :, 1] > 0)
    return np.stack([(quadrant == q).any(axis=1) for q in range(4)], axis=1).sum(axis=1) >= _QUADRANTS
