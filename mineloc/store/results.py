"""Which results were made of which recordings: the records of a store, followed from input to output."""

from __future__ import annotations

from pathlib import Path

from mineloc.store.record import Action, Record, read_action
from mineloc.store.store import Store
from mineloc.store.versions import Version


def all_records(store: Store) -> dict[Path, tuple[Action, Record]]:
    """Every intact record whose output is here, by its file, sorted."""
    found = {path: entry for path in store.records.paths() if (entry := read_action(path)) is not None}
    return {path: entry for path, entry in found.items() if store.lookup(entry[0]) is not None}


def results_of(store: Store, version: Version) -> dict[Path, Record]:
    """The records of all that was made of a version's recordings, directly or through other results."""
    made = {one.sha256 for one in version.recordings}
    left = all_records(store)
    found: dict[Path, Record] = {}
    while ready := [path for path, (action, _) in left.items() if made.intersection(input_digests(action))]:
        for path in ready:
            found[path] = left.pop(path)[1]
            made.add(found[path].output.digest)
    return dict(sorted(found.items()))


def input_digests(action: Action) -> list[str]:
    """The content of all inputs."""
    return [digest for many in action.inputs.values() for _, digest in many]
