"""mineloc's odometry against its peers: one flight, the same cores, one after the other, judged alike.

    python benchmarks/odometry_peers.py                          makes the flight of the committed table and runs all
    python benchmarks/odometry_peers.py --flight FLIGHT.mcap     another canonical flight with a reference
    python benchmarks/odometry_peers.py --systems mineloc,rko_lio --sweeps 500

Each system runs in a process of its own: mineloc's in this environment, the peers' in `.venv-peers`, which
`make -C benchmarks peers` makes. Flight and runs stay in `--work`; the table goes to `benchmarks/results/`.
"""

from __future__ import annotations

import argparse
import os
import platform
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
from odometry_scores import Score, as_json, load, score, table, trajectory

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.io.flight import FlightReader

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
RUNNER = HERE / "peers" / "run_odometry.py"
MESH = ROOT.parent / "shared" / "data" / "meshes" / "edgar_mine" / "edgar_mine_rough_200k.ply"
LENGTH_M, SEED = 1200, 31
WARM_SWEEPS = 60
CORES = 2
# name: (title, uses the IMU, is a peer)
SYSTEMS = {
    "mineloc": ("**mineloc**", True, False),
    "mineloc_no_imu": ("**mineloc**, no IMU", False, False),
    "loam": ("LOAM (mineloc's baseline)", False, False),
    "kiss_icp": ("kiss-icp", False, True),
    "genz_icp": ("genz-icp", False, True),
    "small_gicp": ("small_gicp, GICP to a submap", False, True),
    "small_vgicp": ("small_gicp, VGICP to a voxel map", False, True),
    "rko_lio": ("rko_lio", True, True),
}


def simulate(flight: Path, mesh: Path) -> None:
    """Make the flight of the committed table."""
    arguments = ["simulate", str(mesh), "--out", str(flight), "--length-m", str(LENGTH_M), "--seed", str(SEED)]
    subprocess.run([sys.executable, "-m", "mineloc.cli", *arguments], check=True)


def run(name: str, flight: Path, out: Path, *, peers: Path, sweeps: int | None) -> None:
    """One system in a process of its own; a crash leaves no `out` and a line on the screen."""
    python = peers if SYSTEMS[name][2] else Path(sys.executable)
    command = [str(python), str(RUNNER), name, str(flight), str(out)]
    command += [] if sweeps is None else ["--sweeps", str(sweeps)]
    with out.with_suffix(".log").open("w") as log:
        code = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT).returncode
    if code:
        print(f"{name}: ended with {code}, see {log.name}", file=sys.stderr)


def run_all(given: argparse.Namespace, flight: Path) -> dict[str, Path]:
    """Files of the systems that left one. A short run before each fills the caches of compiler and disk."""
    found: dict[str, Path] = {}
    for name in given.names:
        out = given.work / f"{name}.npz"
        if not (given.resume and out.exists()):
            out.unlink(missing_ok=True)
            print(f"{name} ({load_average()})", file=sys.stderr, flush=True)
            run(name, flight, given.work / "warm.npz", peers=given.peers, sweeps=WARM_SWEEPS)
            run(name, flight, out, peers=given.peers, sweeps=given.sweeps)
        if out.exists():
            found[name] = out
    return found


def load_average() -> str:
    return "load {:.1f} {:.1f} {:.1f}".format(*os.getloadavg())


def machine(cores: int) -> str:
    """One line: processor, cores used, memory."""
    info = Path("/proc/cpuinfo")
    model = platform.processor()
    if info.exists():
        model = next(
            (x.split(":")[1].strip() for x in info.read_text().splitlines() if x.startswith("model name")), model
        )
    gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{model}, {cores} cores used, {gib:.0f} GiB, {platform.system()}, Python {platform.python_version()}"


