"""The numbers over time that stand beside the mine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mineloc.data import F64, I64, Trajectory
from mineloc.view.recorder import GREEN, ORANGE, SKY, VERMILION, Rgb
from mineloc.view.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class TimeCurve:
    """One number over time.

    Attributes:
        group: the plot that it stands in.
        name: within the plot.
        stamps_ns, values: (n,); NaN where unknown.
        color: of the line.
    """

    group: str
    name: str
    stamps_ns: I64
    values: F64
    color: Rgb

    @property
    def entity(self) -> str:
        """Where the recording keeps it."""
        return f"curves/{self.group}/{self.name.replace(' ', '_')}"


def run_curves(scene: Scene) -> list[TimeCurve]:
    """Error (or, without a reference, what the estimate claims of itself), registration, speed."""
    curves = [
        TimeCurve("error", name, one.shown.stamps_ns, one.shown.error_m, ORANGE if name == "online" else SKY)
        for name, one in scene.comparisons.items()
    ]
    if not curves:
        keyframes = scene.run.keyframes
        stamps = keyframes["stamp_ns"].to_numpy()
        for column, name, color in (("sigma_xy_m", "horizontal", SKY), ("sigma_z_m", "vertical", ORANGE)):
            curves.append(TimeCurve("uncertainty", name, stamps, keyframes[column].to_numpy(), color))
    sweeps = scene.run.sweeps
    stamps = sweeps["stamp_ns"].to_numpy()
    for column, name, color in (
        ("inlier_ratio", "inliers", GREEN),
        ("degeneracy_score", "degeneracy score", VERMILION),
    ):
        curves.append(TimeCurve("health", name, stamps, sweeps[column].to_numpy(), color))
    if len(scene.smoothed) > 1:
        curves.append(TimeCurve("speed", "speed", scene.smoothed.stamps_ns, speed_mps(scene.smoothed), SKY))
    return [curve for curve in curves if bool(np.isfinite(curve.values).any())]


def speed_mps(trajectory: Trajectory) -> F64:
    """(n,) speed, n ≥ 2."""
    seconds = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    return np.linalg.norm(np.gradient(trajectory.positions_m, seconds, axis=0), axis=1)


def ranges(curves: Sequence[TimeCurve]) -> dict[str, tuple[float, float]]:
    """Lowest (at most 0) and highest value of every group: a plot that starts at zero shows what is small."""
    out: dict[str, tuple[float, float]] = {}
    for curve in curves:
        low, high = out.get(curve.group, (0.0, 0.0))
        out[curve.group] = (
            min(low, float(np.nanmin(curve.values))),
            max(high, float(np.nanmax(curve.values))),
        )
    return out
