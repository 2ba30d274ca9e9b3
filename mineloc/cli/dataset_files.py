"""Datasets on disks: sound or not, cleaned up, carried elsewhere and taken in."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mineloc.cli.datasets import ReferenceArgument, StoreOption, dataset
from mineloc.cli.options import JsonOption, write_json
from mineloc.errors import StoreError

if TYPE_CHECKING:
    from mineloc.store.datasets import Datasets
    from mineloc.store.remote import Remote

RemoteOption = Annotated[
    str | None, typer.Option("--remote", help="s3://…, file:///…, any URL of fsspec; remembered by the store.")
]
AsOption = Annotated[str | None, typer.Option("--as", help="Name of the dataset here.")]


@dataset.command()
def verify(
    reference: Annotated[str | None, typer.Argument(metavar="[NAME[@VERSION]]", help="Only this version.")] = None,
    manifest: Annotated[
        Path | None, typer.Option("--manifest", help="Whether the store holds exactly what this file says.")
    ] = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Read everything and compare its hashes; exit code 1 if something is wrong. E.g. dataset verify level4@2026-11."""
    from mineloc.store.datasets import Datasets
    from mineloc.store.versions import read_manifest

    if manifest is not None and reference is not None:
        raise typer.BadParameter("either a version or --manifest")
    datasets = Datasets.open(store)
    found: dict[str, list[str]] = {"damaged": [], "missing": [], "records": [], "references": []}
    if manifest is not None or reference is not None:
        version = read_manifest(manifest) if manifest is not None else datasets.get(reference or "")
        objects = datasets.store.objects
        for digest in datasets.lacking(version.id):
            found["damaged" if objects.path(digest).exists() else "missing"].append(digest)
    else:
        findings = datasets.verify()
        found["damaged"], found["missing"] = list(findings.damaged), list(findings.missing)
        found["records"], found["references"] = [str(p) for p in findings.records], list(findings.refs)
    if as_json:
        write_json({"sound": not any(found.values()), **found})
    else:
        for kind, names in found.items():
            for name in names:
                typer.echo(f"{kind.removesuffix('s') if kind != 'damaged' else kind} {name}")
    counts = ", ".join(f"{len(names)} {kind}" for kind, names in found.items() if names)
    if counts:
        raise StoreError(
            datasets.store.root, counts, todo="pull or import it anew; results are made anew by themselves"
        )
    if not as_json:
        typer.echo("sound")


@dataset.command()
def gc(
    grace_h: Annotated[float, typer.Option("--grace-h", min=0, help="What is younger stays.")] = 24.0,
    actions_older_than: Annotated[
        float | None, typer.Option("--actions-older-than", min=0, metavar="DAYS", help="Older results go too.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only say what would be removed.")] = False,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Remove what no version, tag or kept result needs. E.g. dataset gc --dry-run."""
    from mineloc.store.datasets import Datasets
    from mineloc.store.gc import DAY_S, collect

    datasets = Datasets.open(store)
    done = collect(
        datasets.store,
        grace_s=grace_h * 3600.0,
        actions_older_than_s=None if actions_older_than is None else actions_older_than * DAY_S,
        dry_run=dry_run,
        waiting=lambda: typer.echo("waiting for those who add to the store", err=True),
    )
    if as_json:
        records = [str(path) for path in done.records]
        write_json(
            {"objects": list(done.objects), "records": records, "bytes": done.freed_bytes, "kept": done.kept}
            | {"swept": list(done.swept), "dry_run": dry_run}
        )
        return
    from mineloc.cli.dataset_tables import megabytes

    would = "would be removed" if dry_run else "removed"
    typer.echo(
        f"{len(done.objects)} objects ({megabytes(done.freed_bytes)}) and {len(done.records)} results {would}, "
        f"{done.kept} objects kept"
    )


@dataset.command("export")
def export_(
    reference: ReferenceArgument,
    out: Annotated[Path, typer.Option("--out", help="The file to write (.tar).")],
    with_runs: Annotated[bool, typer.Option("--runs", help="Also the results made of its recordings.")] = False,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """A version with its history as one file. E.g. dataset export level4@2026-11 --out /media/usb/level4.tar."""
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.store.archive import export_version
    from mineloc.store.datasets import Datasets

    with progress_bar("export") as progress:
        found = export_version(Datasets.open(store), reference, out, runs=with_runs, progress=progress)
    _told({"out": str(out), "version": found.version, "members": len(found.members)}, as_json=as_json)


@dataset.command("import")
def import_(
    file: Annotated[Path, typer.Argument(help="Of `dataset export`.")],
    name: AsOption = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take in an exported version, checked to the last byte. E.g. dataset import /media/usb/level4.tar."""
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.store.archive import import_version
    from mineloc.store.datasets import Datasets

    datasets = Datasets.open(store, create=True)
    with progress_bar("import") as progress:
        own, version = import_version(datasets, file, name=name, progress=progress)
    _told({"dataset": own, "version": version.id, "flights": len(version.recordings)}, as_json=as_json)


@dataset.command()
def push(
    reference: ReferenceArgument,
    remote: RemoteOption = None,
    check: Annotated[bool, typer.Option(help="Read everything back and hash it.")] = True,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring a version with its history to a remote. E.g. dataset push level4@2026-11 --remote s3://mine/store."""
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.store.datasets import Datasets
    from mineloc.store.exchange import push as run

    datasets = Datasets.open(store)
    place = _remote(datasets, remote)
    with progress_bar("push") as progress:
        done = run(datasets, reference, place, check=check, progress=progress)
    place.remember(datasets.store.root)
    _told({"remote": place.url, "version": done.version.id, "objects": done.objects}, as_json=as_json)


@dataset.command()
def pull(
    reference: ReferenceArgument,
    remote: RemoteOption = None,
    name: AsOption = None,
    store: StoreOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring a version from a remote, every object checked. E.g. dataset pull level4 --remote s3://mine/store."""
    from mineloc.stages.progress_bar import progress_bar
    from mineloc.store.datasets import Datasets
    from mineloc.store.exchange import pull as run

    datasets = Datasets.open(store, create=True)
    place = _remote(datasets, remote)
    with progress_bar("pull") as progress:
        done = run(datasets, reference, place, name=name, progress=progress)
    place.remember(datasets.store.root)
    _told({"remote": place.url, "version": done.version.id, "objects": done.objects}, as_json=as_json)


def _remote(datasets: Datasets, url: str | None) -> Remote:
    from mineloc.store.remote import Remote

    if url is not None:
        return Remote(url)
    if datasets.remote is None:
        raise StoreError(datasets.store.root, "has no remote yet", expected="--remote URL", todo="give it once")
    return datasets.remote


def _told(facts: dict[str, Any], *, as_json: bool) -> None:
    if as_json:
        write_json(facts)
        return
    for name, value in facts.items():
        typer.echo(f"{name} {value}")