def plot(files: dict[str, Path], reference: Trajectory, T_lidar_body: np.ndarray, out: Path) -> None:
    """Every estimate over the reference, first poses laid on each other, seen from above."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(4, len(files))
    rows = -(-len(files) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(5 * columns, 5 * rows), squeeze=False)
    for axis, (name, path) in zip(axes.flat, files.items(), strict=False):
        estimate = trajectory(*load(path), T_lidar_body)
        start = reference.at(np.clip(estimate.stamps_ns[:1], reference.stamps_ns[0], reference.stamps_ns[-1]))[0]
        laid = start @ se3.inverse(estimate.poses[0]) @ estimate.poses
        axis.plot(*reference.positions_m[:, :2].T, color="0.7", lw=3)
        axis.plot(*laid[:, :2, 3].T, color="tab:red", lw=1)
        axis.set_title(SYSTEMS[name][0].replace("*", ""))
        axis.set_aspect("equal", "datalim")
    figure.tight_layout()
    figure.savefig(out, dpi=70)


def report(files: dict[str, Path], flight: Path, about: dict[str, str], out: Path, picture: Path | None) -> None:
    """Score, print, write the two files, and the picture if wanted."""
    with FlightReader(flight) as reader:
        reference, T_lidar_body = reader.reference(), se3.inverse(reader.calibration.T_body_lidar)
        facts = f"{reader.sweep_count} sweeps in {reader.duration_s:.0f} s, {reader.info.lidar}"
    if reference is None:
        raise SystemExit(f"{flight}: no reference poses, nothing to compare with")
    about["flight"] = f"{reference.path_m[-1]:.0f} m, {facts}"
    scores: list[Score] = [score(path, reference, T_lidar_body) for path in files.values()]
    titles = {name: (title, imu) for name, (title, imu, _) in SYSTEMS.items()}
    text = table(scores, titles)
    print(text)
    out.mkdir(parents=True, exist_ok=True)
    lines = "\n".join(f"- {key}: {value}" for key, value in about.items())
    (out / "odometry_peers.md").write_text(f"# Odometry against its peers\n\n{lines}\n\n{text}\n")
    (out / "odometry_peers.json").write_text(as_json(scores, about))
    if picture is not None:
        plot(files, reference, T_lidar_body, picture)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flight", type=Path, help="a canonical flight; simulated if it is not given")
    parser.add_argument("--mesh", type=Path, default=MESH, help="mine of the simulated flight")
    parser.add_argument("--work", type=Path, default=HERE / "work", help="where flight (4 GB) and runs are kept")
    parser.add_argument("--out", type=Path, default=HERE / "results")
    parser.add_argument("--systems", default=",".join(SYSTEMS), help="comma-separated; default: %(default)s")
    parser.add_argument("--sweeps", type=int, help="only so many from the start")
    parser.add_argument("--cores", type=int, default=CORES, help="every system runs on the same so many")
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-peers" / "bin" / "python", help="their Python")
    parser.add_argument("--resume", action="store_true", help="do not repeat the runs that are in --work")
    parser.add_argument("--plot", type=Path, help="picture of the trajectories to write (.png .svg)")
    given = parser.parse_args()
    given.names = given.systems.split(",")
    if unknown := set(given.names) - set(SYSTEMS):
        parser.error(f"unknown systems {sorted(unknown)}; there are {', '.join(SYSTEMS)}")
    if not given.peers.exists() and any(SYSTEMS[name][2] for name in given.names):
        parser.error(f"{given.peers}: no environment of the peers; make it with: make -C benchmarks peers")
    if given.flight is None and not given.mesh.exists():
        parser.error(f"{given.mesh}: no such mesh; give one with --mesh, or a flight with --flight")
    return given


def command(given: argparse.Namespace) -> str:
    """What was typed, without folders of the machine."""
    words = ["python", "benchmarks/odometry_peers.py"]
    words += ["--flight", given.flight.name] if given.flight else []
    words += ["--systems", given.systems] if given.names != list(SYSTEMS) else []
    words += ["--sweeps", str(given.sweeps)] if given.sweeps else []
    words += ["--cores", str(given.cores)] if given.cores != CORES else []
    words += ["--resume"] if given.resume else []
    return shlex.join(words)


def main() -> None:
    given = arguments()
    cores = sorted(os.sched_getaffinity(0))[: given.cores]
    os.sched_setaffinity(0, cores)
    given.work.mkdir(parents=True, exist_ok=True)
    about = {"command": command(given), "machine": machine(len(cores))}
    flight = given.flight
    if flight is None:
        flight = given.work / f"edgar_{LENGTH_M}_{SEED}.mcap"
        if not flight.exists():
            simulate(flight, given.mesh)
        about["flight made by"] = f"mineloc simulate {given.mesh.name} --length-m {LENGTH_M} --seed {SEED}"
    about["load when started"] = load_average()
    files = run_all(given, flight)
    report(files, flight, about, given.out, given.plot)


if __name__ == "__main__":
    main()
