"""Every odometry of the comparison behind one interface, each in its best fair configuration (see ../README.md).

A system is made for one flight. `prepare` turns a sweep into what the system's own loader would hand over; it counts
as reading. `step` is what is timed. Poses are `T_odom_lidar`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, Protocol

import numpy as np

from mineloc.data import Calibration, ImuSamples, Sweep

MIN_RANGE_M, MAX_RANGE_M = 0.5, 100.0
F64 = np.ndarray[Any, np.dtype[np.float64]]


class Odometry(Protocol):
    """One system under test.

    Attributes:
        package: the distribution whose version is told.
        pose_at: the time within a sweep for which its pose is true, from 0 (first point) to 1 (last point).
        configuration: what it was told, for the record.
    """

    package: str
    pose_at: float
    configuration: dict[str, Any]

    def prepare(self, sweep: Sweep, imu: ImuSamples) -> Any:
        """Untimed."""
        ...

    def step(self, prepared: Any) -> F64 | None:
        """Timed. None: the system gave no pose for this sweep."""
        ...


def points_and_times(sweep: Sweep) -> tuple[F64, F64]:
    """Points within range as float64, and their times from 0 to 1 over the sweep: what the peers' loaders give."""
    points = sweep.points_lidar.astype(np.float64)
    near = np.einsum("ij,ij->i", points, points)
    kept = (near >= MIN_RANGE_M**2) & (near <= MAX_RANGE_M**2)
    assert sweep.offsets_ns is not None
    return np.ascontiguousarray(points[kept]), sweep.offsets_ns[kept] / max(int(sweep.offsets_ns.max()), 1)


class Mineloc:
    """The mineloc front end."""

    package = "mineloc"
    pose_at = 1.0

    def __init__(self, calibration: Calibration, *, use_imu: bool = True) -> None:
        from mineloc.config import load_config
        from mineloc.odometry.mineloc_front_end import MinelocFrontEnd
        from mineloc.sweep.range_filter import within_range

        self.configuration = {} if use_imu else {"odometry.use_imu": False}
        config = load_config(None, [f"odometry.use_imu={str(use_imu).lower()}"])
        self._sweep_config, self._within_range = config.sweep, within_range
        self._front_end: Any = MinelocFrontEnd(config.odometry, config.keyframe, calibration)

    def prepare(self, sweep: Sweep, imu: ImuSamples) -> tuple[Sweep, ImuSamples]:
        return sweep, imu

    def step(self, prepared: tuple[Sweep, ImuSamples]) -> F64 | None:
        sweep, imu = prepared
        return self._front_end.step(self._within_range(sweep, self._sweep_config), imu).T_odom_lidar


class Loam(Mineloc):
    """The LOAM baseline."""

    def __init__(self, calibration: Calibration) -> None:
        from mineloc.config import Config
        from mineloc.odometry.loam import LoamFrontEnd

        super().__init__(calibration)
        self._front_end = LoamFrontEnd(Config().loam, Config().keyframe)


class KissIcp:
    """kiss-icp: its Python class, times normalised, poses true at the sweep's end (its deskew target)."""

    package = "kiss-icp"
    pose_at = 1.0

    def __init__(self, calibration: Calibration, *, voxel_m: float = 0.3, min_motion_m: float = 0.1) -> None:
        del calibration
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP

        config = load_config(None)
        config.data.min_range, config.data.max_range = MIN_RANGE_M, MAX_RANGE_M
        config.mapping.voxel_size = voxel_m
        config.adaptive_threshold.min_motion_th = min_motion_m
        self.configuration = config.model_dump(exclude={"out_dir"})
        self._odometry = KissICP(config)

    def prepare(self, sweep: Sweep, imu: ImuSamples) -> tuple[F64, F64]:
        del imu
        return points_and_times(sweep)

    def step(self, prepared: tuple[F64, F64]) -> F64 | None:
        self._odometry.register_frame(*prepared)
        return self._odometry.last_pose


