"""The short table that `mineloc reconstruct` ends with."""

from __future__ import annotations

from rich.table import Table

from mineloc.stages.reconstruct import ReconstructResult


def reconstruct_table(result: ReconstructResult) -> Table:
    """What was made, and what is doubtful about it."""
    table = Table(show_header=False, box=None, padding=(0, 1))
    table.add_row("map", str(result.out))
    table.add_row(
        "flown", f"{result.path_m:,.0f} m in {result.flights} flights, {result.sweeps:,} sweeps"
        if result.flights > 1
        else f"{result.path_m:,.0f} m, {result.sweeps:,} sweeps",
    )  # fmt: skip
    table.add_row("loops", f"{result.loops} closed, {result.refused} candidates refused")
    if result.degenerate_m > 0:
        share = result.degenerate_m / max(result.path_m, 1e-9)
        table.add_row(
            "[red]doubtful[/red]",
            f"{result.degenerate_m:,.0f} m ({share:.0%}) weakly observed: the length of the way is not sure there",
        )
    if result.control is not None:
        for role in ("control", "check"):
            rmse = result.control[f"{role}_m"]
            table.add_row(f"{role} points", "none" if rmse is None else f"RMSE {rmse:.3f} m")
    complete = "" if result.complete is None else f", {result.complete:.0%} complete"
    table.add_row("roadways", f"{result.roadways_m:,.0f} m, {result.intersections} intersections{complete}")
    table.add_row("points", f"{result.points:,}")
    table.add_row("speed", f"{result.seconds:.0f} s, {result.real_time_factor:.1f} times real time")
    return table
