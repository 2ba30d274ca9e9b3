"""A synthetic run that was localized by the intersections of a database, and that database: every outcome once.

The truth is known: `T 0` is recognised three times, `MISSED` is passed and refused, `WRONG` is recognised two metres
off, `bay 3` is passed without a look, `X 4` lies elsewhere.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from synthetic_run import PERIOD_NS, START_NS, T_BODY_LIDAR

from mineloc import se3
from mineloc.config import Config
from mineloc.data import Fix, Intersection, Sight, WallContour
from mineloc.io.intersection_database import write_database
from mineloc.places.database import database_of
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.run_tables import fixes_table, intersections_table

MISSED = '<b>"Кривая & 1'
WRONG = '矿井/2 \'id="x"'
ORIGIN = np.array([512_000.0, 4_397_000.0, 2_000.0])
MAP = "cd" * 32
ACCEPTED = {
    "id": 0.0,
    "branches": 3.0,
    "walls": 120.0,
    "similarity": 0.91,
    "matched_similarity": 0.83,
    "candidates": 2.0,
    "matrix": 0.64,
    "matrix_second": 0.41,
    "same": 2.0,
    "completeness": 0.9,
    "inlier_ratio": 0.87,
    "residual_m": 0.021,
    "moved_m": 0.4,
    "sigmas": 1.3,
}


def recognition_run(folder: Path, source: Path, *, reference: bool = True, found: bool = True) -> tuple[Path, Path]:
    """The run folder and the database, written into `folder`; `source` is a synthetic run of 1500 poses."""
    run, database = folder / "recognition", folder / "intersections.mcap"
    shutil.copytree(source, run)
    truth = RunFolder.open(source).reference
    known = intersections([truth.poses[k, :3, 3] for k in (203, 504, 805, 1106)])
    table = fixes_table(_fixes(truth.poses @ T_BODY_LIDAR, found))
    table.write_parquet(run / "fixes.parquet")
    intersections_table(known).write_parquet(run / "intersections.parquet")
    if not reference:
        (run / "reference.tum").unlink()
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["configuration"] = json.loads(Config().model_dump_json(include={"intersections", "prior_map"}))
    manifest["map"] = {"manifest_sha256": MAP, "grid_origin_m": ORIGIN.tolist(), "is_grid": True, "found": found}
    (run / "manifest.json").write_text(json.dumps(manifest))
    section = Config().intersections
    write_database(database, database_of(known, section, grid_origin_m=ORIGIN, is_grid=True, map_sha256=MAP))
    return run, database


def intersections(places: list[np.ndarray]) -> list[Intersection]:
    """Four that are flown through, 1.3 m below the flight, and one far away."""
    names = ("T 0", MISSED, WRONG, "bay 3", "X 4")
    points = [place - [0.0, 0.0, 1.3] for place in places] + [np.array([60.0, 60.0, 40.0])]
    return [_intersection(id, name, point) for id, (name, point) in enumerate(zip(names, points, strict=True))]


def _intersection(id: int, name: str, point: np.ndarray) -> Intersection:
    rng = np.random.default_rng(id)
    bearing = 2 * np.pi * np.arange(180) / 180
    branches = np.array([0.3, 2.2, 4.4])
    gap = np.abs(np.angle(np.exp(1j * (bearing[:, None] - branches)))).min(axis=1) < 0.25
    distance = np.where(gap, 0, 0.25).astype(np.float32)  # walls 2 m around the point
    turn = rng.uniform(0, 2 * np.pi, 900)
    walls = np.column_stack([2 * np.cos(turn), 2 * np.sin(turn), rng.uniform(0, 3, 900)])
    roof = np.column_stack([rng.uniform(-1.4, 1.4, (100, 2)), np.full(100, 3.0)])
    inward = np.concatenate([walls * [-0.5, -0.5, 0], np.tile([0.0, 0.0, -1.0], (100, 1))])
    return Intersection(
        id=id,
        name=name,
        kind="bay" if name.startswith("bay") else "T",
        point_map=point,
        covariance_m2=np.eye(3) * 0.01,
        contour=WallContour(distance, np.where(gap, Sight.OPEN, Sight.WALL).astype(np.uint8), 8.0, branches),
        matrix=rng.uniform(0, 1, (20, 180)).astype(np.float32),
        points_m=np.concatenate([walls, roof]).astype(np.float32),
        normals=inward.astype(np.float32),
        neighbours=(),
        quality=0.9,
    )


def _fixes(lidar: np.ndarray, found: bool) -> list[Fix]:
    off = se3.from_rt(np.eye(3), np.array([0.0, 2.0, 0.0]))
    accepted = {28: (0, "T 0", np.eye(4)), 29: (0, "T 0", np.eye(4)), 31: (0, "T 0", np.eye(4)), 115: (2, WRONG, off)}
    out: list[Fix] = []
    for k in range(20, 130):
        stamp = START_NS + PERIOD_NS * 7 * k
        if found and k in accepted:
            id, name, error = accepted[k]
            scores = {**ACCEPTED, "id": float(id), "inlier_ratio": 0.9 if k == 29 else 0.87}
            pose = lidar[7 * k] @ error
            out.append(Fix(stamp, k, pose, np.eye(6) * 1e-4, trusted=True, target=name, scores=scores))
            continue
        near = min((203, 504, 805), key=lambda row: abs(7 * k - row))
        out.append(Fix(stamp, k, None, None, trusted=False, reason=_reason(k, 7 * k - near), target=""))
    return out


def _reason(k: int, away: int) -> str:
    if abs(away) > 55:
        return "no intersection within reach (step 2)"
    return f"similarity {0.3 + 0.001 * k:.2f}, at least 0.50 needed (step 4)"
