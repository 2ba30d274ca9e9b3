"""From pictures of free space to centre-lines: lengths, junctions, what is cleaned away and what must not be."""

from __future__ import annotations

import numpy as np
import pytest

from mineloc.roadways.centre_lines import centre_lines, largest_part
from mineloc.roadways.sheet import Sheet, link

CELL_M = 0.25


def _sheet(mask: np.ndarray, floor_m: np.ndarray | float = 0.0) -> Sheet:
    row, column = (values.astype(np.int64) for values in np.nonzero(mask))
    floor = np.broadcast_to(floor_m, mask.shape)[row, column].astype(float)
    return Sheet(
        CELL_M, np.full(2, CELL_M / 2), column, row, floor, floor + 3.0, link(column, row, floor, floor + 3.0, 1.2)
    )


def _plan(*boxes: tuple[float, float, float, float]) -> np.ndarray:
    """A picture of 60 m by 60 m with open boxes (x from, to, y from, to), metres."""
    mask = np.zeros((240, 240), np.bool_)
    for x0, x1, y0, y1 in boxes:
        mask[round(y0 / CELL_M) : round(y1 / CELL_M), round(x0 / CELL_M) : round(x1 / CELL_M)] = True
    return mask


def test_tee_has_one_intersection_and_its_lines_run_in_the_middle_on_the_floor() -> None:
    ramp = np.linspace(0, 6, 240)[None, :].repeat(240, axis=0)  # rises with x
    graph = centre_lines(_sheet(_plan((5, 55, 20, 24), (28, 32, 20, 50)), ramp))
    (node,) = graph.intersections
    np.testing.assert_allclose(graph.nodes_m[node, :2], [30, 22], atol=1.0)
    assert len(graph.roadways) == 3
    # dead ends stop half a width before the face
    assert graph.length_m == pytest.approx(46 + 26, abs=4)
    for road in graph.roadways:
        x, y = road.line_m[:, 0], road.line_m[:, 1]
        # at the node and at the faces lines turn into corners
        inner = road.line_m[(np.hypot(x - 30, y - 22) > 4) & (np.abs(x - 30) < 21) & (y < 46)]
        off = np.minimum(np.abs(inner[:, 1] - 22), np.abs(inner[:, 0] - 30))
        assert off.max() < 2 * CELL_M
        np.testing.assert_allclose(inner[:, 2], inner[:, 0] / 60 * 6, atol=0.15)


def test_crossing_a_little_apart_is_two_intersections_or_one() -> None:
    """A drift of 4 m that is offset by 3 m where it crosses another one."""
    mask = _plan((5, 55, 28, 32), (26, 30, 5, 30), (29, 33, 30, 55))
    apart = centre_lines(_sheet(mask))
    together = centre_lines(_sheet(mask), rooms_overlap=True)
    assert [len(graph.intersections) for graph in (apart, together)] == [2, 1]
    assert len(together.at_node()[together.intersections[0]]) == 4
    # farther apart they stay two in either way
    mask = _plan((5, 55, 28, 32), (20, 24, 5, 30), (36, 40, 30, 55))
    assert len(centre_lines(_sheet(mask), rooms_overlap=True).intersections) == 2


def test_bumps_and_boulders_are_no_roadways_but_pillars_are_gone_round() -> None:
    bumpy = _plan((5, 55, 20, 24), (12, 14, 18, 20), (40, 43, 24, 26))
    bumpy[round(22 / CELL_M), round(30 / CELL_M)] = False  # a stone in the middle
    graph = centre_lines(_sheet(bumpy))
    assert not graph.intersections
    assert len(graph.roadways) == 1
    pillar = _plan((5, 55, 10, 50)) & ~_plan((9, 51, 14, 46))
    ring = centre_lines(_sheet(pillar))
    assert ring.length_m == pytest.approx(2 * 46 + 2 * 36, rel=0.05)


def test_nothing_and_pieces_apart() -> None:
    nothing = _sheet(np.zeros((4, 4), np.bool_))
    assert not centre_lines(nothing).roadways
    assert len(largest_part(nothing)) == 0
    two = _sheet(_plan((5, 55, 10, 14), (5, 25, 30, 34)))
    part = largest_part(two)
    assert len(part) == 200 * 16
    assert centre_lines(two).length_m == pytest.approx(centre_lines(part).length_m, abs=2 * CELL_M)
