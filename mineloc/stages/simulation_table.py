"""A simulated flight as a short table."""

from __future__ import annotations

from rich.box import SIMPLE
from rich.table import Table

from mineloc.stages.simulate import SimulateResult


def simulation_table(result: SimulateResult) -> Table:
    """Mine and flight, a row each figure."""
    table = Table(box=SIMPLE, show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    table.add_row("flight", str(result.out))
    table.add_row("mine", f"{result.roadways_m:,.0f} m of roadway, intersections: {result.intersections}")
    table.add_row("path", f"{result.path_m:,.1f} m in {result.duration_s:,.0f} s")
    table.add_row("roadways flown", f"{result.roadways_seen} of {result.roadways}")
    table.add_row("sweeps", f"{result.sweeps:,} with {result.points / max(result.sweeps, 1):,.0f} points each")
    for kind, count in (("depth images", result.depth_images), ("grey images", result.grey_images)):
        if count:
            table.add_row(kind, f"{count:,}")
    return table
