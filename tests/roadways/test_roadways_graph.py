"""Roadway graphs and their files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mineloc.errors import FormatError
from mineloc.roadways.graph import Roadway, RoadwayGraph, read_graph


def test_graph_file_is_read_and_damage_is_named(tmp_path: Path) -> None:
    path = tmp_path / "g.json"
    raw = {
        "z_floor": 2.0,
        "nodes": [{"id": 7, "xy": [0, 0]}, {"id": 9, "xyz": [10, 0, 3]}],
        "edges": [{"a": 7, "b": 9, "path": [[1, 0], [5, 1, 2.5]]}],
    }
    path.write_text(json.dumps(raw))
    graph = read_graph(path)
    np.testing.assert_allclose(graph.roadways[0].line_m, [[0, 0, 2], [1, 0, 2], [5, 1, 2.5], [10, 0, 3]])
    for text in ("", "[]", '{"nodes": [], "edges": []}', json.dumps({**raw, "edges": [{"a": 1, "b": 9, "path": []}]})):
        path.write_text(text)
        with pytest.raises(FormatError):
            read_graph(path)
    with pytest.raises(FormatError, match="not a roadway graph"):
        read_graph(tmp_path / "none.json")


def test_intersections_are_where_three_roadways_end_a_loop_counting_twice() -> None:
    nodes = np.array([[0, 0, 0], [10, 0, 0], [20, 0, 0], [10, 5, 0.0]])
    loop = np.array([[10, 5, 0], [12, 8, 0], [8, 8, 0], [10, 5, 0.0]])
    roads = (Roadway(0, 1, nodes[:2]), Roadway(1, 2, nodes[1:3]), Roadway(1, 3, nodes[[1, 3]]), Roadway(3, 3, loop))
    graph = RoadwayGraph(nodes, roads)
    assert graph.intersections == [1, 3]
    assert graph.at_node()[3] == [2, 3, 3]
    assert graph.length_m == pytest.approx(25 + np.linalg.norm(np.diff(loop, axis=0), axis=1).sum())
