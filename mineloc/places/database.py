"""From intersections to a database that knows how alike they are (paper A, Fig. 16; METHOD 5.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mineloc.config import IntersectionsConfig
from mineloc.data import F64, Intersection, IntersectionDatabase, Lineage
from mineloc.places.contour_matrix import matrix_likeness
from mineloc.places.wall_contour import branches_fit, contour_likeness


def database_of(
    intersections: Sequence[Intersection],
    config: IntersectionsConfig,
    *,
    grid_origin_m: F64,
    is_grid: bool,
    map_sha256: str,
) -> IntersectionDatabase:
    """Compare every intersection with every other, and draw the threshold from that; the first version of a database.

    The threshold lies above nearly all pairs of different intersections, but not above the likeness that one has with
    itself seen from elsewhere, in a mine of equal junctions no more than in any other. Pairs above it are for the
    matrix, the neighbours and registration to tell apart, and those that the matrix does not tell apart are twins.

    Args:
        intersections: by rising id.
        config: `threshold_floor`, `threshold_ceiling`, `threshold_quantile`, `twin_matrix`, `branch_match_deg`.
        grid_origin_m, is_grid, map_sha256: of the map.
    """
    contour, matrix = similarities(intersections, config)
    different = contour[~np.eye(len(contour), dtype=np.bool_)]
    quantile = float(np.quantile(different, config.threshold_quantile)) if len(different) else 0.0
    threshold = float(np.clip(quantile, config.threshold_floor, config.threshold_ceiling))
    twins = [
        (intersections[i].id, intersections[j].id)
        for i in range(len(contour))
        for j in range(i + 1, len(contour))
        if contour[i, j] >= threshold and matrix[i, j] >= config.twin_matrix
    ]
    return IntersectionDatabase(
        intersections=tuple(intersections),
        grid_origin_m=grid_origin_m,
        is_grid=is_grid,
        lineage=Lineage.first(map_sha256, (one.id for one in intersections)),
        contour_similarity=contour,
        matrix_similarity=matrix,
        contour_threshold=threshold,
        twins=tuple(twins),
    )


def similarities(intersections: Sequence[Intersection], config: IntersectionsConfig) -> tuple[F64, F64]:
    """(k, k) of contours and of matrices at the best turn; 0 where the branches do not fit at that turn."""
    k = len(intersections)
    contour, matrix = np.eye(k), np.eye(k)
    within = np.radians(config.branch_match_deg)
    for i, a in enumerate(intersections):
        for j in range(i + 1, k):
            b = intersections[j]
            found = contour_likeness(a.contour, b.contour, config)
            if branches_fit(a.contour.branches_rad, b.contour.branches_rad, found.yaw_rad, within_rad=within):
                contour[i, j] = contour[j, i] = found.similarity
                matrix[i, j] = matrix[j, i] = matrix_likeness(a.matrix, b.matrix, found.yaw_rad, config)
    return contour, matrix
