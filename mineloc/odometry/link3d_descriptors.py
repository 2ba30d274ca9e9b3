"""LinK3D's descriptor of a keypoint: how far the others are, by direction (paper B, eq. 3-4; METHOD 2.3, D16)."""

from __future__ import annotations

import numpy as np

from mineloc.compiled import njit
from mineloc.config import Link3dConfig
from mineloc.data import F32, F64


def describe(keypoints_lidar: F64, config: Link3dConfig) -> F32:
    """(k, `descriptor_sectors`) distances in metres, 0 where no keypoint is; all 0 with too few keypoints.

    Dimension 0 is the main direction, towards a near keypoint; the others follow counter-clockwise, z up. One
    descriptor is built towards each of the nearest keypoints and the first that is not 0 counts, dimension by
    dimension. Distances are horizontal: the height of a centroid depends on the rings that met the edge.

    Args:
        keypoints_lidar: (k, 3).
        config: sectors, main directions, rounding.
    """
    if len(keypoints_lidar) < config.min_keypoints:
        return np.zeros((len(keypoints_lidar), config.descriptor_sectors), np.float32)
    return describe_all(
        keypoints_lidar[:, :2].copy(), config.descriptor_sectors, config.main_directions, config.distance_step_m
    )


@njit(cache=True, nogil=True)
def angle_between(x1: float, y1: float, x2: float, y2: float) -> float:
    """B(3) with B(4): counter-clockwise angle from (x1, y1) to (x2, y2) in [0, 2π).

    METHOD D16: on the line (D = 0) it is 0 or π, as the dot product says; a cosine beyond ±1 is clamped; the angle
    from or to a vector of length 0 is 0.
    """
    lengths = np.sqrt((x1 * x1 + y1 * y1) * (x2 * x2 + y2 * y2))
    dot = x1 * x2 + y1 * y2
    d = x1 * y2 - x2 * y1
    if lengths == 0.0:
        return 0.0
    if d == 0.0:
        return 0.0 if dot >= 0.0 else np.pi
    angle = np.arccos(min(max(dot / lengths, -1.0), 1.0))
    # an arccos of 0 has no other side
    return angle if d > 0.0 or angle == 0.0 else 2.0 * np.pi - angle


@njit(cache=True, nogil=True)
def sector_of(angle_rad: float, sectors: int) -> int:
    """Dimension of an angle in [0, 2π): sector s reaches half a sector to both sides of its direction."""
    return int(np.ceil(angle_rad * sectors / (2.0 * np.pi) - 0.5)) % sectors


@njit(cache=True, nogil=True)
def describe_all(xy: F64, sectors: int, directions: int, step_m: float) -> F32:
    """All descriptors of a sweep.

    Args:
        xy: (k, 2) keypoints.
        sectors: dimensions.
        directions: main directions, nearest first; of two equally near ones the lower index.
        step_m: distances are rounded to its multiples, to at least one.

    Returns:
        (k, sectors).
    """
    k = xy.shape[0]
    out = np.zeros((k, sectors), np.float32)
    distance = np.empty(k)
    one = np.empty(sectors)
    for i in range(k):
        for j in range(k):
            distance[j] = np.sqrt((xy[j, 0] - xy[i, 0]) ** 2 + (xy[j, 1] - xy[i, 1]) ** 2)
        distance[i] = np.inf
        # distinct neighbours, whatever their distances (the authors' code looks them up by distance and finds twins)
        nearest = np.argsort(distance, kind="mergesort")[: min(directions, k - 1)]
        for main in nearest:
            one[:] = np.inf
            for j in range(k):
                if j in (i, main):
                    continue
                angle = angle_between(
                    xy[main, 0] - xy[i, 0], xy[main, 1] - xy[i, 1], xy[j, 0] - xy[i, 0], xy[j, 1] - xy[i, 1]
                )
                sector = sector_of(angle, sectors)
                one[sector] = min(one[sector], distance[j])
            one[0] = distance[main]
            for s in range(sectors):
                if out[i, s] == 0.0 and one[s] < np.inf:
                    out[i, s] = max(np.round(one[s] / step_m), 1.0) * step_m
    return out


def describe_plainly(xy: F64, sectors: int, directions: int, step_m: float) -> F32:
    """`describe_all` in plain numpy, with one arctangent in place of B(3) and B(4)."""
    out = np.zeros((len(xy), sectors), np.float32)
    for i, own in enumerate(xy):
        off = xy - own
        distance = np.hypot(*off.T)
        distance[i] = np.inf
        rounded = np.maximum(np.round(distance / step_m), 1) * step_m
        bearing = np.arctan2(off[:, 1], off[:, 0])
        layers = []
        for main in np.argsort(distance, kind="stable")[: min(directions, len(xy) - 1)]:
            turn = (bearing - bearing[main]) % (2 * np.pi)
            sector = np.ceil(turn * sectors / (2 * np.pi) - 0.5).astype(int) % sectors
            layer = np.zeros(sectors)
            for j in np.argsort(-distance, kind="stable"):  # the nearest comes last and stays
                if j not in (i, main):
                    layer[sector[j]] = rounded[j]
            layer[0] = rounded[main]
            layers.append(layer)
        for layer in layers:
            out[i] = np.where(out[i] == 0, layer, out[i])
    return out
