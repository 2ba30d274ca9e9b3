"""Flights with true poses through simulated mines: the map against the mesh that the beams met."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mineloc.config import MapConfig, SimulateConfig
from mineloc.data import SurfaceKind
from mineloc.mapping.map_builder import MapBuilder
from mineloc.mapping.survey_map import SurveyMap, survey_map
from mineloc.metrics.map_quality import map_quality, pieces_along
from mineloc.roadways.graph import read_graph
from mineloc.sim.flight import SimulatedFlight
from mineloc.sim.mine import Mine, load_mine, planned_mine
from mineloc.sim.plan import MinePlan, RoughnessPlan, roadway
from mineloc.sweep.deskew import deskew_poses

GRID = np.array([500_000.0, 7_100_000.0, -350.0])
EDGAR = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "meshes" / "edgar_mine"


def _mapped(mine: Mine, config: SimulateConfig, every_m: float = 1.0) -> tuple[SurveyMap, np.ndarray]:
    """The map of a flight whose true poses are known, in a mine grid, and where it flew."""
    flight = SimulatedFlight(mine, config)
    builder = MapBuilder(MapConfig(), origin_m=GRID + np.round(mine.vertices_m.mean(axis=0)))
    flown = [np.full(3, np.inf)]
    for k in range(flight.sweeps):
        here = flight.motion.pose(np.array([k / config.lidar_hz]))[0, :3, 3] + GRID
        if np.linalg.norm(here - flown[-1]) < every_m:
            continue
        sweep = flight.sweep(k)
        stamps = sweep.stamp_ns + np.arange(106) * 1_000_000
        poses = flight.pose(stamps) @ flight.calibration.T_body_lidar
        poses[:, :3, 3] += GRID
        builder.insert(deskew_poses(sweep, stamps, poses, target_ns=int(stamps[50])).points_lidar, poses[50])
        flown.append(here)
    return survey_map(builder, np.array(flown[1:]), frame="grid"), np.array(flown[1:])


def _wall_quality(product: SurveyMap, flown_m: np.ndarray, mine: Mine) -> tuple[float, float]:
    walls = product.cloud.of_kind(SurfaceKind.WALL).points_map - GRID
    found = map_quality(walls, pieces_along(walls, flown_m - GRID), mine.scene.nearest_m)
    return float(np.nanmax(found.median_m)), found.overall_p95_m


def test_ramp_that_crosses_over_itself_becomes_one_roadway_of_its_true_size() -> None:
    line = [(0, 0, 0), (30, 0, 0), (30, 16, 2.5), (14, 16, 3.5), (14, -14, 6)]
    roughness = RoughnessPlan(wall_m=0.05, fine_m=0.01)
    mine = planned_mine(MinePlan(cell_m=0.3, roughness=roughness, roadway=(roadway(line),)), threads=1)
    product, flown = _mapped(mine, SimulateConfig(length_m=110, seed=1, speed_mps=3))
    (road,) = product.roadways.roadways
    assert road.length_m == pytest.approx(mine.graph.length_m, rel=0.06)
    # 4 m by 3.2 m as planned, rough
    assert np.nanmedian(road.width_m) == pytest.approx(4.0, abs=0.1)
    assert np.nanmedian(road.height_m) == pytest.approx(3.2, abs=0.1)
    rise = road.line_m[[0, -1], 2] - GRID[2]
    np.testing.assert_allclose(np.sort(rise), [0.0, 6.0], atol=0.4)
    # the faces at either end are seen from one side, once
    assert product.coverage.complete_share > 0.9
    worst, p95 = _wall_quality(product, flown, mine)
    # the issue asks for 3 cm with estimated poses; true ones leave the average of many points of 1-2 cm
    assert worst < 0.005
    assert p95 < 0.02
    assert product.cloud.frame == "grid"


@pytest.mark.slow
@pytest.mark.data
def test_edgar_mine_is_found_as_its_plan_knows_it() -> None:
    if not EDGAR.is_dir():
        pytest.skip("../shared/data/meshes is absent")
    mine = load_mine(EDGAR / "edgar_mine_rough_200k.ply", threads=2)
    product, flown = _mapped(mine, SimulateConfig(length_m=5000, seed=7))
    lines = np.concatenate([road.line_m for road in product.roadways.roadways])[:, :2] - GRID[:2]
    plan = read_graph(EDGAR / "edgar_graph.json")
    near = [
        (np.linalg.norm(road.line_m[:, None, :2] - lines[None], axis=2).min(axis=1) < 2.0).mean()
        for road in plan.roadways
    ]
    # two of 79 are blocked in this mesh, for the simulator too
    assert np.sum(np.array(near) >= 0.8) >= 76
    ours = product.roadways.nodes_m[product.roadways.intersections, :2] - GRID[:2]
    known = plan.nodes_m[plan.intersections, :2]
    apart = np.linalg.norm(known[:, None] - ours[None], axis=2)
    assert (apart.min(axis=1) < 4.0).sum() >= 39
    assert len(ours) <= 50
    assert product.coverage.complete_share > 0.97
    worst, _ = _wall_quality(product, flown, mine)
    assert worst < 0.01
