"""Two pictures of a map: from above without its roof, and cut across a roadway."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from mineloc.data import SurfaceKind
from mineloc.stages.map_folder import MapFolder

_COLOURS = {
    SurfaceKind.FLOOR: ("floor", "#a6761d"),
    SurfaceKind.WALL: ("wall", "#4c72b0"),
    SurfaceKind.ROOF: ("roof", "#444444"),
    SurfaceKind.OTHER: ("other", "#d55e00"),
}
_POINTS = 400_000


def top_view(survey: MapFolder, out: Path) -> None:
    """Walls and floor from above, roadways and intersections over them."""
    cloud = survey.cloud()
    figure, axes = plt.subplots(figsize=(11, 11), dpi=110)
    for kind in (SurfaceKind.FLOOR, SurfaceKind.WALL, SurfaceKind.OTHER):
        points = cloud.of_kind(kind).points_map
        points = points[:: max(1, len(points) * 2 // _POINTS)]
        name, colour = _COLOURS[kind]
        axes.scatter(points[:, 0], points[:, 1], s=0.1, c=colour, label=name, rasterized=True)
    for road in survey.roadways.roadways:
        axes.plot(road.line_m[:, 0], road.line_m[:, 1], c="#e6a800", lw=1.2)
    crossing = np.array(survey.roadways.degrees) >= 3
    nodes = survey.roadways.nodes_m[crossing]
    axes.plot(nodes[:, 0], nodes[:, 1], "o", c="black", ms=4, label=f"{len(nodes)} intersections")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", title="Map from above, without the roof")
    axes.legend(loc="upper right", markerscale=8.0)
    axes.grid(alpha=0.3)
    _saved(figure, out)


def cross_section(survey: MapFolder, out: Path, *, thick_m: float = 0.5) -> None:
    """Four cuts across roadways, half a metre thick: width and height can be read off."""
    cloud, roads = survey.cloud(), sorted(survey.roadways.roadways, key=lambda road: -road.length_m)
    figure, all_axes = plt.subplots(2, 2, figsize=(11, 9), dpi=110)
    for axes, road in zip(all_axes.flat, roads, strict=False):
        k = len(road.line_m) // 2
        ahead = road.line_m[min(k + 2, len(road.line_m) - 1)] - road.line_m[max(k - 2, 0)]
        ahead = ahead / np.linalg.norm(ahead)
        side = np.array([-ahead[1], ahead[0], 0.0])
        off = cloud.points_map - road.line_m[k]
        near = (np.abs(off @ ahead) < thick_m / 2) & (np.linalg.norm(off, axis=1) < 8)
        for kind, (name, colour) in _COLOURS.items():
            own = off[near & (cloud.surface == kind)]
            axes.plot(own @ side, own[:, 2], ".", c=colour, ms=3, label=name)
        width, height = road.width_m[k], road.height_m[k]
        axes.set(
            xlabel="across (m)", ylabel="above the floor (m)", aspect="equal",
            title=f"roadway of {road.length_m:.0f} m: {width:.2f} m wide, {height:.2f} m high",
        )  # fmt: skip
        axes.grid(alpha=0.3)
    all_axes.flat[0].legend(loc="center", markerscale=2.0)
    _saved(figure, out)


def _saved(figure: plt.Figure, out: Path) -> None:
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(out)
    plt.close(figure)
