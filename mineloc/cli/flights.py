"""Flights: made up, and taken in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from mineloc.cli.options import ConfigOption, JsonOption, SetOption, app, write_json


@app.command()
def simulate(
    mine: Annotated[
        str, typer.Argument(help="Mesh (.ply .obj .stl .dae), plan (.toml .dxf), or demo|straight|loop|hall.")
    ],
    out: Annotated[Path, typer.Option("--out", help="The flight file to write (.mcap).")],
    length_m: Annotated[float | None, typer.Option("--length-m", help="Path length of the tour.")] = None,
    speed_mps: Annotated[float | None, typer.Option("--speed-mps", help="On straight roadways.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Of the tour and of all noise.")] = None,
    sensor: Annotated[Literal["vlp16", "rs16", "hdl32e", "os0"] | None, typer.Option("--sensor")] = None,
    start: Annotated[int | None, typer.Option("--start", help="Node of the roadway graph to start from.")] = None,
    graph: Annotated[Path | None, typer.Option("--graph", help="Roadways of a mesh as JSON; else found in it.")] = None,
    camera: Annotated[bool, typer.Option("--camera", help="With a depth camera that looks ahead.")] = False,
    as_json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """Fly a made-up drone through a mine: LiDAR with motion distortion, IMU, and the truth."""
    from mineloc.config import load_config
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.stages.simulate import simulate as run_stage

    options = {"length_m": length_m, "speed_mps": speed_mps, "seed": seed, "sensor": sensor}
    options["camera"] = "true" if camera else None
    given = [f"simulate.{key}={value}" for key, value in options.items() if value is not None]
    settings = load_config(config, [*(overrides or ()), *given])
    with progress_bar("simulate") as progress:
        result = run_stage(mine, out=out, graph=graph, start=start, config=settings, progress=progress)
    if as_json:
        write_json(result.to_dict())
        return
    from rich.console import Console

    from mineloc.stages.simulation_table import simulation_table

    Console(highlight=False).print(simulation_table(result))


@app.command()
def ingest(
    recording: Annotated[Path, typer.Argument(help="An .mcap, .bag or .db3 file, or a rosbag2 folder.")],
    out: Annotated[Path, typer.Option("--out", help="The flight file to write (.mcap).")],
    sequence: Annotated[
        Path | None, typer.Option("--sequence", help="What the recording does not say about itself: datasets/x.toml.")
    ] = None,
    as_json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """Make a flight of a recording, recover what is damaged, and say how healthy it is."""
    from mineloc.config import load_config
    from mineloc.stages.ingest import ingest as run_stage
    from mineloc.stages.progress_bar import progress_bar

    settings = load_config(config, overrides or ())
    with progress_bar("ingest") as progress:
        result = run_stage(recording, out=out, sequence=sequence, config=settings, progress=progress)
    if as_json:
        write_json(result.health.to_json_dict())
        return
    from rich.console import Console

    from mineloc.stages.health_table import health_tables

    console = Console(highlight=False)
    for part in health_tables(result.health):
        console.print(part)
    console.print(f"flight: {result.out}", soft_wrap=True, markup=False)
