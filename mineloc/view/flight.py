"""A flight file as a Rerun recording: its sweeps along the poses that it brings with it, and what the IMU felt."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mineloc.config import Config, ViewConfig
from mineloc.data import F64, ImuSamples, Trajectory
from mineloc.errors import FlightError
from mineloc.io.flight import FlightReader
from mineloc.output import new_file
from mineloc.progress import Progress, quiet
from mineloc.view import placed
from mineloc.view.about import about_flight
from mineloc.view.curves import TimeCurve, ranges, speed_mps
from mineloc.view.layout import flight_layout
from mineloc.view.recorder import SKY, VERMILION, WHITE, YELLOW, RunRecorder
from mineloc.view.run import record_mine

_IMU_SAMPLES = 20_000


def record_flight(
    flight: Path, out: Path, *, config: Config, overwrite: bool = False, progress: Progress = quiet
) -> Path:
    """Write the recording of a flight.

    Sweeps are placed by the reference, else by the odometry that came with the recording; without either they are
    shown in the lidar frame, one after the other.

    Args:
        flight: canonical flight.
        out: `.rrd` to write.
        config: section `view`.
        overwrite: replace `out`.
        progress: told the sweeps that are done.

    Raises:
        FlightError: no sweeps.
        IngestError: not a canonical flight, or damaged.
        OutputError: `out` exists or cannot be written.
    """
    with FlightReader(flight) as reader:
        info, health, calibration = reader.info, reader.health, reader.calibration
        body = reader.reference() or reader.odometry()
        curves = _curves(reader.imu(), body)
        span = (reader.first_ns, reader.last_ns)
        if not reader.sweep_count:
            raise FlightError(flight, "holds no sweeps", expected="a flight with a LiDAR", todo="ingest it again")
    lidar = body.compose(right=calibration.T_body_lidar, child="lidar") if body is not None and len(body) > 1 else None
    clouds = list(placed.flight_clouds(flight, lidar, config.view, progress=progress))
    origin = np.zeros(3) if lidar is None else placed.local_origin(lidar.positions_m)
    mine = _mine(clouds, lidar, config.view, origin)
    low, high = _corners(clouds, lidar)
    layout = flight_layout(
        low - origin, high - origin, first_ns=span[0], last_ns=span[1], curves=ranges(curves), log=False
    )
    name = info.flight or flight.stem
    with (
        new_file(out, overwrite=overwrite) as temp,
        RunRecorder(temp, recording_id=f"flight-{name}-{span[0]}", name=name, origin_m=origin, layout=layout) as r,
    ):
        r.document("about", about_flight(info, health, placed_by=_placed_by(lidar, body), origin_m=origin))
        record_mine(r, mine)
        if lidar is not None and body is not None:
            r.lines("map/reference", [body.positions_m], colors=WHITE)
            r.moving("map/body", body.stamps_ns, body.poses, axis_m=1.5)
        for curve in curves:
            r.curve(curve.entity, curve.stamps_ns, curve.values, name=curve.name, color=curve.color)
        r.sweeps("map/sweep", clouds, color=YELLOW, radius_m=0.06)
    return out


def _placed_by(lidar: Trajectory | None, body: Trajectory | None) -> str:
    if lidar is None or body is None:
        return "nothing: the flight brings no poses, so every sweep is shown in the lidar frame"
    return "the reference of the flight" if body.parent == "map" else "the odometry that came with the recording"


def _mine(clouds: list[tuple[int, F64]], lidar: Trajectory | None, config: ViewConfig, origin: F64) -> F64:
    # without poses the sweeps lie on top of each other: their sum is not a mine
    return np.zeros((0, 3)) if lidar is None else placed.mine_cloud(clouds, config, origin)


def _corners(clouds: list[tuple[int, F64]], lidar: Trajectory | None) -> tuple[F64, F64]:
    if lidar is not None:
        return placed.corners(lidar.positions_m)
    first = next((cloud for _, cloud in clouds), np.zeros((1, 3)))
    return placed.corners(np.percentile(first, [5, 95], axis=0))


def _curves(imu: ImuSamples, body: Trajectory | None) -> list[TimeCurve]:
    curves: list[TimeCurve] = []
    if len(imu):
        step = -(-len(imu) // _IMU_SAMPLES)
        stamps = imu.stamps_ns[::step]
        force = np.linalg.norm(imu.accel_mps2[::step], axis=1)
        turn = np.degrees(np.linalg.norm(imu.gyro_radps[::step], axis=1))
        curves.append(TimeCurve("force", "specific force", stamps, force, SKY))
        curves.append(TimeCurve("turn", "turn rate", stamps, turn, VERMILION))
    if body is not None and len(body) > 1:
        curves.append(TimeCurve("speed", "speed", body.stamps_ns, speed_mps(body), SKY))
    return curves
