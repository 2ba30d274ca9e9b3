"""What speaks for each recognised intersection of a run: its stored cloud and contour, and those that were seen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import IntersectionsConfig
from mineloc.data import F64, I64, Bool, Intersection, IntersectionDatabase, Sight, WallContour
from mineloc.stages.passages import Encounter, encounters, errors_of, scores_of
from mineloc.stages.recognitions import recognition_of
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.run_tables import poses_of
from mineloc.sweep.voxel_grid import first_in_voxels
from mineloc.view.recognition_steps import Accepted, Away

_POINTS = 1500
_STORED_VOXEL_M = 0.3
_RADIUS_M = 12.0
_ROOF_NORMAL_Z = -0.6
_BINS = 120
_GAP_BINS, _JUMP_M = 2, 1.0
"""A contour is drawn through so many bins without a wall, and over so large a jump."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """One passage with an accepted fix.

    Attributes:
        why: its numbers.
        stamp_ns: of the fix with the most inliers.
        stored_m, seen_m: (n, 3) points around the invariant point, in map axes.
        stored, seen: the PWCV as lines over ground around the point, each (n, 2).
    """

    why: Accepted
    stamp_ns: int
    stored_m: F64
    seen_m: F64
    stored: list[F64]
    seen: list[F64]


def recognised(run: RunFolder, database: IntersectionDatabase) -> list[Evidence]:
    """Every passage with an accepted fix, by time; none where the run was not found in the map."""
    known = run.intersections()
    if known is None or known.is_empty() or not run.manifest["map"].get("found", True):
        return []
    ids = {one.id: one for one in database.intersections}
    scored = None if run.reference is None else recognition_of(run, run.reference)
    flight = _Flight.of(run)
    found: list[Evidence] = []
    for one in encounters(run, known, None if scored is None else scored.score):
        place = ids.get(int(known["id"][one.row]))
        if len(one.accepted) and one.best is not None and place is not None:
            found.append(flight.evidence(one, place, database.contour_threshold))
    return sorted(found, key=lambda one: one.stamp_ns)


@dataclass(frozen=True, slots=True, eq=False)
class _Flight:
    """What of a run is needed again and again."""

    run: RunFolder
    index: I64
    odometry: F64
    points: F64
    begins: I64
    errors: Mapping[int, tuple[float, float]]

    @staticmethod
    def of(run: RunFolder) -> _Flight:
        table = run.points().sort("keyframe", maintain_order=True)
        index = run.keyframes["index"].to_numpy()
        begins = np.searchsorted(table["keyframe"].to_numpy(), np.append(index, index[-1:] + 1))
        return _Flight(
            run=run,
            index=index,
            odometry=poses_of(run.keyframes, prefix="odom_"),
            points=table.select("x_m", "y_m", "z_m").to_numpy().astype(np.float64),
            begins=begins,
            errors={} if run.reference is None else errors_of(run, run.reference),
        )

    def evidence(self, one: Encounter, place: Intersection, threshold: float) -> Evidence:
        """A passage by its best fix."""
        assert one.best is not None
        fix = self.run.fixes[one.best : one.best + 1]
        pose, row = poses_of(fix)[0], int(np.searchsorted(self.index, fix["keyframe"][0]))
        configuration = self.run.manifest["configuration"]
        points, in_band = self._window(row, pose)
        points = points - place.point_map
        near = np.linalg.norm(points[:, :2], axis=1) < _RADIUS_M
        stamp_ns = int(fix["stamp_ns"][0])
        return Evidence(
            why=Accepted(
                name=place.name,
                kind=place.kind,
                id=place.id,
                keyframe=int(fix["keyframe"][0]),
                seconds=(stamp_ns - int(self.run.smoothed.stamps_ns[0])) * 1e-9,
                times=len(one.accepted),
                scores=scores_of(self.run, one.best),
                reach_m=float(np.linalg.norm(pose[:2, 3] - place.point_map[:2])),
                contour_threshold=threshold,
                configuration=configuration,
                predicted=self._predicted(row, pose),
                error=Away(*self.errors[one.best]) if one.best in self.errors else None,
            ),
            stamp_ns=stamp_ns,
            stored_m=_stored(place),
            seen_m=_some(points[near]),
            stored=stored_lines(place.contour),
            seen=seen_lines(points[in_band, :2], place.contour.radius_m),
        )

    def _window(self, row: int, pose: F64) -> tuple[F64, Bool]:
        """(n, 3) points of the keyframes up to a row, placed by its pose; (n,) which are at the height of walls."""
        told = self.run.manifest["configuration"].get("intersections", {})
        default = IntersectionsConfig()
        window = int(told.get("window_keyframes", default.window_keyframes))
        band_m = float(told.get("wall_band_m", default.wall_band_m))
        T_map_odom = pose @ se3.inverse(self.odometry[row])
        clouds, bands = [np.zeros((0, 3))], [np.zeros(0, np.bool_)]
        for k in range(max(row - window + 1, 0), row + 1):
            T = T_map_odom @ self.odometry[k]
            cloud = se3.apply(T, self.points[self.begins[k] : self.begins[k + 1]])
            clouds.append(cloud)
            bands.append(np.abs(cloud[:, 2] - T[2, 3]) < band_m)
        return np.concatenate(clouds), np.concatenate(bands)

    def _predicted(self, row: int, pose: F64) -> Away | None:
        """Away from where the keyframe before, as known then, and odometry put it; None before the flight was found."""
        online = self.run.online
        before = int(self.run.keyframes["stamp_ns"][row - 1]) if row else -1
        at = int(np.searchsorted(online.stamps_ns, before))
        if at >= len(online) or online.stamps_ns[at] != before:
            return None
        step = se3.inverse(self.odometry[row - 1]) @ self.odometry[row]
        return _away(online.poses[at] @ self.run.T_body_lidar @ step, pose)


def stored_lines(contour: WallContour) -> list[F64]:
    """The walls of a PWCV, (n, 2) each: gaps are branches or unknown."""
    bins = np.flatnonzero(contour.sight == Sight.WALL)
    return _lines(bins, contour.radius_m * contour.distance[bins].astype(np.float64), len(contour.distance))


def seen_lines(walls_m: F64, radius_m: float) -> list[F64]:
    """The nearest wall in each direction, as lines.

    The contour that recognition made is not kept in a run; this one is of the few points that are, without free space.

    Args:
        walls_m: (n, 2) points at the height of walls around the invariant point.
        radius_m: of the contour.
    """
    away = np.linalg.norm(walls_m, axis=1)
    walls_m, away = walls_m[(away < radius_m) & (away > 0.0)], away[(away < radius_m) & (away > 0.0)]
    bins = np.floor(np.arctan2(walls_m[:, 1], walls_m[:, 0]) / (2 * np.pi) * _BINS).astype(np.int64) % _BINS
    nearest = np.full(_BINS, np.inf)
    np.minimum.at(nearest, bins, away)
    known = np.flatnonzero(np.isfinite(nearest))
    return _lines(known, nearest[known], _BINS, offset=0.5)


def _lines(bins: I64, reach_m: F64, count: int, *, offset: float = 0.0) -> list[F64]:
    """Neighbouring bins joined, around the circle."""
    if len(bins) < 2:
        return []
    bearing = 2 * np.pi * (bins + offset) / count
    ring = reach_m[:, None] * np.column_stack([np.cos(bearing), np.sin(bearing)])
    apart = np.diff(bins, append=bins[0] + count) > _GAP_BINS
    apart |= np.abs(np.diff(reach_m, append=reach_m[0])) > _JUMP_M
    if not apart.any():
        return [np.concatenate([ring, ring[:1]])]
    # begin behind a gap, so that no line is cut where bearings start anew
    first = int(np.flatnonzero(apart)[0]) + 1
    ring, apart = np.roll(ring, -first, axis=0), np.roll(apart, -first)
    return [line for line in np.split(ring, np.flatnonzero(apart[:-1]) + 1) if len(line) > 1]


def _stored(place: Intersection) -> F64:
    """The stored cloud, thinned evenly, without the roof that would hide it from above."""
    open_above = place.normals[:, 2] > _ROOF_NORMAL_Z
    points = place.points_m[open_above & (np.linalg.norm(place.points_m[:, :2], axis=1) < _RADIUS_M)]
    return _some(points[first_in_voxels(points, _STORED_VOXEL_M)].astype(np.float64))


def _some(points: F64) -> F64:
    return points[:: max(1, -(-len(points) // _POINTS))]


def _away(one: F64, other: F64) -> Away:
    T = se3.inverse(one) @ other
    return Away(float(np.linalg.norm(T[:3, 3])), float(np.degrees(se3.angle_rad(T))))
