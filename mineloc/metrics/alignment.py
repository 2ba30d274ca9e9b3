"""The transform that lays an estimate over its reference before they are compared.

For localization in a known map `none` is the honest one: the estimate lives in the map frame.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from mineloc import se3
from mineloc.data import F64

Alignment = Literal["none", "origin", "posyaw", "se3"]


def alignment(reference: F64, estimate: F64, kind: Alignment) -> F64:
    """(4, 4) transform to put in front of every estimated pose.

    `origin` lays the first poses over each other; `posyaw` turns about the vertical and shifts (4 degrees of
    freedom), `se3` turns and shifts freely, both for the least squared distance of all positions, without scale.

    Args:
        reference, estimate: (n, 4, 4) paired poses, n ≥ 1.

    Raises:
        ValueError: `se3` with fewer than 3 poses or positions on one point or line, which leave the rotation open;
            no poses.
    """
    if not len(reference):
        raise ValueError("no poses to align")
    if kind == "none":
        return np.eye(4)
    if kind == "origin":
        return reference[0] @ se3.inverse(estimate[0])
    if kind == "posyaw":
        return _turn_about_vertical(reference[:, :3, 3], estimate[:, :3, 3])
    return umeyama(reference[:, :3, 3], estimate[:, :3, 3])


def umeyama(target: F64, source: F64) -> F64:
    """(4, 4) rigid transform with the least squared distance from `source` to `target` (Umeyama 1991, scale 1).

    Args:
        target, source: (n, 3) paired points, metres.

    Raises:
        ValueError: fewer than 3 points, or the points lie on one point or line.
    """
    if len(target) < 3:
        raise ValueError(f"{len(target)} positions, a free rotation needs 3")
    target_mean, source_mean = target.mean(axis=0), source.mean(axis=0)
    covariance = (target - target_mean).T @ (source - source_mean) / len(target)  # eq. 38
    u, d, vt = np.linalg.svd(covariance)
    if d[1] <= 1e-12 * max(d[0], 1e-12):
        raise ValueError("the positions lie on one point or one line, which leaves the rotation open")
    sign = np.array([1.0, 1.0, 1.0 if np.linalg.det(u) * np.linalg.det(vt) > 0 else -1.0])  # eq. 43: no mirror
    rotation = (u * sign) @ vt  # eq. 40
    return se3.from_rt(rotation, target_mean - rotation @ source_mean)  # eq. 41


def _turn_about_vertical(target: F64, source: F64) -> F64:
    target_mean, source_mean = target.mean(axis=0), source.mean(axis=0)
    c = (target - target_mean).T @ (source - source_mean)
    # the yaw that maximises trace(R_zᵀ C): Zhang and Scaramuzza 2018
    yaw = np.arctan2(c[1, 0] - c[0, 1], c[0, 0] + c[1, 1])
    rotation = se3.exp([0, 0, yaw, 0, 0, 0])[:3, :3]
    return se3.from_rt(rotation, target_mean - rotation @ source_mean)
