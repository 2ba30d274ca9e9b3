"""A map as a survey product: the cloud, where its floor, walls and roof are, its roadways, and what is missing."""

from __future__ import annotations

from dataclasses import dataclass

from mineloc.data import F64, MapCloud
from mineloc.mapping.free_space import free_sheet_of_map
from mineloc.mapping.map_builder import MapBuilder
from mineloc.mapping.map_coverage import Coverage, coverage
from mineloc.mapping.roadway_profiles import map_roadways
from mineloc.mapping.surface_kinds import classify
from mineloc.roadways.mapped import MappedRoadways


@dataclass(frozen=True, slots=True, eq=False)
class SurveyMap:
    """What a mapping flight delivers.

    Attributes:
        cloud: points of the surface, each floor, wall, roof or none of them.
        roadways: centre-lines, widths, heights, intersections.
        coverage: of pieces of roadway.
    """

    cloud: MapCloud
    roadways: MappedRoadways
    coverage: Coverage


def survey_map(builder: MapBuilder, flown_m: F64, *, frame: str = "map") -> SurveyMap:
    """Everything that a map says, from the points gathered.

    Args:
        builder: all clouds are in it.
        flown_m: (k, 3) positions of the drone, map frame, a metre or less apart.
        frame: name of the frame, for files.
    """
    cloud = builder.cloud(frame=frame)
    sheet = free_sheet_of_map(cloud, flown_m, cell_m=builder.config.cell_m, headroom_m=builder.config.headroom_m)
    gap = classify(cloud, sheet)
    cloud = cloud.classified(gap.kind)
    roadways = map_roadways(sheet=sheet, cloud=cloud, gap=gap)
    return SurveyMap(cloud, roadways, coverage(cloud, roadways, piece_m=builder.config.piece_m))
