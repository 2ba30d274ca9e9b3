"""Mapped roadways: what they tell of themselves, levels, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from mineloc.roadways.mapped import MappedRoadway, MappedRoadways


def _road(a: int, b: int, ends: list[list[float]], count: int = 21) -> MappedRoadway:
    line = np.linspace(ends[0], ends[1], count)
    return MappedRoadway(a, b, line, np.full(count, 1.8), np.full(count, 2.2), np.full(count, 3.0))


def _two_levels() -> MappedRoadways:
    nodes = [[0, 0, 0], [50, 0, 0.5], [50, 60, 9.5], [0, 60, 9.9]]
    ends = [(0, 1), (1, 2), (2, 3)]
    roads = tuple(_road(a, b, [nodes[a], nodes[b]]) for a, b in ends)
    return MappedRoadways(np.array(nodes, dtype=float), roads, 1.2)


def test_levels_are_counted_from_below_and_ramps_lie_between() -> None:
    mapped = _two_levels()
    assert mapped.levels() == [0, None, 1]
    assert mapped.levels(apart_m=20.0) == [0, None, 0]
    assert MappedRoadways(np.zeros((0, 3)), (), 1.2).levels() == []


def test_lengths_widths_degrees() -> None:
    mapped = _two_levels()
    assert mapped.degrees == [1, 2, 2, 1]
    assert mapped.intersections == []
    road = mapped.roadways[1]
    assert road.length_m == pytest.approx(np.hypot(60, 9))
    assert mapped.length_m == pytest.approx(mapped.graph.length_m)
    np.testing.assert_allclose(road.width_m, 4.0)
    assert road.is_steep


def test_profiles_that_do_not_fit_their_line_are_refused() -> None:
    line = np.zeros((5, 3))
    with pytest.raises(ValueError, match="left_m"):
        MappedRoadway(0, 1, line, np.zeros(4), np.zeros(5), np.zeros(5))
    with pytest.raises(ValueError, match="line_m"):
        MappedRoadway(0, 1, line[:1], np.zeros(1), np.zeros(1), np.zeros(1))
