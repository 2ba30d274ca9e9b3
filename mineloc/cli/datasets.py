"""Datasets: flights under names and versions."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mineloc.cli.options import JsonOption, app, write_json

if TYPE_CHECKING:
    from mineloc.store.datasets import Datasets
    from mineloc.store.versions import Version

dataset = typer.Typer(name="dataset", help="Versioned sets of recordings in a store.", no_args_is_help=True)
app.add_typer(dataset)

StoreOption = Annotated[
    Path | None, typer.Option("--store", help="The store; else what MINELOC_STORE says, else .mineloc/store.")
]
ReferenceArgument = Annotated[
    str, typer.Argument(metavar="NAME[@VERSION]", help="latest, a tag, or the beginning of an id.")
]
ManifestOption = Annotated[
    Path | None, typer.Option("--manifest", help="Also write the version's manifest (JSON), for git.")
]


@dataset.command()
def add(
    name: Annotated[str, typer.Argument(help="Of the dataset; a new one is made.")],
    recordings: Annotated[list[str], typer.Argument(metavar="[FLIGHT=]RECORDING...", help="Files, rosbag2 folders.")],
    sequence: Annotated[Path | None, typer.Option("--sequence", help="Of all of them: datasets/x.toml.")] = None,
    note: Annotated[str, typer.Option("--note", help="One line, kept with the version.")] = "",
    replace: Annotated[bool, typer.Option("--replace", help="Flights that have other content get this one.")] = False,
    health: Annotated[bool, typer.Option(help="Ingest each recording and keep what that says of it.")] = True,
    manifest: ManifestOption = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Copy recordings into a dataset. E.g. dataset add level4 north=bags/n1.mcap --note "after the fire door"."""
    from mineloc.store.datasets import Datasets

    given = _by_flight(recordings)
    datasets = Datasets.open(store, create=True)
    datasets.refuse_other_content(name, given, sequence=sequence, replace=replace)
    reports = _reports(datasets, given, sequence) if health else {}
    version = datasets.add(name, given, sequence=sequence, health=reports, note=note, replace=replace)
    _write_manifest(version, manifest)
    _tell(datasets, name, version, only=set(given), as_json=as_json)


