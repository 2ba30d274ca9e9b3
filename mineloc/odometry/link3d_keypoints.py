"""LinK3D's aggregation keypoints: clusters of edge points over several rings (METHOD 2.2, 4.3).

The horizon is cut into sectors; points are clustered greedily inside their sector; clusters whose means are near are
one, so that a sector's border cuts nothing; the centroid of a cluster is a keypoint if enough rings agree. The traps of
the authors' code are avoided: no cluster merges with itself, none with two others, every point finds a cluster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mineloc.compiled import njit
from mineloc.config import Link3dConfig
from mineloc.data import F32, F64, I64, U16
from mineloc.odometry.link3d_edges import EdgePoints


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """The keypoints of a sweep and the edge points behind them.

    Attributes:
        points_lidar: (k, 3) float64 centroids.
        of_edge: (m,) the keypoint of every edge point, -1 without.
        sharpest: (e,) indices of edge points: the one of largest smoothness of every keypoint and ring, by keypoint,
            then ring.
    """

    points_lidar: F64
    of_edge: I64
    sharpest: I64

    def __len__(self) -> int:
        return len(self.points_lidar)


def azimuth_rad(points: F32) -> F64:
    """B(2) with its quadrant (METHOD D15): (n,) in [0, 2π), counter-clockwise from x, z up."""
    azimuth = np.arctan2(points[:, 1].astype(np.float64), points[:, 0].astype(np.float64))
    azimuth[azimuth < 0] += 2 * np.pi
    # what lies a rounding below zero would become 2π itself
    return np.where(azimuth < 2 * np.pi, azimuth, 0.0)


def aggregate(edges: EdgePoints, config: Link3dConfig) -> Keypoints:
    """Cluster the edge points of a sweep and keep the clusters that are keypoints.

    Args:
        edges: deskewed, with rings.
        config: sectors, gates and counts.
    """
    assert edges.sweep.ring is not None
    points = edges.sweep.points_lidar
    sector = (azimuth_rad(points) * (config.sectors / (2 * np.pi))).astype(np.int64)
    # by range inside a sector: turning the sweep by whole sectors changes nothing
    order = np.lexsort((np.hypot(points[:, 0], points[:, 1]), sector))
    cluster = cluster_in_sectors(
        points, sector, order, config.sector_min_points, config.cluster_range_m, config.cluster_xy_m
    )
    merged = merge_clusters(points, cluster, config.cluster_min_points, config.merge_range_m, config.merge_xy_m)
    return _keypoints(edges, edges.sweep.ring, merged, config)


def _keypoints(edges: EdgePoints, ring: U16, cluster: I64, config: Link3dConfig) -> Keypoints:
    """The clusters with enough points on enough rings, numbered anew."""
    clusters = int(cluster.max(initial=-1)) + 1
    rings = int(ring.max(initial=0)) + 1
    inside = np.flatnonzero(cluster >= 0)
    place = cluster[inside] * rings + ring[inside]
    on_ring = np.bincount(place, minlength=clusters * rings).reshape(clusters, rings)
    good = (on_ring.sum(axis=1) >= config.min_points) & ((on_ring > 0).sum(axis=1) >= config.min_rings)
    number = np.append(np.where(good, np.cumsum(good) - 1, -1), -1)  # a cluster of -1 finds the last entry
    of_edge = number[cluster]
    kept = np.flatnonzero(of_edge >= 0)
    points = edges.sweep.points_lidar[kept].astype(np.float64)
    count = int(good.sum())
    sums = np.stack([np.bincount(of_edge[kept], weights=column, minlength=count) for column in points.T], axis=1)
    centroids = sums / np.bincount(of_edge[kept], minlength=count)[:, None]
    return Keypoints(centroids.reshape(-1, 3), of_edge, _sharpest(edges, ring, of_edge, kept))


def _sharpest(edges: EdgePoints, ring: U16, of_edge: I64, kept: I64) -> I64:
    place = of_edge[kept] * (int(ring.max(initial=0)) + 1) + ring[kept]
    order = kept[np.lexsort((-edges.smoothness[kept], place))]
    first = np.diff(np.sort(place), prepend=-1) > 0
    return order[first]


@njit(cache=True, nogil=True)
def cluster_in_sectors(points: F32, sector: I64, order: I64, least: int, range_m: float, xy_m: float) -> I64:
    """Greedy clusters: a point joins the nearest cluster of its sector whose mean is within the gates, or opens one.

    Args:
        points: (m, 3).
        sector: (m,) rising along `order`.
        order: (m,) in which the points are taken.
        least: sectors with fewer points are left out.
        range_m: of the horizontal range from the cluster's mean range.
        xy_m: of x and of y from the cluster's means.

    Returns:
        (m,) cluster of every point, numbered as they are opened; -1 in sectors left out.
    """
    m = points.shape[0]
    out = np.full(m, -1, np.int64)
    sums = np.zeros((m, 4))  # range, x, y, points
    count = 0
    a = 0
    while a < m:
        b = a + 1
        while b < m and sector[order[b]] == sector[order[a]]:
            b += 1
        first = count
        if b - a >= least:
            for k in range(a, b):
                i = order[k]
                x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
                r = np.sqrt(x * x + y * y)
                best = count
                best2 = np.inf
                for c in range(first, count):
                    n = sums[c, 3]
                    dx, dy = abs(x - sums[c, 1] / n), abs(y - sums[c, 2] / n)
                    if abs(r - sums[c, 0] / n) < range_m and dx < xy_m and dy < xy_m and dx * dx + dy * dy < best2:
                        best = c
                        best2 = dx * dx + dy * dy
                if best == count:
                    count += 1
                sums[best, 0] += r
                sums[best, 1] += x
                sums[best, 2] += y
                sums[best, 3] += 1.0
                out[i] = best
        a = b
    return out


@njit(cache=True, nogil=True)
def merge_clusters(points: F32, cluster: I64, least: int, range_m: float, xy_m: float) -> I64:
    """Join clusters whose means are near: each, the largest first, takes what is near to *its* mean and still free.

    Means are those before merging: along a wall clusters would otherwise grow without end.

    Args:
        points: (m, 3).
        cluster: (m,) from `cluster_in_sectors`.
        least: smaller clusters are dropped.
        range_m: of the mean horizontal ranges.
        xy_m: of the means of x and of y.

    Returns:
        (m,) merged cluster of every point, -1 without.
    """
    count = 0
    for i in range(cluster.shape[0]):
        count = max(count, cluster[i] + 1)
    means = np.zeros((count, 3))
    size = np.zeros(count)
    for i in range(cluster.shape[0]):
        c = cluster[i]
        if c >= 0:
            x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
            means[c, 0] += np.sqrt(x * x + y * y)
            means[c, 1] += x
            means[c, 2] += y
            size[c] += 1.0
    for c in range(count):
        means[c] /= size[c]
    order = np.argsort(-size, kind="mergesort")
    merged = np.full(count + 1, -1, np.int64)  # the last entry is for points without a cluster
    found = 0
    for a in range(count):
        i = order[a]
        if merged[i] >= 0 or size[i] < least:
            continue
        merged[i] = found
        for b in range(a + 1, count):
            j = order[b]
            if (
                merged[j] < 0
                and size[j] >= least
                and abs(means[i, 0] - means[j, 0]) < range_m
                and abs(means[i, 1] - means[j, 1]) < xy_m
                and abs(means[i, 2] - means[j, 2]) < xy_m
            ):
                merged[j] = found
        found += 1
    out = np.empty(cluster.shape[0], np.int64)
    for i in range(cluster.shape[0]):
        out[i] = merged[cluster[i]]
    return out