class GenzIcp:
    """genz-icp: its Python class with a packaged preset. Without deskewing its poses belong to the middle, with it too.

    Its C++ keeps the adaptive voxel size in a function-static variable: never two instances in one process.
    """

    package = "genz-icp"
    pose_at = 0.5

    def __init__(self, calibration: Calibration, *, preset: str = "corridor", **options: float) -> None:
        del calibration
        from pathlib import Path

        from genz_icp.config import load_config
        from genz_icp.genz_icp import GenZICP

        config = load_config(Path(preset))
        config.data.min_range, config.data.max_range = MIN_RANGE_M, MAX_RANGE_M
        config.data.deskew = bool(options.pop("deskew", config.data.deskew))
        config.mapping = config.mapping.model_copy(update=options)
        self.configuration = {"preset": preset} | config.model_dump(exclude={"out_dir"})
        self._odometry = GenZICP(config)

    def prepare(self, sweep: Sweep, imu: ImuSamples) -> tuple[F64, F64]:
        del imu
        return points_and_times(sweep)

    def step(self, prepared: tuple[F64, F64]) -> F64 | None:
        self._odometry.register_frame(*prepared)
        return self._odometry.last_pose


class SmallGicp:
    """small_gicp is a registration library: around it the least that makes an odometry of it.

    Constant velocity predicts and deskews (to the sweep's end), as in the library's own odometry example plus the
    deskewing that its data did not need. Target is either one point cloud of the last keyframes (GICP) or a Gaussian
    voxel map with forgetting (VGICP: the only voxel map that its Python interface registers to).
    """

    package = "small_gicp"
    pose_at = 1.0
    SLICES = 32

    def __init__(
        self,
        calibration: Calibration,
        *,
        target: str = "submap",
        leaf_m: float = 0.25,
        distance_m: float = 1.0,
        keyframes: int = 25,
        keyframe_m: float = 1.0,
        voxel_m: float = 0.5,
        threads: int = 2,
        deskew: bool = True,
    ) -> None:
        del calibration
        import small_gicp

        options = {"target": target, "leaf_m": leaf_m, "distance_m": distance_m, "deskew": deskew, "threads": threads}
        chosen = {"keyframes": keyframes, "keyframe_m": keyframe_m} if target == "submap" else {"voxel_m": voxel_m}
        self.configuration = options | chosen
        self._library: Any = small_gicp
        self._leaf_m, self._distance_m, self._threads, self._deskew = leaf_m, distance_m, threads, deskew
        self._keyframe_m, self._recent = keyframe_m, deque[F64](maxlen=keyframes)
        self._voxels: Any = small_gicp.GaussianVoxelMap(voxel_m) if target == "voxels" else None
        self._target: Any = None
        self._last_keyframe: F64 | None = None
        self._pose, self._motion = np.eye(4), np.eye(4)

    def prepare(self, sweep: Sweep, imu: ImuSamples) -> tuple[F64, F64]:
        del imu
        return points_and_times(sweep)

    def step(self, prepared: tuple[F64, F64]) -> F64 | None:
        points, times = prepared
        if self._deskew:
            points = self._at_end(points, times)
        source, _ = self._library.preprocess_points(
            points, downsampling_resolution=self._leaf_m, num_neighbors=10, num_threads=self._threads
        )
        before, guess = self._pose, self._pose @ self._motion
        if self._voxels is not None:
            if self._voxels.size():
                guess = self._align(self._voxels, source, init_T_target_source=guess)
            self._voxels.insert(source, guess)
        else:
            if self._target is not None:
                cloud, tree = self._target
                guess = self._align(cloud, source, tree, init_T_target_source=guess)
            self._grow_submap(source, guess)
        self._pose, self._motion = guess, np.linalg.inv(before) @ guess
        return guess

    def _align(self, *target: Any, **options: Any) -> F64:
        found = self._library.align(
            *target, max_correspondence_distance=self._distance_m, num_threads=self._threads, **options
        )
        return np.asarray(found.T_target_source)

    def _at_end(self, points: F64, times: F64) -> F64:
        """Deskewed by the last motion: one rigid transform a time slice, which is exact to millimetres."""
        from scipy.spatial.transform import Rotation

        share = (np.arange(self.SLICES) + 0.5) / self.SLICES - 1.0
        turn = Rotation.from_rotvec(share[:, None] * Rotation.from_matrix(self._motion[:3, :3]).as_rotvec())
        edges = np.searchsorted(times, np.arange(self.SLICES + 1) / self.SLICES)
        edges[-1] = len(times)
        out = np.empty_like(points)
        for k, (R, a, b) in enumerate(zip(turn.as_matrix(), edges[:-1], edges[1:], strict=True)):
            out[a:b] = points[a:b] @ R.T + share[k] * self._motion[:3, 3]
        return out

    def _grow_submap(self, source: Any, pose: F64) -> None:
        last = self._last_keyframe
        if last is not None and np.linalg.norm(pose[:3, 3] - last[:3, 3]) < self._keyframe_m:
            return
        self._last_keyframe = pose
        self._recent.append(source.points()[:, :3] @ pose[:3, :3].T + pose[:3, 3])
        self._target = self._library.preprocess_points(
            np.concatenate(self._recent),
            downsampling_resolution=self._leaf_m,
            num_neighbors=10,
            num_threads=self._threads,
        )


