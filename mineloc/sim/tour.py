"""A tour through the roadways: which one after which, so that much of the mine is seen, again and from both sides."""

from __future__ import annotations

from dataclasses import dataclass

import networkx as nx
import numpy as np

from mineloc.errors import SimulationError
from mineloc.roadways.graph import RoadwayGraph


@dataclass(frozen=True, slots=True)
class Step:
    """One roadway of the tour.

    Attributes:
        roadway: its index in the graph.
        forward: True from its node a to its node b.
    """

    roadway: int
    forward: bool


def plan_tour(
    graph: RoadwayGraph, length_m: float, rng: np.random.Generator, *, start: int | None = None
) -> list[Step]:
    """Roadways one after the other, at least `length_m` long in all.

    At each node the least-visited roadway is next, by chance among equals; the drone turns round only at an end.
    Where all roadways at the node have been seen more often than others, it goes to the nearest of these first.

    Args:
        graph: the mine.
        length_m: wanted length.
        rng: decides between equals.
        start: node to start from; None: an end of the mine's largest connected part, by chance.

    Raises:
        SimulationError: no roadway, or no such node.
    """
    walk = _Walk(graph, rng, _start_node(graph, rng) if start is None else start)
    while walk.length_m < length_m:
        walk.go(walk.next_step())
    return walk.steps


def _start_node(graph: RoadwayGraph, rng: np.random.Generator) -> int:
    if not graph.roadways:
        raise SimulationError("mine", "no roadway", expected="at least one", todo="check the mesh or the plan")
    parts = nx.Graph()
    parts.add_edges_from((road.a, road.b) for road in graph.roadways)
    length: dict[int, float] = {}
    components = [sorted(part) for part in nx.connected_components(parts)]
    for index, part in enumerate(components):
        members = set(part)
        length[index] = sum(road.length_m for road in graph.roadways if road.a in members)
    largest = components[max(length, key=lambda index: length[index])]
    at_node = graph.at_node()
    ends = [node for node in largest if len(at_node[node]) == 1]
    return int(rng.choice(np.array(ends or largest)))


class _Walk:
    """The tour so far."""

    def __init__(self, graph: RoadwayGraph, rng: np.random.Generator, node: int) -> None:
        self.graph = graph
        self.rng = rng
        self.at_node = graph.at_node()
        if not 0 <= node < len(self.at_node) or not self.at_node[node]:
            raise SimulationError(
                "--start",
                f"node {node}",
                expected=f"0 ... {len(self.at_node) - 1}",
                todo="choose a node with a roadway",
            )
        self.node = node
        self.visits = np.zeros(len(graph.roadways), np.int64)
        self.steps: list[Step] = []
        self.length_m = 0.0
        self.net = nx.MultiGraph()
        for index, road in enumerate(graph.roadways):
            self.net.add_edge(road.a, road.b, key=index, length=road.length_m)
        self.reachable = [index for index, road in enumerate(graph.roadways) if nx.has_path(self.net, node, road.a)]

    def go(self, step: Step) -> None:
        road = self.graph.roadways[step.roadway]
        self.node = road.b if step.forward else road.a
        self.visits[step.roadway] += 1
        self.length_m += road.length_m
        self.steps.append(step)

    def next_step(self) -> Step:
        options = self._options()
        fewest = min(int(self.visits[step.roadway]) for step in options)
        if fewest > int(self.visits[self.reachable].min()):
            return self._towards_least_seen(options)
        best = [step for step in options if self.visits[step.roadway] == fewest]
        return best[int(self.rng.integers(len(best)))]

    def _options(self) -> list[Step]:
        """Every way out of the node; back where it came from only if there is no other."""
        out: list[Step] = []
        for index in sorted(set(self.at_node[self.node])):
            road = self.graph.roadways[index]
            out += [Step(index, True)] if road.a == self.node else []
            out += [Step(index, False)] if road.b == self.node else []
        if not self.steps:
            return out
        back = Step(self.steps[-1].roadway, not self.steps[-1].forward)
        return [step for step in out if step != back] or out

    def _towards_least_seen(self, options: list[Step]) -> Step:
        """The option from which the nearest of the least-seen roadways is closest."""
        fewest = self.visits[self.reachable].min()
        goals = {
            node
            for index in self.reachable
            if self.visits[index] == fewest
            for node in (self.graph.roadways[index].a, self.graph.roadways[index].b)
        }
        distance = nx.multi_source_dijkstra_path_length(self.net, goals, weight="length")

        def cost(step: Step) -> tuple[float, int]:
            road = self.graph.roadways[step.roadway]
            return road.length_m + distance[road.b if step.forward else road.a], step.roadway

        return min(options, key=cost)
