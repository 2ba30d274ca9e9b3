"""From voxels to a surface one point thick.

Range noise fills two or three voxels across a wall, and each holds a slice of it alone: their means stand off the wall
on either side. So the voxels of a column across the surface are joined to one point, the heaviest of them keeps its
place and the others go. Only then is a point's distance to the wall that of an average over all that was measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mineloc.compiled import njit, prange
from mineloc.data import F32, F64, I32, I64, Bool
from mineloc.mapping.voxel_moments import (
    COUNT,
    FIRST,
    NEAR_M2,
    NEAREST,
    REACH,
    SECOND,
    VISITS,
    WEIGHT,
    Voxels,
    unpack,
)

CHUNKS = 64
"""Fixed, so that a result does not depend on the number of threads."""
CAP = 4.0
"""A voxel weighs at most so much when a normal is fitted: scan lines must not outvote what lies between them."""
LEAST_AGREEMENT = 0.5
"""Cosine between the normals of voxels that belong to one surface."""
_STEP_X, _STEP_Y = 1 << 42, 1 << 21
BESIDE = np.array([dx * _STEP_X + dy * _STEP_Y for dx in (-1, 0, 1) for dy in (-1, 0, 1)], dtype=np.int64)
"""What to add to a packed key to come to the nine columns of voxels around it."""
_ACROSS = np.array([[_STEP_X], [_STEP_Y], [1]], dtype=np.int64) * np.array([-2, -1, 1, 2])


class ThinSurface(NamedTuple):
    """Points of the surface.

    Attributes:
        rows: (n,) the voxels that kept their place.
        points_m: (n, 3) float32 relative to the map's origin.
        normals: (n, 3) float32 unit normals towards where they were seen best from.
        counts: (n,) int32 measured points joined.
        visits: (n,) int32 visits that saw the voxel.
        thickness_m: (n,) float32 standard deviation across the surface.
        near_m: (n,) float32 least distance from which it was seen.
    """

    rows: I64
    points_m: F32
    normals: F32
    counts: I32
    visits: I32
    thickness_m: F32
    near_m: F32

    def take(self, rows: I64 | Bool) -> ThinSurface:
        """Only some points."""
        return ThinSurface(
            self.rows[rows],
            self.points_m[rows],
            self.normals[rows],
            self.counts[rows],
            self.visits[rows],
            self.thickness_m[rows],
            self.near_m[rows],
        )


def thin_surface(voxels: Voxels, sensors_m: F64, voxel_m: float) -> ThinSurface:
    """Join the voxels across the surface.

    Args:
        voxels: sorted by key.
        sensors_m: (k, 3) places of the visits, relative to the map's origin.
        voxel_m: edge.
    """
    normals = fit_normals(voxels.keys, voxels.moments, voxel_m)
    face_sensors(normals, voxels.keys, voxels.tallies, sensors_m, voxel_m)
    kept = np.zeros(len(normals), np.bool_)
    joined = join_across(voxels, normals, voxel_m, kept)
    rows = np.flatnonzero(kept)
    joined = joined[rows]
    return ThinSurface(
        rows,
        ((unpack(voxels.keys[rows]) + 0.5) * voxel_m + joined[:, :3]).astype(np.float32),
        normals[rows],
        np.rint(joined[:, 4]).astype(np.int32),
        voxels.tallies[rows, VISITS],
        joined[:, 3].copy(),
        np.sqrt(joined[:, 5]),
    )


@njit(cache=True, parallel=True)
def fit_normals(keys: I64, moments: F32, voxel_m: float) -> F32:
    """(n, 3) unit normals of the plane through each voxel and its 26 neighbours; (0, 0, 1) where there is none.

    Args:
        keys: (n,) sorted.
        moments: (n, 16) see `Voxels`.
        voxel_m: edge.
    """
    n = len(keys)
    out = np.empty((n, 3), np.float32)
    for chunk in prange(CHUNKS):
        begin, end = n * chunk // CHUNKS, n * (chunk + 1) // CHUNKS
        at = np.zeros(9, np.int64)
        if begin < end:
            for k in range(9):
                at[k] = np.searchsorted(keys, keys[begin] + BESIDE[k] - 1)
        sums = np.empty(10)
        for i in range(begin, end):
            sums[:] = 0.0
            for k in range(9):
                low = keys[i] + BESIDE[k] - 1
                j = at[k]
                while j < n and keys[j] < low:
                    j += 1
                at[k] = j
                while j < n and keys[j] <= low + 2:
                    _add_shifted(sums, moments[j], (k // 3 - 1) * voxel_m, (k % 3 - 1) * voxel_m,
                                 (keys[j] - low - 1) * voxel_m)  # fmt: skip
                    j += 1
            _normal(sums, out[i])
    return out


@njit(cache=True, parallel=True)
def face_sensors(normals: F32, keys: I64, tallies: I32, sensors: F64, voxel_m: float) -> None:
    """Turn (n, 3) normals to the side from which each voxel was seen from nearest."""
    part = (1 << 21) - 1
    for i in prange(len(keys)):
        sensor, key = sensors[tallies[i, NEAREST]], keys[i]
        x = sensor[0] - ((key >> 42) - REACH + 0.5) * voxel_m
        y = sensor[1] - (((key >> 21) & part) - REACH + 0.5) * voxel_m
        z = sensor[2] - ((key & part) - REACH + 0.5) * voxel_m
        if normals[i, 0] * x + normals[i, 1] * y + normals[i, 2] * z < 0:
            for k in range(3):
                normals[i, k] = -normals[i, k]


@njit(cache=True)
def _add_shifted(sums: F64, m: F32, x: float, y: float, z: float) -> None:
    """Add a voxel's moments, of weight `CAP` at most, seen from a centre from which its own lies at (x, y, z)."""
    w = np.float64(m[0])
    g = min(w, CAP) / w
    a, b, c = g * m[1], g * m[2], g * m[3]
    w *= g
    sums[0] += w
    sums[1] += a + w * x
    sums[2] += b + w * y
    sums[3] += c + w * z
    sums[4] += g * m[4] + 2 * a * x + w * x * x
    sums[5] += g * m[5] + a * y + b * x + w * x * y
    sums[6] += g * m[6] + a * z + c * x + w * x * z
    sums[7] += g * m[7] + 2 * b * y + w * y * y
    sums[8] += g * m[8] + b * z + c * y + w * y * z
    sums[9] += g * m[9] + 2 * c * z + w * z * z


