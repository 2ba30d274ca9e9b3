"""From a free-space sheet to the roadway graph: thin it, follow the centre-lines, clean them up."""

from __future__ import annotations

from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from mineloc.roadways.graph import Roadway, RoadwayGraph
from mineloc.roadways.sheet import Sheet, clearance_cells, components
from mineloc.roadways.skeleton import Chain, Skeleton, thin, trace

F64 = NDArray[np.float64]

SPUR_FACTOR = 1.5
SPUR_M = 2.0
SMALLEST_LOOP_M = 12.0
SMALLEST_BLIND_LOOP_M = 20.0


def largest_part(sheet: Sheet) -> Sheet:
    """The largest connected part of a sheet."""
    if not len(sheet):
        return sheet
    part = components(sheet.links)
    return sheet.keep(part == np.bincount(part).argmax())


def centre_lines(sheet: Sheet, *, rooms_overlap: bool = False) -> RoadwayGraph:
    """The roadways of a sheet as centre-lines on the floor; of pieces apart, the longest alone.

    Args:
        sheet: free space; may be empty, then the graph is too.
        rooms_overlap: two junctions are one when the largest circles that fit at them overlap, as where two roadways
            cross a little apart; False: only when one lies within the other's.
    """
    clearance = clearance_cells(sheet.links, sheet.column, sheet.row)
    skeleton = trace(sheet, thin(sheet.links, clearance)) if len(sheet) else Skeleton([], [])
    net = _Net(sheet, skeleton, clearance * sheet.cell_m, rooms_overlap=rooms_overlap)
    net.clean()
    return net.graph()


@dataclass(slots=True, eq=False)
class _Edge:
    a: int
    b: int
    line_m: F64
    clearance_m: F64

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.line_m, axis=0), axis=1).sum())

    def reversed(self) -> _Edge:
        return _Edge(self.b, self.a, self.line_m[::-1], self.clearance_m[::-1])


