"""The command line: arguments in, a stage called, errors printed on one line.

Heavy imports live inside the commands: `mineloc --help` must answer at once.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from mineloc.errors import MinelocError

if TYPE_CHECKING:
    from mineloc.config import EvaluateConfig

app = typer.Typer(
    name="mineloc",
    help="Where a drone is in a mine: survey flights in, maps, localization and accuracy reports out.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

ConfigOption = Annotated[Path | None, typer.Option("--config", help="TOML file of configuration keys.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="Override one key: section.key=value. Repeatable.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable results on stdout; all else on stderr.")]
LocalOption = Annotated[bool, typer.Option("--local", help="Without Prefect.")]
ServerOption = Annotated[str | None, typer.Option("--server", help="Address of a running Prefect server.")]
_INTERRUPTED = 130  # what typer makes of Ctrl-C


@app.callback()
def _root() -> None:  # pyright: ignore[reportUnusedFunction]  # typer keeps subcommands even if there is only one
    pass


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
        sys.stdout.write(json.dumps(result.to_dict(), indent=1) + "\n")
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
        sys.stdout.write(json.dumps(result.health.to_json_dict(), indent=1, allow_nan=False) + "\n")
        return
    from rich.console import Console

    from mineloc.stages.health_table import health_tables

    console = Console(highlight=False)
    for part in health_tables(result.health):
        console.print(part)
    console.print(f"flight: {result.out}", soft_wrap=True, markup=False)


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
        sys.stdout.write(json.dumps(result.to_dict(), indent=1, allow_nan=False) + "\n")
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
        sys.stdout.write(json.dumps(result.to_dict(), indent=1) + "\n")
        return
    from rich.console import Console

    Console(highlight=False).print(result.summary(), soft_wrap=True, markup=False)


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
        sys.stdout.write(json.dumps(result.to_dict(), indent=1) + "\n")
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
        sys.stdout.write(json.dumps(evaluation.to_dict(), indent=1, allow_nan=False) + "\n")
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
        sys.stdout.write(json.dumps(both.to_dict(), indent=1, allow_nan=False) + "\n")
        return
    from rich.console import Console

    from mineloc.stages.evaluation_table import before_after_heading, before_after_lines, before_after_table

    console = Console(highlight=False)
    for line in before_after_heading(both):
        console.print(line, soft_wrap=True, markup=False)
    console.print(before_after_table(both))
    for line in before_after_lines(both):
        console.print(line, soft_wrap=True, markup=False)


@app.command()
def report(
    runs: Annotated[list[Path], typer.Argument(help="Run folders; several are set side by side.")],
    out: Annotated[Path, typer.Option("--out", help="The page to write (.html); the same numbers go to .json.")],
    title: Annotated[str | None, typer.Option("--title", help="Heading of the page.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing page.")] = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """The accuracy report: one HTML file that opens anywhere and prints to A4. E.g. report RUN/ --out report.html."""
    from mineloc.config import load_config
    from mineloc.report.page import write_report
    from mineloc.stages.progress_bar import progress_bar

    settings = load_config(config, overrides or ())
    with progress_bar("report") as progress:
        page = write_report(runs, out, config=settings, title=title, overwrite=overwrite, progress=progress)
    typer.echo(f"{page}\n{page.with_suffix('.json')}")


@app.command()
def view(
    what: Annotated[Path, typer.Argument(help="A run or map folder, a flight (.mcap), or a recording (.rrd).")],
    flight: Annotated[Path | None, typer.Option("--flight", help="The run's flight: its sweeps are shown.")] = None,
    database: Annotated[
        Path | None, typer.Option("--database", help="The run's database: why it recognised what it did.")
    ] = None,
    save: Annotated[Path | None, typer.Option("--save", help="Write the recording (.rrd), open no window.")] = None,
    screenshot: Annotated[Path | None, typer.Option("--screenshot", help="Write a picture (.png).")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")] = False,
    config: ConfigOption = None,
    overrides: SetOption = None,
) -> None:
    """Look at a run or a flight in Rerun: mine, trajectories, sweeps, curves. E.g. view RUN/ --save run.rrd."""
    from mineloc.config import load_config
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.view.show import show

    settings = load_config(config, overrides or ())
    with progress_bar("view") as progress:
        written = show(
            what,
            flight=flight,
            database=database,
            save=save,
            picture=screenshot,
            overwrite=overwrite,
            config=settings,
            progress=progress,
        )
    for path in written:
        typer.echo(path)


@app.command()
def run(
    survey: Annotated[Path, typer.Argument(help="survey.toml: the flights and what is done with them.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the results, over the file's own word.")] = None,
    local: LocalOption = False,
    server: ServerOption = None,
    as_json: JsonOption = False,
    overrides: SetOption = None,
) -> None:
    """All stages of all flights of a survey, each executed once; as one Prefect flow."""
    _survey(survey, out, local=local, server=server, as_json=as_json, overrides=overrides)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder of the results.")] = Path("demo"),
    local: LocalOption = False,
    server: ServerOption = None,
    as_json: JsonOption = False,
) -> None:
    """A mapping flight and an inspection through a built-in mine, from raw recording to accuracy report."""
    from mineloc.survey.demo import write_demo

    _survey(write_demo(out), out, local=local, server=server, as_json=as_json, overrides=None)


def _survey(
    survey: Path, out: Path | None, *, local: bool, server: str | None, as_json: bool, overrides: list[str] | None
) -> None:
    from rich.console import Console

    from mineloc.survey.run import run_survey

    if local and server is not None:
        raise typer.BadParameter("either --local or --server")
    console = Console(stderr=as_json, highlight=False)
    rows = run_survey(survey, console, out=out, overrides=overrides or (), local=local, server=server)
    if as_json:
        sys.stdout.write(json.dumps(rows, indent=1, allow_nan=False) + "\n")


def main() -> None:
    """Entry point: exit code 0 done, 1 mineloc said no or was interrupted (one line), 2 usage."""
    try:
        app(standalone_mode=True)
    except MinelocError as error:
        sys.stderr.write(f"mineloc: {error}\n")
        raise SystemExit(1) from None
    except SystemExit as end:
        if end.code == _INTERRUPTED:
            sys.stderr.write("mineloc: interrupted; nothing half-written was left, run again to go on\n")
            raise SystemExit(1) from None
        raise


if __name__ == "__main__":
    main()
