from __future__ import annotations

from pathlib import Path

import pytest

from mineloc.config import SimulateConfig
from mineloc.sim.flight import SimulatedFlight
from mineloc.sim.mine import Mine, load_mine, planned_mine
from mineloc.sim.plan import MinePlan, RoughnessPlan, roadway

MESHES = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "meshes"


@pytest.fixture(scope="session")
def meshes() -> Path:
    if not MESHES.is_dir():
        pytest.skip("../shared/data/meshes is absent")
    return MESHES


@pytest.fixture(scope="session")
def demo() -> Mine:
    return load_mine("demo", threads=1)


@pytest.fixture(scope="session")
def tee() -> Mine:
    """Three smooth drifts, 60 m in all, that meet at (20, 0)."""
    plan = MinePlan(
        name="tee",
        cell_m=0.3,
        roughness=RoughnessPlan(wall_m=0.0, fine_m=0.0),
        roadway=(roadway([(0, 0, 0), (40, 0, 0)]), roadway([(20, 0, 0), (20, 20, 1.0)])),
    )
    return planned_mine(plan, threads=1)


@pytest.fixture(scope="session")
def flight(demo: Mine) -> SimulatedFlight:
    """A flight with all its noise."""
    return SimulatedFlight(demo, SimulateConfig(length_m=120, seed=5))


@pytest.fixture(scope="session")
def calm(demo: Mine) -> SimulatedFlight:
    """The same without vibration: its speeds and accelerations are those of the flight plan."""
    return SimulatedFlight(demo, SimulateConfig(length_m=250, seed=5, vibration_mps2=0, vibration_degps=0))
