"""The README's table of maps: one mapping flight through the Edgar Mine, from simulation to the map's error.

    .venv/bin/python benchmarks/edgar_map.py --work FOLDER

flies `--length-m` through the mesh past surveyed targets (a seed used for nothing else), reconstructs the flight with
loop closures alone and with control points, and scores trajectory and map against the mine itself: the trajectory by
`mineloc evaluate`, the walls by their distance to the mesh, each piece of 20 m after its own alignment. The table goes
between the markers in README.md, two pictures to `--pictures`. What is in FOLDER already is not made again.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from map_pictures import cross_section, top_view
from readme_table import write_readme

from mineloc import se3
from mineloc.data import SurfaceKind, Trajectory
from mineloc.io.flight import FlightReader
from mineloc.io.trajectories import write_tum
from mineloc.metrics.alignment import umeyama
from mineloc.metrics.map_quality import MapQuality, map_quality, pieces_along
from mineloc.sim.mesh_file import read_mesh
from mineloc.sim.scene import Scene
from mineloc.stages.map_folder import MapFolder
from mineloc.stages.run_tables import poses_of

ROOT = Path(__file__).resolve().parents[1]
MESH = ROOT.parent / "shared" / "data" / "meshes" / "edgar_mine" / "edgar_mine_rough_200k.ply"
RUNS = {"loops": ("loop closures alone", ["--no-control"]), "control": ("and control points", [])}
COLUMNS = (
    "map from", "RMSE m (none)", "RMSE m (origin)", "RMSE m (se3)", "max m (se3)", "check points RMSE m",
    "walls: median m", "worst piece m", "p95 m", "loops", "false loops", "roadways m", "times real time", "peak GB",
)  # fmt: skip
FALSE_M, FALSE_DEG = 1.0, 5.0


def mineloc(*arguments: str | Path) -> tuple[str, float, float]:
    """Run the command line; its standard output, seconds, and peak memory in GB."""
    command = [sys.executable, "-m", "mineloc.cli", *map(str, arguments)]
    print("$ mineloc", *map(str, arguments), file=sys.stderr, flush=True)
    start = perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"failed: {' '.join(command)}")
    return text, perf_counter() - start, usage.ru_maxrss / 1e6


def simulated(work: Path, mesh: Path, length_m: float, seed: int, every_m: float) -> Path:
    """The flight, past targets in a grid that is neither the mesh's frame nor small."""
    flight = work / "flight.mcap"
    if not flight.exists():
        grid = {"grid_e_m": 512_000, "grid_n_m": 4_398_000, "grid_z_m": 2_300, "grid_yaw_deg": 30}
        options = [f"simulate.{key}={value}" for key, value in {"target_every_m": every_m, **grid}.items()]
        sets = [word for option in options for word in ("--set", option)]
        mineloc("simulate", mesh, "--out", flight, "--length-m", str(length_m), "--seed", str(seed), *sets)
    return flight


def reconstructed(flight: Path, out: Path, options: list[str]) -> dict[str, Any]:
    """What `reconstruct` says of itself, with its peak memory."""
    kept = out.with_suffix(".json")
    if not out.exists():
        text, _, peak_gb = mineloc("reconstruct", flight, "--out", out, "--json", *options)
        kept.write_text(json.dumps({**json.loads(text), "peak_gb": peak_gb}, indent=1))
    return json.loads(kept.read_text())


def truth_of(flight: Path, survey: MapFolder) -> Trajectory:
    """`T_map_body` of the mine itself, in the frame of the map where that is the grid's."""
    with FlightReader(flight) as reader:
        reference = reader.reference()
        assert reference is not None
        if not survey.manifest["frame"]["is_grid"]:
            return reference
        T_grid_map = np.array(json.loads(reader.attachment("grid.json"))["T_grid_map"])
    T_grid_map[:3, 3] -= survey.grid_origin_m
    return reference.compose(left=T_grid_map)


def trajectory_errors(survey: MapFolder, truth: Trajectory, work: Path) -> dict[str, dict[str, float]]:
    """APE by alignment."""
    path = work / f"{survey.path.name}_truth.tum"
    write_tum(path, truth, overwrite=True)
    text, _, _ = mineloc("evaluate", survey.path / "trajectory.tum", "--reference", path, "--json")
    rows = json.loads(text)["trajectories"][0]["aligned"]
    return {row["alignment"]: row["ape"]["translation_m"] for row in rows}


