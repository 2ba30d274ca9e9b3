"""Recognition where nobody tuned it, and where it must refuse: other meshes, changed mines, wrong maps.

    .venv/bin/python benchmarks/recognition.py --work FOLDER [--edgar MAP DB.mcap]

For each mesh a mapping flight past targets becomes a map and a database, and another flight is localized by its
intersections, from a known start and from nowhere. Then the wrong inputs, most with the Edgar Mine's database (that of
`paper_a.py`, or made here): a mine changed since it was mapped, another mine's flight, a start told 50 m off, a mine
without an intersection. Writes results/recognition.md. What is in FOLDER already is not made again.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from edgar_map import MESH, mineloc
from paper_a import simulated, start_of

from mineloc.sim.mine import load_mine

ROOT = Path(__file__).resolve().parents[1]
MESHES = MESH.parents[1]
OTHERS = {"gm_kum": "gm_kum", "tunnel_qual": "tunnel_qual", "edgar_stix": "edgar_stix"}
MAPPING_SEED, SEED, CHANGED_SEED = 221, 321, 331
COLUMNS = (
    "case", "start", "length m", "accepted", "wrong", "precision %", "passages", "recall %", "RMSE m", "max m",
    "online max m", "found after m", "what was told most",
)  # fmt: skip


@dataclass(frozen=True)
class Known:
    """A map and the database of its intersections."""

    folder: Path
    database: Path


def mesh_file(name: str) -> Path:
    """The one mesh in a folder of the data."""
    found = sorted(path for path in (MESHES / name).iterdir() if path.suffix in (".ply", ".stl", ".obj", ".dae"))
    if not found:
        raise SystemExit(f"{MESHES / name}: no mesh")
    return found[0]


def mapped(work: Path, mesh: Path, length_m: float) -> Known:
    """Map and database by a flight of their own."""
    flight = simulated(work / "mapping.mcap", mesh, length_m, MAPPING_SEED, {"target_every_m": 150.0})
    known = Known(work / "map", work / "map.intersections.mcap")
    if not known.folder.exists():
        mineloc("reconstruct", flight, "--out", known.folder)
    if not known.database.exists():
        mineloc("database", known.folder, "--out", known.database)
    return known


def localized(run: Path, flight: Path, known: Known, start: tuple[list[float], int] | None) -> dict[str, Any]:
    """The evaluation of a run by intersections; without `start` the flight may be anywhere."""
    options: list[str] = []
    if start is not None:
        options = ["--set", f"prior_map.start_m={json.dumps(start[0])}", "--set", f"prior_map.start_yaw_deg={start[1]}"]
    if not run.exists():
        mineloc(
            "localize", flight, "--method", "intersections_map", "--database", known.database, "--out", run,
            "--no-recording", *options,
        )  # fmt: skip
    manifest = json.loads((run / "manifest.json").read_text())
    return {"found": manifest["map"]["found"], **json.loads(mineloc("evaluate", run, "--json")[0])}


def row(case: str, start: str, result: dict[str, Any], run: Path) -> str:
    """One line of the table."""
    scored = {one["name"]: one for one in result["trajectories"]}
    length_m = scored["smoothed"]["coverage"]["reference_path_m"]
    known = result["recognition"]
    if known is None:
        cells = [case, start, f"{length_m:.0f}", "0", "0", "-", "-", "-", "-", "-", "-", "not found", most_told(run)]
        return "| " + " | ".join(cells) + " |"
    errors = {
        name: next(row for row in one["aligned"] if row["alignment"] == "none")["ape"]["translation_m"]
        for name, one in scored.items()
    }
    percent = {key: "-" if known[key] is None else f"{100 * known[key]:.1f}" for key in ("precision", "recall")}
    first = "-" if known["first_m"] is None else f"{known['first_m']:.0f}"
    cells = [
        case, start, f"{length_m:.0f}", str(known["accepted"]), str(known["wrong"]), percent["precision"],
        str(len(known["passages"])), percent["recall"], f"{errors['smoothed']['rmse']:.3f}",
        f"{errors['smoothed']['max']:.3f}", f"{errors['online']['max']:.3f}", first, most_told(run),
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def most_told(run: Path) -> str:
    """The most frequent reason of a refusal after a junction was seen, its numbers left out."""
    import polars as pl

    table = pl.read_parquet(run / "fixes.parquet").filter(~pl.col("trusted") & ~pl.col("reason").str.contains("step 2"))
    reasons = table["reason"].str.replace_all(r"[0-9.]+", "…").value_counts(sort=True)
    return f"{reasons['reason'][0]} ({reasons['count'][0]} times)" if len(reasons) else "no junction was seen"


def changes(mesh: Path, *, every: int = 3) -> dict[str, str]:
    """A third of the intersections walled up on one side, another third widened by a metre."""
    graph = load_mine(mesh).graph
    closed: list[list[float]] = []
    widened: list[list[float]] = []
    at_node, above = graph.at_node(), np.array([0.0, 0.0, 1.2])
    for k, node in enumerate(graph.intersections):
        place = graph.nodes_m[node]
        if k % every == 0:
            road = graph.roadways[at_node[node][0]]
            line = road.line_m if road.a == node else road.line_m[::-1]
            way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
            if way[-1] < 14.0:
                continue
            here, ahead = (np.array([np.interp(m, way, axis) for axis in line.T]) for m in (4.0, 5.0))
            bearing = float(np.degrees(np.arctan2(*(ahead - here)[1::-1])))
            closed.append([*np.round(here + above, 2).tolist(), round(bearing, 1)])
        elif k % every == 1:
            widened.append([*np.round(place + above, 2).tolist(), 8.0, 1.0])
    return {"closed": json.dumps(closed), "widened": json.dumps(widened)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for flights and results (50 GB)")
    parser.add_argument("--edgar", type=Path, nargs=2, metavar=("MAP", "DB"), help="map and database of the Edgar Mine")
    parser.add_argument("--length-m", type=float, default=1500.0)
    parser.add_argument("--meshes", nargs="*", default=list(OTHERS), choices=OTHERS)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "recognition.md")
    chosen = parser.parse_args()
    work = chosen.work.absolute()
    lines = ["| " + " | ".join(COLUMNS) + " |", "| --- | --- " + "| ---: " * (len(COLUMNS) - 3) + "| --- |"]
    flights: dict[str, Path] = {}
    for name in chosen.meshes:
        folder = work / name
        folder.mkdir(parents=True, exist_ok=True)
        mesh = mesh_file(OTHERS[name])
        known = mapped(folder, mesh, 1.6 * chosen.length_m)
        flight = flights[name] = simulated(folder / "flight.mcap", mesh, chosen.length_m, SEED, {})
        for start, told in (("known", start_of(flight)), ("nowhere", None)):
            run = folder / f"run-{start}"
            lines.append(row(name, start, localized(run, flight, known, told), run))
    edgar = work / "edgar"
    edgar.mkdir(parents=True, exist_ok=True)
    known = mapped(edgar, MESH, 5000.0) if chosen.edgar is None else Known(*(path.absolute() for path in chosen.edgar))
    changed = simulated(edgar / "changed.mcap", MESH, chosen.length_m, CHANGED_SEED, changes(MESH))
    for start, told in (("known", start_of(changed)), ("nowhere", None)):
        run = edgar / f"run-changed-{start}"
        lines.append(row("Edgar, changed", start, localized(run, changed, known, told), run))
    place_m, yaw_deg = start_of(changed)
    run = edgar / "run-shifted"
    off = ([place_m[0] + 30.0, place_m[1] + 40.0, place_m[2]], yaw_deg)
    lines.append(row("Edgar, start told 50 m off", "known", localized(run, changed, known, off), run))
    straight = simulated(edgar / "straight.mcap", "straight", 300.0, SEED, {})
    strangers = {**flights, "straight": straight}
    for name, flight in strangers.items():
        run = edgar / f"run-{name}"
        lines.append(row(f"{name} in Edgar's database", "nowhere", localized(run, flight, known, None), run))
    text = "\n".join(lines)
    print(text)
    command = f"`python benchmarks/recognition.py --length-m {chosen.length_m:g}`"
    head = f"{command}; seeds {MAPPING_SEED} (mapping), {SEED} and {CHANGED_SEED} (changed mine)."
    chosen.out.write_text(f"# Recognition elsewhere, and where it must refuse\n\n{head}\n\n{text}\n")


if __name__ == "__main__":
    main()
