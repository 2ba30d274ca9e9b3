"""Where a drone was, and how right that is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mineloc.cli.options import ConfigOption, JsonOption, SetOption, app, write_json

if TYPE_CHECKING:
    from mineloc.config import EvaluateConfig


@app.command()
def localize(
    flight: Annotated[Path, typer.Argument(help="A canonical flight (of ingest or simulate).")],
    method: Annotated[str, typer.Option("--method", help="odometry, odometry_loops, loam, loam_scan_context …")],
    out: Annotated[Path, typer.Option("--out", help="The run folder to write.")],
    prior_map: Annotated[Path | None, typer.Option("--map", help="A map folder, for map_tracking.")] = None,
    database: Annotated[Path | None, typer.Option("--database", help="Of a map, for intersections_map.")] = None,
    recording: Annotated[bool, typer.Option(help="Also write run.rrd, what `mineloc view` shows.")] = True,
    as_json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """Where the drone was: trajectories, keyframes, and how sure that is."""
    from mineloc.config import load_config
    from mineloc.stages.localize import localize as run_stage
    from mineloc.stages.progress_bar import progress_bar

    settings = load_config(config, overrides or ())
    with progress_bar("localize") as progress:
        result = run_stage(
            flight, out, method=method, prior_map=prior_map, database=database, config=settings, progress=progress
        )
    if recording:
        from mineloc.view.run import record_run

        with progress_bar("recording") as progress:
            record_run(out, out / "run.rrd", flight=flight, database=database, config=settings, progress=progress)
    if as_json:
        write_json(result.to_dict())
        return
    from rich.console import Console

    Console(highlight=False).print(result.summary(), soft_wrap=True, markup=False)


@app.command()
def evaluate(
    estimate: Annotated[str, typer.Argument(help="Run folder, TUM, KITTI or MCAP file (FILE.mcap:/topic).")],
    reference: Annotated[
        str | None, typer.Option("--reference", help="Flight, TUM, KITTI or MCAP file; a run may bring its own.")
    ] = None,
    align: Annotated[
        Literal["none", "origin", "posyaw", "se3"] | None,
        typer.Option("--align", help="One alignment; without it none, origin and se3 are shown."),
    ] = None,
    baseline: Annotated[
        str | None, typer.Option("--baseline", help="What the estimate is to beat: the table tells before and after.")
    ] = None,
    as_json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """How far an estimate is from a reference: APE, RPE, REP-k, KITTI, with the coverage."""
    from mineloc.config import load_config
    from mineloc.stages.evaluate import evaluate as run

    section = load_config(config, overrides or ()).evaluate
    if baseline is not None:
        _before_after(estimate, baseline, reference, align=align, section=section, as_json=as_json)
        return
    evaluation = run(estimate, reference, align=align, config=section)
    if as_json:
        write_json(evaluation.to_dict())
        return
    from rich.console import Console

    from mineloc.stages.evaluation_table import heading, tables

    console = Console(highlight=False)
    for line in heading(evaluation):
        console.print(line, soft_wrap=True, markup=False)
    for table in tables(evaluation):
        console.print(table)


def _before_after(
    estimate: str,
    baseline: str,
    reference: str | None,
    *,
    align: Literal["none", "origin", "posyaw", "se3"] | None,
    section: EvaluateConfig,
    as_json: bool,
) -> None:
    from mineloc.stages.before_after import evaluate_before_after

    both = evaluate_before_after(estimate, baseline, reference, align=align, config=section)
    if as_json:
        write_json(both.to_dict())
        return
    from rich.console import Console

    from mineloc.stages.evaluation_table import before_after_heading, before_after_lines, before_after_table

    console = Console(highlight=False)
    for line in before_after_heading(both):
        console.print(line, soft_wrap=True, markup=False)
    console.print(before_after_table(both))
    for line in before_after_lines(both):
        console.print(line, soft_wrap=True, markup=False)
