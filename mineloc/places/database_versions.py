"""Databases of a mine that grows: a new one takes over numbers and names of an old one, two parts become one.

Intersections are the same where they stand at the same place in the mine grid, whatever map they were found in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from mineloc.config import IntersectionsConfig
from mineloc.data import Intersection, IntersectionDatabase, Lineage
from mineloc.places.database import database_of
from mineloc.places.segmentation import kind_of

LEVEL_M = 2.0
"""Intersections farther apart in height are on two levels."""


@dataclass(frozen=True, slots=True)
class Changes:
    """What became of the intersections of the database before.

    Attributes:
        kept: ids that it knew, and that stand for the same places.
        new: ids of places that it did not know.
        retired: id and name of what is gone.
        renumbered: id in the part that was merged into it, and id now, where the two are not the same.
    """

    kept: tuple[int, ...]
    new: tuple[int, ...]
    retired: tuple[tuple[int, str], ...]
    renumbered: tuple[tuple[int, int], ...]


def renumbered_since(
    old: IntersectionDatabase, new: IntersectionDatabase, *, parent: str, apart_m: float
) -> tuple[IntersectionDatabase, Changes]:
    """The new database with the old one's ids and names where it stands at the same places.

    What is new gets ids above every id that was ever used: those of what is gone are not given again.

    Args:
        old: the version before.
        new: of the mine as it is, in its own frame.
        parent: sha256 of the file of `old`.
        apart_m: the same place is at most so far away horizontally, and `LEVEL_M` in height.

    Raises:
        ValueError: they have no common frame.
    """
    if not has_frame_of(old, is_grid=new.is_grid, map_sha256=new.map_sha256):
        raise ValueError("databases without a common frame")
    same = same_places(old.in_frame_at(new.grid_origin_m), new, apart_m=apart_m)
    fresh = count(old.lineage.next_id)
    ids = {one.id: same[one.id] if one.id in same else next(fresh) for one in new.intersections}
    before = {one.id: old.by_id(same[one.id]) if one.id in same else one for one in new.intersections}
    placed = _placed(new, ids, before)
    kept = set(same.values())
    changes = Changes(
        kept=tuple(sorted(kept)),
        new=tuple(one.id for one in placed.intersections if one.id not in kept),
        retired=tuple((one.id, one.name) for one in old.intersections if one.id not in kept),
        renumbered=(),
    )
    lineage = Lineage(old.lineage.version + 1, (parent,), next(fresh), new.lineage.maps)
    return replace(placed, lineage=lineage), changes


def merged(
    a: IntersectionDatabase, b: IntersectionDatabase, config: IntersectionsConfig, *, parents: tuple[str, str]
) -> tuple[IntersectionDatabase, Changes]:
    """Two parts of a mine as one database, in the frame of `a`, whose ids all stay.

    What both know is kept as the part knows it that recognises it better. Ids of `b` stay where `a` can never have
    used them.

    Args:
        a, b: both in the mine grid, with descriptors of the same sizes.
        config: `apart_m`, and what `database_of` takes.
        parents: sha256 of the files of `a` and `b`.

    Raises:
        ValueError: a part is not in the grid, or their descriptors cannot be compared.
    """
    if not (a.is_grid and b.is_grid):
        raise ValueError("parts that are not in the mine grid")
    b = b.in_frame_at(a.grid_origin_m)
    same = same_places(a, b, apart_m=config.apart_m)
    fresh = count(max(a.lineage.next_id, b.lineage.next_id))
    ids = {one.id: one.id for one in b.intersections if one.id >= a.lineage.next_id} | same
    ids |= {one.id: next(fresh) for one in b.intersections if one.id not in ids}
    # the radius that descriptors were made with, not that of today's configuration, is their unit
    radii = [radius_m for _, radius_m, _ in descriptor_sizes(a) | descriptor_sizes(b)]
    union = database_of(
        _union(a, b, ids),
        config.model_copy(update={"contour_radius_m": radii[0]} if radii else {}),
        grid_origin_m=a.grid_origin_m,
        is_grid=True,
        map_sha256="",
    )
    changes = Changes(
        kept=tuple(one.id for one in a.intersections),
        new=tuple(sorted(ids[one.id] for one in b.intersections if one.id not in same)),
        retired=(),
        renumbered=tuple((was, now) for was, now in sorted(ids.items()) if was != now),
    )
    return replace(union, lineage=_of_both(a.lineage, b.lineage, parents, next(fresh))), changes


def has_frame_of(known: IntersectionDatabase, *, is_grid: bool, map_sha256: str) -> bool:
    """Whether places of a database can be compared with those of a map: by the mine grid, or as it is of that map."""
    return (known.is_grid and is_grid) or known.map_sha256 == map_sha256


def descriptor_sizes(known: IntersectionDatabase) -> set[tuple[int, float, int]]:
    """Bins, radius (m) and rows of its contours and matrices; of a database that is whole at most one of each."""
    return {(one.matrix.shape[1], one.contour.radius_m, len(one.matrix)) for one in known.intersections}


def same_places(a: IntersectionDatabase, b: IntersectionDatabase, *, apart_m: float) -> dict[int, int]:
    """Id in `a` by id in `b` of the intersections that are one, nearest pairs first, each in one pair at most.

    Args:
        a, b: in one frame.
        apart_m: greatest horizontal distance.
    """
    at_a, at_b = (np.array([one.point_map for one in known.intersections]).reshape(-1, 3) for known in (a, b))
    offset = at_a[:, None] - at_b[None]
    near = (np.hypot(offset[..., 0], offset[..., 1]) <= apart_m) & (np.abs(offset[..., 2]) <= LEVEL_M)
    distance = np.linalg.norm(offset, axis=-1)
    pairs = sorted((float(distance[i, j]), int(i), int(j)) for i, j in np.argwhere(near))
    taken: dict[int, int] = {}
    for _, i, j in pairs:
        if j not in taken and i not in taken.values():
            taken[j] = i
    return {b.intersections[j].id: a.intersections[i].id for j, i in taken.items()}


def _placed(
    new: IntersectionDatabase, ids: Mapping[int, int], before: Mapping[int, Intersection]
) -> IntersectionDatabase:
    """A database under other ids, by its own ones, with all that goes by their order."""
    order = sorted(range(len(new)), key=lambda k: ids[new.intersections[k].id])
    found = [new.intersections[k] for k in order]
    ways = [tuple(sorted((ids[to], length_m) for to, length_m in one.neighbours if to in ids)) for one in found]
    placed = [
        replace(_known_as(one, before[one.id], ids[one.id]), neighbours=near)
        for one, near in zip(found, ways, strict=True)
    ]
    return replace(
        new,
        intersections=tuple(placed),
        lineage=replace(new.lineage, next_id=max(ids.values(), default=-1) + 1),
        contour_similarity=new.contour_similarity[np.ix_(order, order)],
        matrix_similarity=new.matrix_similarity[np.ix_(order, order)],
        twins=tuple(sorted((min(ids[a], ids[b]), max(ids[a], ids[b])) for a, b in new.twins)),
    )


def _of_both(a: Lineage, b: Lineage, parents: tuple[str, str], next_id: int) -> Lineage:
    return Lineage(
        version=max(a.version, b.version) + 1,
        parents=tuple(dict.fromkeys(parents)),
        next_id=next_id,
        maps=tuple(sorted({*a.maps, *b.maps})),
    )


def _union(a: IntersectionDatabase, b: IntersectionDatabase, ids: Mapping[int, int]) -> list[Intersection]:
    """The intersections of both, those of `b` under the ids given, with the ways of both."""
    union = {one.id: one for one in a.intersections}
    for one in b.intersections:
        known = union.get(ids[one.id])
        union[ids[one.id]] = _known_as(one, one, ids[one.id]) if known is None else _better(known, one)
    ways = _ways(a, {one.id: one.id for one in a.intersections})
    for pair, length_m in _ways(b, ids).items():
        ways[pair] = min(length_m, ways.get(pair, length_m))
    return [replace(union[id], neighbours=_neighbours(ways, id)) for id in sorted(union)]


def _better(one: Intersection, other: Intersection) -> Intersection:
    """What is known of one place twice, under the first one's id; what a person said of it stays."""
    told = other if _is_told(other) and not _is_told(one) else one
    return _known_as(other if other.quality > one.quality else one, told, one.id)


