"""Which intersection can follow which: nobody flies from one to another in less than the way between (METHOD 7.3)."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from mineloc.config import IntersectionsConfig
from mineloc.data import F64, Fix, IntersectionDatabase, RelativePose


class RoadwaySequence:
    """Remembers the intersection that was recognised last, and how far the drone has flown since.

    There is no upper bound: a drone may hover, turn back, and pass intersections that it does not recognise.

    Args:
        database: whose neighbours are the roadway graph.
        config: `sequence_share`, `recognise_m`.
    """

    def __init__(self, database: IntersectionDatabase, config: IntersectionsConfig) -> None:
        self._config = config
        self._names = {one.id: one.name for one in database.intersections}
        self._row = {one.id: row for row, one in enumerate(database.intersections)}
        self._ways_m = ways_between(database)
        self._last: int | None = None
        self._flown_m = 0.0

    def carry(self, edge: RelativePose) -> None:
        """Count the way to the next keyframe."""
        self._flown_m += float(np.linalg.norm(edge.T_i_j[:3, 3]))

    def accept(self, fix: Fix) -> None:
        """A recognised intersection: the way is counted from here."""
        self._last, self._flown_m = int(fix.scores["id"]), 0.0

    def doubt(self, fix: Fix) -> str:
        """Why an intersection cannot follow the last one; empty when it can."""
        id = int(fix.scores["id"])
        if self._last is None or id == self._last:
            return ""
        way_m = float(self._ways_m[self._row[self._last], self._row[id]])
        # both were seen from up to `recognise_m` away
        least_m = self._config.sequence_share * way_m - 2.0 * self._config.recognise_m
        if not np.isfinite(way_m) or self._flown_m >= least_m:
            return ""
        return (
            f"{self._flown_m:.0f} m flown since {self._names[self._last]}, at least {least_m:.0f} m needed "
            f"along roadways (step 9)"
        )


def ways_between(database: IntersectionDatabase) -> F64:
    """(k, k) shortest ways along roadways in metres; infinite where none is known."""
    row = {one.id: k for k, one in enumerate(database.intersections)}
    edges = [
        (row[one.id], row[other], length_m)
        for one in database.intersections
        for other, length_m in one.neighbours
        if other in row
    ]
    k = len(row)
    if not edges:
        return np.where(np.eye(k, dtype=np.bool_), 0.0, np.inf)
    a, b, length = zip(*edges, strict=True)
    return np.asarray(dijkstra(coo_array((length, (a, b)), shape=(k, k)).tocsr(), directed=False), dtype=np.float64)
