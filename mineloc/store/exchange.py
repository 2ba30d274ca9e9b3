"""Versions to and from a remote."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mineloc.errors import StoreError
from mineloc.progress import Progress, quiet
from mineloc.store.datasets import Datasets
from mineloc.store.digest import is_digest, sha256_of_text
from mineloc.store.refs import LATEST, split_reference
from mineloc.store.remote import Remote
from mineloc.store.versions import Version, history, reached


@dataclass(frozen=True, slots=True)
class Exchanged:
    """What a push or pull did.

    Attributes:
        version: which was brought over, with its history.
        objects: how many objects had to be.
    """

    version: Version
    objects: int


def push(
    datasets: Datasets, reference: str, remote: Remote, *, check: bool = True, progress: Progress = quiet
) -> Exchanged:
    """Bring a version to a remote; objects that are there already are not sent again.

    `latest` moves there if the version follows the one that it names; a tag is set there too.

    Args:
        check: read every object back and hash it.
        progress: told of objects.

    Raises:
        StoreError: no such version, an object of it is damaged, `latest` there would lose history, or the remote fails.
    """
    version = datasets.get(reference)
    name, which = split_reference(reference)
    moves = _refuse_lost_history(datasets, name, version, remote.read_ref(name, LATEST))
    objects = datasets.store.objects
    sent = 0
    wanted = reached(datasets.read_text, version.id)
    for i, digest in enumerate(wanted):
        path = objects.path(digest)
        if not path.exists():
            raise StoreError(path, "gone", expected="an intact object", todo="import or pull it anew")
        if not remote.has(digest, path.stat().st_size):
            remote.put(digest, path, check=check)
            sent += 1
        progress(i + 1, len(wanted), "objects")
    if moves:
        remote.write_ref(name, LATEST, version.id)
    if which in datasets.refs.tags(name):
        remote.write_ref(name, f"tags/{which}", version.id)
    return Exchanged(version, sent)


def _refuse_lost_history(datasets: Datasets, name: str, version: Version, there: str | None) -> bool:
    """Whether `latest` of the remote moves to the version."""
    if there is None:
        return True
    if any(one.id == there for one in history(datasets.read_text, version.id)):
        return there != version.id
    if any(
        one.id == version.id
        for known in datasets.versions(name)
        if known.id == there
        for one in history(datasets.read_text, known.id)
    ):
        return False
    raise StoreError(
        f"{name}@{version.id[:12]}",
        f"does not follow the remote's latest ({there[:12]}), whose history would be lost",
        todo="pull first",
    )


def pull(
    datasets: Datasets, reference: str, remote: Remote, *, name: str | None = None, progress: Progress = quiet
) -> Exchanged:
    """Bring a version from a remote: `name`, `name@tag` or `name@<whole id>`. Nothing is visible before all is checked.

    Args:
        name: of the dataset here; None: the same.
        progress: told of objects.

    Raises:
        StoreError: it is not there or damaged there, or history would be lost here.
    """
    theirs, which = split_reference(reference)
    ref = LATEST if which == LATEST else f"tags/{which}"
    version_id = which if is_digest(which) else remote.read_ref(theirs, ref)
    if version_id is None:
        raise StoreError(f"{remote.url}: {reference}", "no such version", expected="latest, a tag or a whole id")
    with datasets.store.workspaces.hold(f"pull-{sha256_of_text(reference)}") as workspace:
        files: dict[str, Path] = {}

        def read(digest: str) -> str:
            return _fetched(datasets, remote, digest, workspace, files).read_text()

        wanted = reached(read, version_id)
        for i, digest in enumerate(wanted):
            _fetched(datasets, remote, digest, workspace, files)
            progress(i + 1, len(wanted), "objects")
        tag = None if which == LATEST or is_digest(which) else which
        return Exchanged(datasets.land(name or theirs, version_id, files, tag=tag), len(files))


def _fetched(datasets: Datasets, remote: Remote, digest: str, workspace: Path, files: dict[str, Path]) -> Path:
    """Where an intact object lies: in the store, or in the workspace, brought there now."""
    if digest in files:
        return files[digest]
    if datasets.store.objects.is_intact(digest):
        return datasets.store.objects.path(digest)
    to = workspace / digest
    if not remote.fetch(digest, to):
        raise StoreError(f"{remote.url}: object {digest[:12]}", "not there", todo="push it anew from where it is whole")
    files[digest] = to
    return to
