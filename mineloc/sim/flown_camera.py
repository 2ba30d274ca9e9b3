"""The depth camera of a simulated flight: when it is exposed, and what it measures then."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from mineloc.config import SimulateConfig
from mineloc.data import DepthImage
from mineloc.sim.camera_mount import camera_model
from mineloc.sim.depth_camera import DepthCamera, DepthErrors, DepthView
from mineloc.sim.machine import Machine
from mineloc.sim.scene import Scene

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

# random streams; the flight has those up to 6, what is seen of tags 21 to 23
_NOISE, _BIAS = 24, 25
# the camera runs on its own: its images are not taken when a sweep begins
_SHUTTER_NS = 13_000_000


class FlownCamera:
    """Takes the depth images of a flight; each is the same whenever it is asked for.

    Args:
        scene: the mine.
        config: camera, its errors, the seed.
        pose: (n, 4, 4) `T_map_camera` of the optical frame at (n,) times.
        start_ns: of the flight.
        machine: may stand in the way.
    """

    def __init__(
        self,
        scene: Scene,
        config: SimulateConfig,
        pose: Callable[[I64], F64],
        *,
        start_ns: int,
        machine: Machine | None,
    ) -> None:
        errors = DepthErrors(
            config.depth_subpixel_px,
            config.depth_correlated_px,
            config.depth_bias_px,
            config.depth_range_m,
            config.depth_holes,
        )
        self.camera = DepthCamera(scene, camera_model(config.camera_size), errors, _rng(config.seed, _BIAS))
        self._pose = pose
        self._start_ns = start_ns
        self._machine = machine
        self._rate_hz, self._seed = config.camera_hz, config.seed

    def exposure_ns(self, index: int) -> int:
        """When an image is taken, counted from 0."""
        return self._start_ns + _SHUTTER_NS + round(index * 1e9 / self._rate_hz)

    def between(self, begin_ns: int, end_ns: int) -> Iterator[DepthImage]:
        """The images taken in `[begin_ns, end_ns)`, in order of time."""
        index = max(0, int((begin_ns - self._start_ns - _SHUTTER_NS) * 1e-9 * self._rate_hz) - 1)
        while (stamp_ns := self.exposure_ns(index)) < end_ns:
            if stamp_ns >= begin_ns:
                yield self.image(index)
            index += 1

    def image(self, index: int) -> DepthImage:
        """One measured image, counted from 0."""
        stamp_ns = self.exposure_ns(index)
        depth_m = self.camera.measure(self._view(stamp_ns), _rng(self._seed, _NOISE, index))
        return DepthImage(stamp_ns, depth_m, self.camera.camera)

    def truth(self, stamp_ns: int) -> DepthImage:
        """What a camera without errors and limits would see at any time; 0 where nothing is met."""
        depth_m = self._view(stamp_ns).depth_m
        return DepthImage(stamp_ns, np.where(np.isfinite(depth_m), depth_m, 0.0).astype(np.float32), self.camera.camera)

    def _view(self, stamp_ns: int) -> DepthView:
        box = self._machine.pose((stamp_ns - self._start_ns) * 1e-9) if self._machine else None
        return self.camera.look(self._pose(np.array([stamp_ns]))[0], box)


def _rng(*key: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(key))
