"""Flights of one mine in one frame, when no survey places them: places that two of them saw, and what these agree on.

Nothing is known of where one flight lies in another, so a place alone proves nothing: every pair of keyframes that
Scan Context takes for one place is matched by features (ISS, FPFH) and ICP, each gives a transform between the
flights, and the transform that most of them agree on is believed when enough do, over a long enough way.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from mineloc import se3
from mineloc.config import Config
from mineloc.data import F64
from mineloc.errors import FlightError
from mineloc.localize.flown import Flown
from mineloc.localize.keyframe_clouds import context_of, submap_around
from mineloc.mapping.coarse_match import match_coarsely
from mineloc.mapping.submap_registration import register_submaps
from mineloc.places.context_search import ContextIndex


@dataclass(frozen=True, slots=True, eq=False)
class _Vote:
    """One place seen by both flights: where the second lies in the first, from where in the second, how far along."""

    T_a_b: F64
    T_b_lidar: F64
    at_m: float


def join_flights(flights: Mapping[str, Flown], config: Config) -> list[F64]:
    """`T_map_odom` of every flight in the map frame of the first.

    Each flight is joined to the one of those before with which it shares most places.

    Raises:
        FlightError: a flight shares too few places with the others.
    """
    names, flown = list(flights), list(flights.values())
    places = [flown[0].T_map_odom]
    for k in range(1, len(flown)):
        found = [_agreed(_votes(flown[i], flown[k], config), config) for i in range(k)]
        best = max(range(k), key=lambda i: found[i][1])
        T_a_b, count = found[best]
        if T_a_b is None:
            raise FlightError(
                names[k],
                f"{count} places in common with the flights before it",
                expected=f"at least {config.loops.join_votes} that agree",
                todo="give control points (--control), or a flight that overlaps with them",
            )
        places.append(se3.rigid(places[best] @ T_a_b))
    return places


def _votes(a: Flown, b: Flown, config: Config) -> list[_Vote]:
    """T_odom-a_odom-b from every pair of keyframes that look alike and register."""
    c = config.loops
    index = ContextIndex(config.scan_context)
    far_m = 1e6  # the search leaves out what was seen a short way ago: the flights are far apart
    for flight, offset_m in ((a, 0.0), (b, far_m)):
        poses, path_m = flight.keyframe_poses, _path_m(flight)
        for keyframe, T, at_m in zip(flight.keyframes, poses, path_m, strict=True):
            index.add(context_of(keyframe, T, config.scan_context), path_m=offset_m + at_m)
    votes: list[_Vote] = []
    path_m, last_m = _path_m(b), -np.inf
    for j, at_m in enumerate(path_m):
        if at_m < last_m + c.every_m:
            continue
        last_m = at_m
        matches = [match for match in index.candidates(len(a.keyframes) + j) if match.index < len(a.keyframes)]
        for match in matches[: c.max_candidates]:
            T = _registered(a, match.index, b, j, config)
            if T is not None:
                votes.append(_Vote(T, b.keyframes[j].T_odom_lidar, float(at_m)))
    return votes


def _registered(a: Flown, i: int, b: Flown, j: int, config: Config) -> F64 | None:
    """(4, 4) T_odom-a_odom-b when the submaps of two keyframes fit."""
    c = config.loops
    source, target = submap_around(b.keyframes, j, c), submap_around(a.keyframes, i, c)
    if min(len(source), len(target)) < c.min_inliers:
        return None
    start = match_coarsely(
        source,
        target,
        salient_m=c.iss_salient_m,
        suppression_m=c.iss_suppression_m,
        feature_m=c.fpfh_radius_m,
        distance_m=c.features_distance_m,
    )
    if start is None:
        return None
    found = register_submaps(
        source, target, start.T_target_source, distances_m=c.icp_distances_m, kernel_m=c.icp_kernel_m
    )
    if found.overlap < c.min_overlap or found.residual_m > c.max_residual_m:
        return None
    return a.keyframes[i].T_odom_lidar @ found.T_target_source @ se3.inverse(b.keyframes[j].T_odom_lidar)


def _agreed(votes: list[_Vote], config: Config) -> tuple[F64 | None, int]:
    """The transform that most votes agree with, and how many do: one vote a stretch of `every_m` counts."""
    c = config.loops
    best: F64 | None = None
    most = 0
    for vote in votes:
        agreeing = [other.at_m for other in votes if _agree(vote, other, c.join_m, np.radians(c.join_deg))]
        count = len({round(at_m / c.every_m) for at_m in agreeing})
        if count > most:
            best, most = vote.T_a_b, count
    return (best if most >= c.join_votes else None), most


def _agree(vote: _Vote, other: _Vote, within_m: float, within_rad: float) -> bool:
    """Whether one vote puts the place of the other where that one does; their origins may be far away."""
    apart = se3.inverse(vote.T_a_b @ other.T_b_lidar) @ other.T_a_b @ other.T_b_lidar
    return float(np.linalg.norm(apart[:3, 3])) < within_m and float(se3.angle_rad(apart)) < within_rad


def _path_m(flight: Flown) -> F64:
    steps = [0.0 if edge is None else float(np.linalg.norm(edge.T_i_j[:3, 3])) for edge in flight.edges]
    return np.cumsum(steps)
