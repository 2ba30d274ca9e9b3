"""Recognition where nobody tuned it, and where it must refuse: other meshes, changed mines, wrong maps.

    .venv/bin/python benchmarks/recognition.py --work FOLDER [--edgar MAP DB.mcap] [--only CASE ...]

For each mesh a mapping flight past targets becomes a map and a database, and another flight is localized by its
intersections, from a known start and from nowhere. Then the wrong inputs, with the Edgar Mine's database (that of
`paper_a.py`, or made here): a mine changed since it was mapped, a start told 50 m off, another mine's flight, a mine
without an intersection. Writes results/recognition.md. What is in FOLDER already is not made again; `--only` makes
some of the cases, and the table has the rows of all that were ever made there.
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

from mineloc.sim.mine import Mine, load_mine

ROOT = Path(__file__).resolve().parents[1]
MESHES = MESH.parents[1]
MAPPING_M = {"gm_kum": 2400.0, "tunnel_qual": 3500.0, "edgar_stix": 2400.0}
"""Of the mapping flights through meshes that nothing was tuned on: enough to see what the other flight passes."""
CASES = (*MAPPING_M, "changed", "shifted", *(f"{mesh}_in_edgar" for mesh in (*MAPPING_M, "straight")))
MAPPING_SEED, SEED, CHANGED_SEED = 221, 321, 331
EXPLAINED = (
    "Nothing was tuned on these flights, nor on their meshes but Edgar's. Passages count bays too, recall does not. In "
    "the changed mine a third of the intersections are walled up on one side and a third are widened by a metre."
)
WIDENED_M = 8.0
"""Radius within which walls give way."""
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


def _wall_m(mine: Mine, place_m: np.ndarray) -> float:
    """How far the nearest wall is; where the mine is open to the sky, none may be near."""
    bearings = np.radians(np.arange(0.0, 360.0, 2.0))
    around = np.stack([np.cos(bearings), np.sin(bearings), np.zeros(len(bearings))], axis=1)
    return float(mine.scene.ranges_m(np.broadcast_to(place_m, around.shape), around).min())


def changes(mesh: Path, *, every: int = 3) -> dict[str, str]:
    """A third of the intersections walled up on one side, another third widened by a metre."""
    mine = load_mine(mesh)
    graph = mine.graph
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
        elif k % every == 1 and _wall_m(mine, place + above) < WIDENED_M:
            widened.append([*np.round(place + above, 2).tolist(), WIDENED_M, 1.0])
    return {"closed": json.dumps(closed), "widened": json.dumps(widened)}


class Bench:
    """The cases, each a flight, what is known of the mine, and what is told of the start.

    Args:
        work: folder of flights, maps and runs.
        length_m: of the flights.
        edgar: map and database of the Edgar Mine; None: made here when wanted.
    """

    def __init__(self, work: Path, length_m: float, edgar: Known | None) -> None:
        self._work, self._length_m, self._edgar = work, length_m, edgar

    def rows(self, case: str) -> list[str]:
        """Make a case; one row a start."""
        folder = self._work / case
        folder.mkdir(parents=True, exist_ok=True)
        if case in MAPPING_M:
            return self._both(case, folder, self._flight(case), mapped(folder, mesh_file(case), MAPPING_M[case]))
        if case == "changed":
            return self._both("Edgar, changed since", folder, self._changed(), self._of_edgar())
        if case == "shifted":
            (east, north, up), yaw_deg = start_of(self._changed())
            off = ([east + 30.0, north + 40.0, up], yaw_deg)
            return [self._row("Edgar, changed since", "told 50 m off", folder, self._changed(), self._of_edgar(), off)]
        named = f"{case.removesuffix('_in_edgar')} in Edgar's database"
        return [self._row(named, "nowhere", folder, self._stranger(case), self._of_edgar(), None)]

    def _both(self, name: str, folder: Path, flight: Path, known: Known) -> list[str]:
        told = start_of(flight)
        return [
            self._row(name, "known", folder / "known", flight, known, told),
            self._row(name, "nowhere", folder / "nowhere", flight, known, None),
        ]

    def _row(
        self, name: str, told: str, run: Path, flight: Path, known: Known, start: tuple[list[float], int] | None
    ) -> str:
        run = run / "run"
        run.parent.mkdir(parents=True, exist_ok=True)
        return row(name, told, localized(run, flight, known, start), run)

    def _flight(self, mesh: str) -> Path:
        return simulated(self._work / mesh / "flight.mcap", mesh_file(mesh), self._length_m, SEED, {})

    def _changed(self) -> Path:
        out = self._work / "changed" / "flight.mcap"
        out.parent.mkdir(parents=True, exist_ok=True)
        return simulated(out, MESH, self._length_m, CHANGED_SEED, changes(MESH))

    def _stranger(self, case: str) -> Path:
        mine = case.removesuffix("_in_edgar")
        if mine in MAPPING_M:
            return self._flight(mine)
        return simulated(self._work / case / "flight.mcap", mine, 300.0, SEED, {})

    def _of_edgar(self) -> Known:
        if self._edgar is None:
            (self._work / "edgar").mkdir(parents=True, exist_ok=True)
            self._edgar = mapped(self._work / "edgar", MESH, 5000.0)
        return self._edgar


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder for flights and results (50 GB)")
    parser.add_argument("--edgar", type=Path, nargs=2, metavar=("MAP", "DB"), help="map and database of the Edgar Mine")
    parser.add_argument("--length-m", type=float, default=1500.0)
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=CASES)
    parser.add_argument("--out", type=Path, default=ROOT / "benchmarks" / "results" / "recognition.md")
    chosen = parser.parse_args()
    work = chosen.work.absolute()
    told = work / "rows"
    told.mkdir(parents=True, exist_ok=True)
    bench = Bench(work, chosen.length_m, None if chosen.edgar is None else Known(*(p.absolute() for p in chosen.edgar)))
    for case in chosen.only:
        (told / f"{case}.md").write_text("\n".join(bench.rows(case)) + "\n")
    lines = ["| " + " | ".join(COLUMNS) + " |", "| --- | --- " + "| ---: " * (len(COLUMNS) - 3) + "| --- |"]
    lines += [(told / f"{case}.md").read_text().strip() for case in CASES if (told / f"{case}.md").exists()]
    text = "\n".join(lines)
    print(text)
    there = [case for case in CASES if (told / f"{case}.md").exists()]
    some = "" if there == list(CASES) else f" --only {' '.join(there)}"
    command = f"`python benchmarks/recognition.py --length-m {chosen.length_m:g}{some}`"
    head = f"{command}; seeds {MAPPING_SEED} (mapping), {SEED} and {CHANGED_SEED} (changed mine). {EXPLAINED}"
    chosen.out.write_text(f"# Recognition elsewhere, and where it must refuse\n\n{head}\n\n{text}\n")


if __name__ == "__main__":
    main()
