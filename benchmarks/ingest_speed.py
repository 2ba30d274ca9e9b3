"""Ingest against merely reading: the same file through `mineloc ingest` and through the mcap library with CRCs checked.

    python benchmarks/ingest_speed.py                       makes recordings (velodyne layout, IMU at 200 Hz)
    python benchmarks/ingest_speed.py --sweeps 9700         of 6 GB
    python benchmarks/ingest_speed.py --recording FILE.mcap

Both sides run in turn, each in a process of its own, several times; the table gives medians and peak memory, and goes
to results/.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

POINTS, RINGS, PERIOD_NS, IMU_STEP_NS = 28_800, 16, 100_000_000, 5_000_000
HEAD = """\
| file | MB | mcap read + CRC, MB/s | ingest, MB/s | ratio | ingest, peak MiB |
| --- | ---: | ---: | ---: | ---: | ---: |"""
START_NS = 1_790_000_000_000_000_000


def make_recording(path: Path, sweeps: int, compression: str) -> None:
    """A recording as a velodyne driver and rosbag2 leave it: 22-byte points, seconds after the header, NaN-free."""
    from mcap.writer import CompressionType, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    rng = np.random.default_rng(7)
    cloud, imu = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"
    stamp, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    vector, field = types["geometry_msgs/msg/Vector3"], types["sensor_msgs/msg/PointField"]
    names = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)]
    fields = [field(name, offset, datatype, 1) for name, offset, datatype in names]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType[compression.upper()])
        writer.start("ros2")
        channels = {}
        for topic, name in (("/velodyne_points", cloud), ("/imu/data", imu)):
            schema = writer.register_schema(name, "ros2msg", store.generate_msgdef(name, ros_version=2)[0].encode())
            channels[name] = writer.register_channel(topic, "cdr", schema)
        unknown = np.zeros(9)
        for k in range(sweeps):
            begin = START_NS + k * PERIOD_NS
            for now in range(begin, begin + PERIOD_NS, IMU_STEP_NS):
                gyro, accel = rng.normal(0, 0.1, 3), rng.normal([0, 0, 9.81], 0.2)
                message = types[imu](
                    header(stamp(*divmod(now, 10**9)), "imu_link"),
                    types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0),
                    unknown,
                    vector(*gyro),
                    unknown,
                    vector(*accel),
                    unknown,
                )
                writer.add_message(channels[imu], now, bytes(store.serialize_cdr(message, imu)), now)
            data = _points(rng, k)
            at = header(stamp(*divmod(begin, 10**9)), "velodyne")
            message = types[cloud](at, 1, POINTS, fields, False, 22, 22 * POINTS, data, True)
            end = begin + PERIOD_NS
            writer.add_message(channels[cloud], end, bytes(store.serialize_cdr(message, cloud)), end)
        writer.finish()


def _points(rng: np.random.Generator, k: int) -> np.ndarray:
    form = np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")])
    points = np.zeros(POINTS, form)
    at = np.arange(POINTS)
    azimuth = -2 * np.pi * at / POINTS
    elevation = np.deg2rad(-15 + 2 * (at % RINGS))
    shape = 3 + 0.5 * np.sin(3 * azimuth + 0.01 * k) + rng.normal(0, 0.02, POINTS)
    distance = np.round(np.minimum(shape / np.maximum(np.abs(np.cos(elevation)), 0.2), 100) / 0.002) * 0.002
    points["xyz"][:, 0] = distance * np.cos(elevation) * np.cos(azimuth)
    points["xyz"][:, 1] = distance * np.cos(elevation) * np.sin(azimuth)
    points["xyz"][:, 2] = distance * np.sin(elevation)
    points["intensity"] = rng.integers(0, 100, POINTS)
    points["ring"] = at % RINGS
    points["time"] = at * (PERIOD_NS * 1e-9 / POINTS)
    return points.view(np.uint8)


def read_only(path: Path) -> int:
    """What ingest is compared with."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        return sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())


def child(side: str, path: Path, out: Path, warm_up: Path) -> None:
    """One measurement in this process, printed as JSON; a small recording before it takes imports and compilation."""
    work: Callable[[Path], object]
    if side == "read":
        work = read_only
    else:
        from mineloc.stages.ingest import ingest

        def work(recording: Path) -> object:
            out.unlink(missing_ok=True)
            return ingest(recording, out=out)

    work(warm_up)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    work(path)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sys.stdout.write(json.dumps({"seconds": seconds, "peak_mib": peak / 1024, "imports_mib": before / 1024}))


def measure(side: str, path: Path, out: Path, warm_up: Path) -> dict[str, float]:
    line = [sys.executable, __file__, "--child", side, "--recording", str(path), "--out", str(out)]
    line += ["--warm-up", str(warm_up)]
    return json.loads(subprocess.run(line, check=True, capture_output=True, text=True).stdout)


def compare(what: str, path: Path, out: Path, repeats: int) -> str:
    """A row of the table: both sides in turn, medians."""
    warm_up = out.with_name("warm_up.mcap")
    make_recording(warm_up, 60, "lz4")
    runs = [tuple(measure(side, path, out, warm_up) for side in ("read", "ingest")) for _ in range(repeats)]
    megabytes = path.stat().st_size / 1e6
    seconds = [statistics.median(run[side]["seconds"] for run in runs) for side in (0, 1)]
    peak = max(run[1]["peak_mib"] for run in runs)
    ratio = statistics.median(read["seconds"] / ingest["seconds"] for read, ingest in runs)
    speeds = " | ".join(f"{megabytes / s:.0f}" for s in seconds)
    row = f"| {what} | {megabytes:.0f} | {speeds} | {ratio:.2f} | {peak:.0f} |"
    print(row, flush=True)
    return row


def compare_all(folder: Path, sweeps: int, repeats: int) -> list[str]:
    """Every compression that rosbag2 writes, and a flight that ingest made."""
    rows: list[str] = []
    out = folder / "out.mcap"
    for compression in ("lz4", "zstd", "none"):
        path = folder / "recording.mcap"
        make_recording(path, sweeps, compression)
        rows.append(compare(f"recording, {compression}", path, out, repeats))
    flight = out.rename(folder / "flight.mcap")
    rows.append(compare("canonical flight", flight, out, repeats))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", type=Path, help="measure this one, and write no results")
    parser.add_argument("--sweeps", type=int, default=1800, help="of the recordings that are made; ten a second")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="where files are made; the system's temporary folder otherwise")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results" / "ingest_speed.md")
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--warm-up", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--child", choices=["read", "ingest"], help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.child:
        child(given.child, given.recording, given.out, given.warm_up)
        return
    load = "load {:.1f} {:.1f} {:.1f}".format(*os.getloadavg())
    print(HEAD)
    with tempfile.TemporaryDirectory(dir=given.folder) as name:
        if given.recording is not None:
            compare(given.recording.name, given.recording, Path(name) / "out.mcap", given.repeats)
            return
        rows = compare_all(Path(name), given.sweeps, given.repeats)
    command = f"python benchmarks/ingest_speed.py --sweeps {given.sweeps} --repeats {given.repeats}"
    about = f"`{command}`, {load} when started, {os.cpu_count()} cores; medians; asked: a ratio of 0.60."
    given.results.parent.mkdir(parents=True, exist_ok=True)
    given.results.write_text("\n".join(["# Ingest against reading", "", about, "", HEAD, *rows, ""]))


if __name__ == "__main__":
    main()
