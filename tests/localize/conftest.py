"""The database of two drawn intersections, made once."""

from __future__ import annotations

import numpy as np
import pytest
from plan_scenes import drawn, mapped, surveyed

from mineloc.config import Config
from mineloc.data import IntersectionDatabase
from mineloc.places.database import database_of
from mineloc.places.segmentation import intersections_of


@pytest.fixture(scope="session")
def database() -> IntersectionDatabase:
    """A T at the origin and a crossing 30 m east of it."""
    config, sheet = Config().intersections, drawn()
    found = intersections_of(sheet, surveyed(), mapped(sheet), config)
    return database_of(found, config, grid_origin_m=np.zeros(3), is_grid=False, map_sha256="")
