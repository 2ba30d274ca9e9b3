"""A multirotor on its schedule: it wanders a little, tilts with its thrust, and shakes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mineloc.errors import SimulationError
from mineloc.sim.motion import Motion, Vibration, tilt_from_thrust
from mineloc.sim.scene import Scene
from mineloc.sim.schedule import Schedule

F64 = NDArray[np.float64]

SWAY_S = 1.5
DRAG_PER_S = 0.2


def drone_motion(
    plan: Schedule, scene: Scene, vibration: Vibration, *, sway_m: float, clearance_m: float, rng: np.random.Generator
) -> Motion:
    """The motion of a drone that follows the schedule.

    Args:
        plan: where to be when.
        scene: the mine.
        vibration: of the body.
        sway_m: standard deviation of the wander where there is room, to the side (60 % of it in height).
        clearance_m: distance to the walls below which the wander is damped.
        rng: the wander.

    Raises:
        SimulationError: the motion comes nearer to a wall than half of the clearance.
    """
    positions = _sway(plan, scene, sway_m, clearance_m, rng)
    level = np.zeros((len(positions), 2))
    control = np.column_stack([positions, plan.yaw_rad, level])
    smooth = Motion(control, plan.step_s, Vibration.none()).at(
        np.linspace(0.0, (len(positions) - 1) * plan.step_s, len(positions))
    )
    # the air resists in proportion to the speed: a drone in level flight leans forward
    force = smooth.accel_mps2 + DRAG_PER_S * smooth.velocity_mps
    control[:, 4], control[:, 5] = tilt_from_thrust(force, plan.yaw_rad)
    motion = Motion(control, plan.step_s, vibration)
    _check_clear(motion, scene, clearance_m / 2)
    return motion


def _sway(plan: Schedule, scene: Scene, sway_m: float, clearance_m: float, rng: np.random.Generator) -> F64:
    """(n, 3) positions with slow wander to the side and in height, less where the walls are near."""
    blur = SWAY_S / plan.step_s
    noise = gaussian_filter1d(rng.standard_normal((len(plan.positions_m), 2)), blur, axis=0, mode="nearest")
    # a Gaussian of width b leaves 1/√(2 b √π) of the deviation of white noise
    side, up = (np.sqrt(2 * blur * np.sqrt(np.pi)) * sway_m * noise * [1.0, 0.6] * plan.moving[:, None]).T
    wander = np.column_stack([-np.sin(plan.yaw_rad) * side, np.cos(plan.yaw_rad) * side, up])
    weight = np.ones(len(wander))
    for _ in range(8):
        near = scene.clearance_m(plan.positions_m + weight[:, None] * wander) < clearance_m
        if not near.any():
            break
        weight *= np.where(near, 0.5, 1.0)
        # damp a little before and after too, so that the wander fades instead of jumping
        weight = np.minimum(weight, gaussian_filter1d(weight, blur / 2, mode="nearest"))
    weight = gaussian_filter1d(weight, blur / 2, mode="nearest")
    return plan.positions_m + weight[:, None] * wander


def _check_clear(motion: Motion, scene: Scene, least_m: float) -> None:
    times = np.arange(0.0, motion.end_s, 0.05)
    positions = motion.pose(times)[:, :3, 3]
    clearance = scene.clearance_m(positions)
    worst = int(clearance.argmin())
    step = np.diff(positions, axis=0)
    length = np.linalg.norm(step, axis=1)
    through = scene.ranges_m(positions[:-1], step / np.maximum(length, 1e-9)[:, None]) < length
    if clearance[worst] < least_m or through.any():
        x, y, z = positions[worst]
        raise SimulationError(
            "flight",
            f"{clearance[worst]:.2f} m from the wall at ({x:.1f}, {y:.1f}, {z:.1f})",
            expected=f"at least {least_m:.2f} m",
            todo="lower simulate.clearance_m or simulate.sway_m, or choose another start",
        )
