"""Maps of flights, and the intersections of maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mineloc.cli.options import ConfigOption, JsonOption, SetOption, app, write_json


@app.command()
def reconstruct(
    flights: Annotated[list[Path], typer.Argument(help="Canonical flights through one mine.")],
    out: Annotated[Path, typer.Option("--out", help="The map folder to write.")],
    method: Annotated[str, typer.Option("--method", help="Front end and loop closures, as in localize.")] = (
        "odometry_loops"
    ),
    control: Annotated[Path | None, typer.Option("--control", help="Surveyed targets (CSV).")] = None,
    observations: Annotated[Path | None, typer.Option("--observations", help="Where flights saw them (CSV).")] = None,
    no_control: Annotated[bool, typer.Option("--no-control", help="Without targets, also attached ones.")] = False,
    as_json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """The map of a mine from mapping flights: points, roadways, accuracy. E.g. reconstruct survey.mcap --out map/."""
    from mineloc.config import load_config
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.stages.reconstruct import reconstruct as run_stage

    if no_control and (control or observations):
        raise typer.BadParameter("either --no-control or targets")
    settings = load_config(config, overrides or ())
    with progress_bar("reconstruct") as progress:
        result = run_stage(
            flights,
            out,
            method=method,
            control=control,
            observations=observations,
            use_control=not no_control,
            config=settings,
            progress=progress,
        )
    if as_json:
        write_json(result.to_dict())
        return
    from rich.console import Console

    from mineloc.stages.reconstruct_table import reconstruct_table

    Console(highlight=False).print(reconstruct_table(result))


@app.command()
def database(
    source: Annotated[Path, typer.Argument(metavar="MAP", help="A map folder; with --names or --merge a database.")],
    out: Annotated[Path, typer.Option("--out", help="The database to write (.mcap).")],
    since: Annotated[
        Path | None, typer.Option("--since", help="The database before: ids and names of what is still there stay.")
    ] = None,
    merge: Annotated[Path | None, typer.Option("--merge", help="A database of another part, in one grid.")] = None,
    names: Annotated[Path | None, typer.Option("--names", help="Its CSV with edited names and kinds.")] = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="Also write a table.")] = None,
    geojson: Annotated[Path | None, typer.Option("--geojson", help="Also write points and ways.")] = None,
    as_json: JsonOption = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """The intersections of a map, found and described. E.g. database map/ --out intersections.mcap."""
    from mineloc.config import load_config
    from mineloc.stages import database as stage

    if sum(one is not None for one in (since, merge, names)) > 1:
        raise typer.BadParameter("one of --since, --merge and --names")
    settings = load_config(config, overrides or ())
    if names is not None:
        result = stage.rename(source, names, out)
    elif merge is not None:
        result = stage.merge(source, merge, out, config=settings)
    else:
        result = stage.database(source, out, since=since, config=settings)
    stage.export(out, csv=csv, geojson=geojson)
    if as_json:
        write_json(result.to_dict())
        return
    from rich.console import Console

    Console(highlight=False).print(result.summary(), soft_wrap=True, markup=False)