class _Net:
    """The raw graph of a skeleton, changed step by step until nothing is left to clean."""

    def __init__(self, sheet: Sheet, skeleton: Skeleton, clearance_m: F64, *, rooms_overlap: bool) -> None:
        self.rooms_overlap = rooms_overlap
        self.nodes: dict[int, F64] = {}
        self.room: dict[int, float] = {}
        self.edges: list[_Edge] = []
        for cells in skeleton.junctions:
            self._add_node(sheet.floor_points_m(cells).mean(axis=0), float(clearance_m[cells].max()))
        for chain in skeleton.chains:
            self._add_chain(sheet, chain, clearance_m)

    def _add_node(self, position_m: F64, room_m: float) -> int:
        node = len(self.nodes)
        self.nodes[node] = position_m
        self.room[node] = room_m
        return node

    def _add_chain(self, sheet: Sheet, chain: Chain, clearance_m: F64) -> None:
        line, room = sheet.floor_points_m(chain.cells), clearance_m[chain.cells]
        start = self._add_node(line[0], float(room[0])) if chain.start is None else chain.start
        closed = chain.start is None and chain.end is None and np.linalg.norm(line[0] - line[-1]) < 2 * sheet.cell_m
        if closed and len(line) > 2:
            end = start
        else:
            end = self._add_node(line[-1], float(room[-1])) if chain.end is None else chain.end
        full = np.concatenate([self.nodes[start][None], line, self.nodes[end][None]])
        self.edges.append(_Edge(start, end, full, np.concatenate([room[:1], room, room[-1:]])))

    def clean(self) -> None:
        """Prune spurs, join near junctions, drop loops around nothing, dissolve nodes that only two roadways share."""
        while self._dissolve() or self._prune() or self._contract() or self._drop_loop():
            pass
        self._keep_largest()

    def _prune(self) -> bool:
        """Remove dead ends that are only a corner or a bump of the wall, the shortest first, one a junction a time."""
        degree = self._degrees()
        spurs: list[tuple[float, int, int]] = []
        for index, edge in enumerate(self.edges):
            for end, root in ((edge.a, edge.b), (edge.b, edge.a)):
                limit = SPUR_FACTOR * self.room[root] + SPUR_M
                if degree[end] == 1 and degree[root] >= 3 and edge.length_m < limit:
                    spurs.append((edge.length_m - limit, index, root))
        gone: dict[int, int] = {}
        for _, index, root in sorted(spurs):
            gone.setdefault(root, index)
        dropped = set(gone.values())
        self.edges = [edge for index, edge in enumerate(self.edges) if index not in dropped]
        return bool(dropped)

    def _contract(self) -> bool:
        """Join two junctions that share their room: together they are one intersection."""
        degree = self._degrees()
        for index, edge in enumerate(self.edges):
            rooms = self.room[edge.a], self.room[edge.b]
            near = sum(rooms) if self.rooms_overlap else max(rooms)
            if edge.a != edge.b and min(degree[edge.a], degree[edge.b]) >= 3 and edge.length_m < near:
                del self.edges[index]
                self._merge(edge.a, edge.b)
                return True
        return False

    def _merge(self, a: int, b: int) -> None:
        self.nodes[a] = (self.nodes[a] + self.nodes[b]) / 2
        self.room[a] = max(self.room[a], self.room[b])
        for edge in self.edges:
            edge.a, edge.b = (a if node == b else node for node in (edge.a, edge.b))
            if edge.a == a:
                edge.line_m = np.concatenate([self.nodes[a][None], edge.line_m[1:]])
            if edge.b == a:
                edge.line_m = np.concatenate([edge.line_m[:-1], self.nodes[a][None]])

    def _drop_loop(self) -> bool:
        """Remove one side of a loop too short to go round a pillar: a hole in the mesh or a boulder."""
        for index, edge in enumerate(self.edges):
            if edge.a == edge.b and edge.length_m < SMALLEST_BLIND_LOOP_M and len(self.edges) > 1:
                del self.edges[index]
                return True
            for other in range(index):
                twin = self.edges[other]
                short = edge.length_m + twin.length_m < SMALLEST_LOOP_M
                if short and {edge.a, edge.b} == {twin.a, twin.b}:
                    del self.edges[index if edge.length_m >= twin.length_m else other]
                    return True
        return False

    def _dissolve(self) -> bool:
        """Join the two roadways of every node where nothing else ends."""
        at: dict[int, list[_Edge]] = {}
        for edge in self.edges:
            at.setdefault(edge.a, []).append(edge)
            at.setdefault(edge.b, []).append(edge)
        changed = False
        for node in sorted(at):
            ends = at[node]
            if len(ends) != 2 or ends[0] is ends[1]:
                continue
            first, second = ends
            head = first if first.b == node else first.reversed()
            tail = second if second.a == node else second.reversed()
            line = np.concatenate([head.line_m, tail.line_m[1:]])
            joined = _Edge(head.a, tail.b, line, np.concatenate([head.clearance_m, tail.clearance_m[1:]]))
            for other, old in ((joined.a, first), (joined.b, second)):
                at[other] = [joined if edge is old else edge for edge in at[other]]
            at[node] = []
            changed = True
        if changed:
            self.edges = list({id(edge): edge for node in sorted(at) for edge in at[node]}.values())
        return changed

    def _keep_largest(self) -> None:
        """Ledges and slivers of the sheet can leave pieces that hang together with nothing else."""
        net = nx.Graph([(edge.a, edge.b) for edge in self.edges])
        part_of = {node: k for k, nodes in enumerate(nx.connected_components(net)) for node in nodes}
        length = [0.0] * (max(part_of.values(), default=-1) + 1)
        for edge in self.edges:
            length[part_of[edge.a]] += edge.length_m
        self.edges = [edge for edge in self.edges if length[part_of[edge.a]] == max(length)]

    def _degrees(self) -> dict[int, int]:
        out: dict[int, int] = {}
        for edge in self.edges:
            out[edge.a] = out.get(edge.a, 0) + 1
            out[edge.b] = out.get(edge.b, 0) + 1
        return out

    def graph(self) -> RoadwayGraph:
        """The cleaned graph; lines smoothed, dead ends cut back to where there is room."""
        degree = self._degrees()
        used = sorted(degree)
        index = {node: k for k, node in enumerate(used)}
        nodes = np.array([self.nodes[node] for node in used]).reshape(-1, 3)
        roads: list[Roadway] = []
        for edge in self.edges:
            line = _trimmed(edge, at_a=degree[edge.a] == 1, at_b=degree[edge.b] == 1)
            line = _smooth(line)
            nodes[index[edge.a]], nodes[index[edge.b]] = line[0], line[-1]
            roads.append(Roadway(index[edge.a], index[edge.b], line))
        return RoadwayGraph(nodes, tuple(roads))


def _trimmed(edge: _Edge, *, at_a: bool, at_b: bool) -> F64:
    """A dead end's centre-line runs into a corner: stop where the clearance falls below 3/4 of the usual."""
    wide = np.flatnonzero(edge.clearance_m >= 0.75 * np.median(edge.clearance_m))
    first = int(wide[0]) if at_a else 0
    last = int(wide[-1]) if at_b else len(edge.line_m) - 1
    return edge.line_m[first : last + 1] if last - first >= 2 else edge.line_m


def _smooth(line_m: F64, step_m: float = 0.5) -> F64:
    """Take the steps of the grid out of a line and leave a point every half metre; the ends stay."""
    smooth = gaussian_filter1d(line_m, 3.0, axis=0, mode="nearest")
    smooth[0], smooth[-1] = line_m[0], line_m[-1]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(smooth, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], max(2, round(along[-1] / step_m) + 1))
    return np.stack([np.interp(at, along, smooth[:, axis]) for axis in range(3)], axis=1)