def _known_as(one: Intersection, before: Intersection, id: int) -> Intersection:
    """An intersection under an id, called as before; a kind that a person chose holds while the shape is as it was."""
    is_as_it_was = kind_of(one.contour.branches_rad) == kind_of(before.contour.branches_rad)
    kind = before.kind if _is_told(before) and is_as_it_was else one.kind
    return replace(one, id=id, kind=kind, name=before.name if _is_named(before) else f"{kind} {id}")


def _is_named(one: Intersection) -> bool:
    return one.name != f"{one.kind} {one.id}"


def _is_told(one: Intersection) -> bool:
    """Whether a person gave the name or the kind."""
    return _is_named(one) or one.kind not in ("bay", kind_of(one.contour.branches_rad))


def _ways(known: IntersectionDatabase, ids: Mapping[int, int]) -> dict[tuple[int, int], float]:
    """Length of the shortest way between two neighbours, by their rising new ids."""
    ways: dict[tuple[int, int], float] = {}
    for one in known.intersections:
        for other, length_m in one.neighbours:
            if other in ids:
                a, b = sorted((ids[one.id], ids[other]))
                ways[a, b] = min(length_m, ways.get((a, b), length_m))
    return ways


def _neighbours(ways: Mapping[tuple[int, int], float], id: int) -> tuple[tuple[int, float], ...]:
    return tuple(sorted((a + b - id, length_m) for (a, b), length_m in ways.items() if id in (a, b)))