class RkoLio:
    """rko_lio: its Python class, absolute times, IMU as its sequencer orders it; poses true at the sweep's end."""

    package = "rko_lio"
    pose_at = 1.0

    def __init__(self, calibration: Calibration, *, voxel_size: float = 0.3, **options: Any) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO

        chosen = {"double_downsample": False, "initialization_phase": True, "min_range": MIN_RANGE_M} | options
        config = LIOConfig(voxel_size=voxel_size, max_range=MAX_RANGE_M, **chosen)
        self.configuration = config.to_dict()
        self._odometry = LIO(config)
        self._T_lidar_imu = calibration.T_lidar_imu
        self._waiting: deque[tuple[int, F64, F64]] = deque()

    def prepare(self, sweep: Sweep, imu: ImuSamples) -> tuple[list[tuple[int, F64, F64]], F64, Any]:
        assert sweep.offsets_ns is not None
        self._waiting.extend(zip(imu.stamps_ns.tolist(), imu.accel_mps2, imu.gyro_radps, strict=True))
        due: list[tuple[int, F64, F64]] = []
        while self._waiting and self._waiting[0][0] < sweep.end_ns:
            due.append(self._waiting.popleft())
        return due, sweep.points_lidar.astype(np.float64), sweep.stamp_ns + sweep.offsets_ns

    def step(self, prepared: tuple[list[tuple[int, F64, F64]], F64, Any]) -> F64 | None:
        samples, points, stamps_ns = prepared
        for stamp_ns, accel, gyro in samples:
            self._odometry.add_imu_measurement(accel, gyro, stamp_ns, self._T_lidar_imu)
        self._odometry.register_scan(points, stamps_ns)
        return self._odometry.pose()


SYSTEMS: dict[str, tuple[Callable[..., Odometry], dict[str, Any]]] = {
    "mineloc": (Mineloc, {}),
    "mineloc_no_imu": (Mineloc, {"use_imu": False}),
    "loam": (Loam, {}),
    "kiss_icp": (KissIcp, {}),
    "genz_icp": (GenzIcp, {}),
    "small_gicp": (SmallGicp, {}),
    "small_vgicp": (SmallGicp, {"target": "voxels"}),
    "rko_lio": (RkoLio, {}),
}


def version_of(package: str) -> str:
    """Version of an installed distribution."""
    if package == "mineloc":
        from mineloc import __version__

        return __version__
    return version(package)