@njit(cache=True)
def _normal(s: F64, out: F32) -> None:
    """The direction of least spread: smallest eigenvalue in closed form, then the largest of three cross products."""
    w = s[0]
    mx, my, mz = s[1] / w, s[2] / w, s[3] / w
    xx, xy, xz = s[4] / w - mx * mx, s[5] / w - mx * my, s[6] / w - mx * mz
    yy, yz, zz = s[7] / w - my * my, s[8] / w - my * mz, s[9] / w - mz * mz
    mean = (xx + yy + zz) / 3.0
    a, b, c = xx - mean, yy - mean, zz - mean
    p = np.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    out[0], out[1], out[2] = 0.0, 0.0, 1.0
    if p < 1e-9:
        return
    determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    cosine = min(1.0, max(-1.0, determinant / (2.0 * p * p * p)))
    least = 2.0 * p * np.cos(np.arccos(cosine) / 3.0 + 2.0 * np.pi / 3.0)
    a, b, c = a - least, b - least, c - least
    best = (1e-9 * p * p) ** 2
    for k in range(3):
        if k == 0:
            nx, ny, nz = xy * yz - xz * b, xz * xy - a * yz, a * b - xy * xy
        elif k == 1:
            nx, ny, nz = xy * c - xz * yz, xz * xz - a * c, a * yz - xy * xz
        else:
            nx, ny, nz = b * c - yz * yz, yz * xz - xy * c, xy * yz - b * xz
        squared = nx * nx + ny * ny + nz * nz
        if squared > best:
            best = squared
            length = np.sqrt(squared)
            out[0], out[1], out[2] = nx / length, ny / length, nz / length