@dataset.command()
def remove(
    name: Annotated[str, typer.Argument(help="Of the dataset.")],
    flights: Annotated[list[str], typer.Argument(metavar="FLIGHT...")],
    note: Annotated[str, typer.Option("--note", help="One line, kept with the version.")] = "",
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """A new version without some flights; earlier versions keep them. E.g. dataset remove level4 north."""
    from mineloc.store.datasets import Datasets

    datasets = Datasets.open(store)
    _tell(datasets, name, datasets.remove(name, flights, note=note), as_json=as_json)


@dataset.command("list")
def list_datasets(store: StoreOption = None, as_json: JsonOption = False) -> None:
    """Which datasets there are. E.g. dataset list --json."""
    from mineloc.store.datasets import Datasets

    entries = Datasets.open(store).list()
    if as_json:
        write_json(
            [
                {
                    "dataset": one.name,
                    "version": one.latest.id,
                    "flights": list(one.latest.flights()),
                    "bytes": one.latest.bytes,
                    "versions": one.versions,
                    "tags": dict(one.tags),
                }
                for one in entries
            ]
        )
        return
    from mineloc.cli.dataset_tables import list_table, print_table

    print_table(list_table(entries))


@dataset.command()
def show(
    reference: ReferenceArgument,
    log: Annotated[bool, typer.Option("--log", help="Also who moved its references, and when.")] = False,
    paths: Annotated[bool, typer.Option("--paths", help="Also where each recording can be read.")] = False,
    manifest: ManifestOption = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """The flights of a version. E.g. dataset show level4@2026-11 --manifest datasets/level4/2026-11.json."""
    from mineloc.store.datasets import Datasets
    from mineloc.store.refs import split_reference

    datasets = Datasets.open(store)
    version = datasets.get(reference)
    name, _ = split_reference(reference)
    moves = datasets.refs.log(name) if log else []
    places = {one.flight: str(datasets.path(one)) for one in version.recordings} if paths else {}
    _write_manifest(version, manifest)
    if as_json:
        write_json(_as_dict(name, version) | {"log": [asdict(one) for one in moves], "paths": places})
        return
    _tell(datasets, name, version)
    from mineloc.cli.dataset_tables import log_table, print_table

    if log:
        print_table(log_table(moves))
    for path in places.values():
        typer.echo(path)


@dataset.command()
def diff(
    before: ReferenceArgument, after: ReferenceArgument, store: StoreOption = None, as_json: JsonOption = False
) -> None:
    """Flights that changed between two versions, and figures. E.g. dataset diff level4@2026-10 level4."""
    from mineloc.store.datasets import Datasets
    from mineloc.store.difference import difference

    found = difference(Datasets.open(store), before, after)
    if as_json:
        write_json(
            {
                "before": found.before.id,
                "after": found.after.id,
                "added": [asdict(one) for one in found.added],
                "removed": [asdict(one) for one in found.removed],
                "changed": [{"before": asdict(was), "after": asdict(now)} for was, now in found.changed],
                "metrics": [asdict(one) | {"change": one.change} for one in found.deltas],
            }
        )
        return
    from mineloc.cli.dataset_tables import difference_tables, print_table

    for table in difference_tables(found):
        print_table(table)


@dataset.command()
def tag(
    reference: ReferenceArgument,
    name: Annotated[str, typer.Argument(metavar="TAG")],
    move: Annotated[bool, typer.Option("--move", help="Also if it names another version.")] = False,
    delete: Annotated[bool, typer.Option("--delete", help="Take the tag away.")] = False,
    manifest: ManifestOption = None,
    store: StoreOption = None,
) -> None:
    """Give a version a name. E.g. dataset tag level4 2026-11 --manifest datasets/level4/2026-11.json."""
    from mineloc.store.datasets import Datasets
    from mineloc.store.refs import split_reference

    if delete and (move or manifest is not None):
        raise typer.BadParameter("--delete goes with nothing else")
    datasets = Datasets.open(store)
    own, _ = split_reference(reference)
    if delete:
        datasets.untag(own, name)
        return
    version = datasets.tag(reference, name, move=move)
    _write_manifest(version, manifest)
    typer.echo(f"{own}@{name} is {version.id}")


@dataset.command()
def forget(
    name: Annotated[str, typer.Argument(help="Of the dataset.")],
    store: StoreOption = None,
) -> None:
    """Take a dataset away with all versions; `dataset gc` frees its space. E.g. dataset forget level4."""
    from mineloc.store.datasets import Datasets

    Datasets.open(store).forget(name)


@dataset.command()
def runs(reference: ReferenceArgument, store: StoreOption = None, as_json: JsonOption = False) -> None:
    """The figures of all runs on a version's flights, from the catalogue. E.g. dataset runs level4@2026-11."""
    import polars as pl

    from mineloc.store.catalogue import rebuild
    from mineloc.store.datasets import Datasets

    datasets = Datasets.open(store)
    version = datasets.get(reference)
    found = rebuild(datasets).runs.filter(pl.col("version") == version.id).drop("dataset").unique(maintain_order=True)
    if as_json:
        write_json(found.to_dicts())
        return
    from mineloc.cli.dataset_tables import print_table, runs_table

    print_table(runs_table(found.to_dicts()))


def _by_flight(recordings: list[str]) -> dict[str, Path]:
    """`FLIGHT=RECORDING`, or a recording whose flight is called as it is."""
    given: dict[str, Path] = {}
    for text in recordings:
        flight, equals, path = text.partition("=")
        if not equals or Path(text).exists():
            place = Path(text).absolute()
            flight, path = place.name if place.is_dir() else place.stem, text
        if flight in given:
            raise typer.BadParameter(f"two recordings for flight {flight}: write FLIGHT=RECORDING")
        given[flight] = Path(path)
    return given


def _reports(datasets: Datasets, recordings: dict[str, Path], sequence: Path | None) -> dict[str, dict[str, Any]]:
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.survey.health_check import health_report

    told = None if sequence is None else datasets.keep_sequence(sequence)
    reports: dict[str, dict[str, Any]] = {}
    for flight, path in recordings.items():
        with progress_bar(f"health {flight}") as progress:
            reports[flight] = health_report(datasets.store, flight, path, sequence=told, progress=progress)
    return reports


def _write_manifest(version: Version, path: Path | None) -> None:
    if path is None:
        return
    from mineloc.output import new_file

    with new_file(path, overwrite=True) as temp:
        temp.write_bytes(version.file_text.encode())


def _as_dict(name: str, version: Version) -> dict[str, Any]:
    return {"name": name, "version": version.id, **asdict(version)}


def _tell(
    datasets: Datasets, name: str, version: Version, *, only: set[str] | None = None, as_json: bool = False
) -> None:
    if as_json:
        write_json(_as_dict(name, version))
        return
    from mineloc.cli.dataset_tables import print_table, version_table

    reports = {one.flight: datasets.health(one) for one in version.recordings if only is None or one.flight in only}
    print_table(version_table(name, version, reports))