def wall_errors(survey: MapFolder, truth: Trajectory, mesh: Path, flight: Path) -> MapQuality:
    """Distances of the map's wall points to the mesh."""
    estimate = survey.trajectories[next(iter(survey.trajectories))]
    within = np.clip(estimate.stamps_ns, truth.stamps_ns[0], truth.stamps_ns[-1])
    T_truth_map = umeyama(truth.at(within)[:, :3, 3], estimate.positions_m)
    with FlightReader(flight) as reader:
        T_grid_map = np.eye(4)
        if survey.manifest["frame"]["is_grid"]:
            T_grid_map = np.array(json.loads(reader.attachment("grid.json"))["T_grid_map"])
            T_grid_map[:3, 3] -= survey.grid_origin_m
    T_mesh_map = se3.inverse(T_grid_map) @ T_truth_map
    walls = se3.apply(T_mesh_map, survey.cloud().of_kind(SurfaceKind.WALL).points_map)
    line = se3.apply(T_mesh_map, estimate.positions_m)
    scene = Scene(*read_mesh(mesh))
    return map_quality(walls, pieces_along(walls, line), scene.nearest_m)


def false_loops(survey: MapFolder, truth: Trajectory, flight: Path) -> int:
    """Accepted closures whose relative pose is wrong by more than a metre or five degrees."""
    with FlightReader(flight) as reader:
        T_body_lidar = reader.calibration.T_body_lidar
    stamps = survey.keyframes["stamp_ns"].to_numpy()
    true = truth.at(np.clip(stamps, truth.stamps_ns[0], truth.stamps_ns[-1])) @ T_body_lidar
    believed = poses_of(survey.keyframes)
    accepted = survey.fixes.filter(survey.fixes["trusted"])
    wrong = 0
    for (j, target), T in zip(accepted.select("keyframe", "target").iter_rows(), poses_of(accepted), strict=True):
        i = int(target.removeprefix("keyframe "))
        error = se3.inverse(se3.inverse(true[i]) @ true[j]) @ se3.inverse(believed[i]) @ T
        wrong += np.linalg.norm(error[:3, 3]) > FALSE_M or np.degrees(se3.angle_rad(error)) > FALSE_DEG
    return wrong


def row(name: str, result: dict[str, Any], errors: dict[str, dict[str, float]], walls: MapQuality, false: int) -> str:
    """One line of the table."""
    control = result["control"]
    known = walls.median_m[np.isfinite(walls.median_m)]
    is_grid = control is not None
    cells = [
        RUNS[name][0],
        f"{errors['none']['rmse']:.3f}" if is_grid else "-",
        f"{errors['origin']['rmse']:.3f}",
        f"{errors['se3']['rmse']:.3f}",
        f"{errors['se3']['max']:.3f}",
        f"{control['check_m']:.3f}" if is_grid and control["check_m"] is not None else "-",
        f"{walls.overall_median_m:.4f}",
        f"{known.max():.4f}",
        f"{walls.overall_p95_m:.3f}",
        str(result["loops"]),
        str(false),
        f"{result['roadways_m']:.0f}",
        f"{result['real_time_factor']:.1f}",
        f"{result['peak_gb']:.2f}",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for the flight (16 GB) and the maps")
    parser.add_argument("--mesh", type=Path, default=MESH)
    parser.add_argument("--length-m", type=float, default=5000.0)
    parser.add_argument("--seed", type=int, default=201)
    parser.add_argument("--target-every-m", type=float, default=250.0)
    parser.add_argument("--pictures", type=Path, help="folder for the pictures")
    parser.add_argument("--no-readme", action="store_true", help="print the table only")
    chosen = parser.parse_args()
    if not chosen.mesh.exists():
        parser.error(f"{chosen.mesh}: no such mesh; give one with --mesh")
    chosen.work.mkdir(parents=True, exist_ok=True)
    flight = simulated(chosen.work, chosen.mesh, chosen.length_m, chosen.seed, chosen.target_every_m)
    lines = ["| " + " | ".join(COLUMNS) + " |", "| --- " + "| ---: " * (len(COLUMNS) - 1) + "|"]
    path_m = duration_s = 0.0
    for name, (_, options) in RUNS.items():
        result = reconstructed(flight, chosen.work / name, options)
        survey = MapFolder.open(chosen.work / name)
        truth = truth_of(flight, survey)
        path_m, duration_s = float(truth.path_m[-1]), float(truth.stamps_ns[-1] - truth.stamps_ns[0]) * 1e-9
        errors = trajectory_errors(survey, truth, chosen.work)
        walls = wall_errors(survey, truth, chosen.mesh, flight)
        lines.append(row(name, result, errors, walls, false_loops(survey, truth, flight)))
        if chosen.pictures is not None and name == "control":
            top_view(survey, chosen.pictures / "edgar_map_top_view.png")
            cross_section(survey, chosen.pictures / "edgar_map_cross_section.png")
    flown = (
        f"`python benchmarks/edgar_map.py --length-m {chosen.length_m:g} --seed {chosen.seed} "
        f"--target-every-m {chosen.target_every_m:g}`: {path_m:.0f} m in {duration_s:.0f} s, VLP-16, "
        f"mesh `{chosen.mesh.stem}`."
    )
    print(flown, *lines, sep="\n")
    if not chosen.no_readme:
        write_readme("map", "\n".join(lines), flown)


if __name__ == "__main__":
    main()