@njit(cache=True, parallel=True)
def join_across(voxels: Voxels, normals: F32, voxel_m: float, kept: Bool) -> F32:
    """Join each voxel with up to two on either side along the axis that its normal is nearest to.

    Args:
        voxels: sorted by key.
        normals: (n, 3).
        voxel_m: edge.
        kept: (n,) written: no voxel of the column with a like normal is heavier.

    Returns:
        (n, 6) float32, valid where kept: offset of the joined point from the voxel's centre (3), standard deviation
        across the surface, points joined, squared least distance.
    """
    keys = voxels.keys
    n = len(keys)
    out = np.zeros((n, 6), np.float32)
    for chunk in prange(CHUNKS):
        begin, end = n * chunk // CHUNKS, n * (chunk + 1) // CHUNKS
        at = np.zeros((3, 4), np.int64)
        if begin < end:
            for axis in range(3):
                for k in range(4):
                    at[axis, k] = np.searchsorted(keys, keys[begin] + _ACROSS[axis, k])
        for i in range(begin, end):
            axis = _dominant(normals[i])
            for a in range(3):
                for k in range(4):
                    j = at[a, k]
                    while j < n and keys[j] < keys[i] + _ACROSS[a, k]:
                        j += 1
                    at[a, k] = j
            kept[i] = _join(voxels, normals, i, at[axis], axis, voxel_m, out[i])
    return out


@njit(cache=True)
def _dominant(normal: F32) -> int:
    x, y, z = abs(normal[0]), abs(normal[1]), abs(normal[2])
    if x >= y and x >= z:
        return 0
    return 1 if y >= z else 2


@njit(cache=True)
def _join(voxels: Voxels, normals: F32, i: int, at: I64, axis: int, voxel_m: float, out: F32) -> bool:
    """Join one voxel with those of its column that hold the same surface; False if one of them is heavier."""
    keys, moments, tallies = voxels
    normal, m = normals[i], moments[i]
    sums = np.zeros(3)
    _add_across(sums, m, normal, 0.0)
    count, near = tallies[i, COUNT], m[NEAR_M2]
    for k in range(4):
        j = at[k]
        if j >= len(keys) or keys[j] != keys[i] + _ACROSS[axis, k]:
            continue
        other = normals[j]
        if abs(normal[0] * other[0] + normal[1] * other[1] + normal[2] * other[2]) < LEAST_AGREEMENT:
            continue
        if moments[j, WEIGHT] > m[WEIGHT] or (moments[j, WEIGHT] == m[WEIGHT] and j < i):
            return False
        step = (k - 2) if k < 2 else (k - 1)
        _add_across(sums, moments[j], normal, step * voxel_m * normal[axis])
        count += tallies[j, COUNT]
        near = min(near, moments[j, NEAR_M2])
    w = np.float64(m[WEIGHT])
    mean = sums[1] / sums[0]
    own = (normal[0] * m[FIRST] + normal[1] * m[FIRST + 1] + normal[2] * m[FIRST + 2]) / w
    for k in range(3):
        out[k] = m[FIRST + k] / w + (mean - own) * normal[k]
    out[3] = np.sqrt(max(sums[2] / sums[0] - mean * mean, 0.0))
    out[4], out[5] = count, near
    return True


@njit(cache=True)
def _add_across(sums: F64, m: F32, normal: F32, shift: float) -> None:
    """Add Σw, Σw h, Σw h² of a voxel's offsets h along a normal; its centre lies at `shift`."""
    x, y, z = np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2])
    w = np.float64(m[0])
    first = x * m[1] + y * m[2] + z * m[3]
    s = SECOND
    second = x * x * m[s] + y * y * m[s + 3] + z * z * m[s + 5]
    second += 2.0 * (x * y * m[s + 1] + x * z * m[s + 2] + y * z * m[s + 4])
    sums[0] += w
    sums[1] += first + w * shift
    sums[2] += second + 2.0 * shift * first + w * shift * shift
