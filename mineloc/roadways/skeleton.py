"""The centre-line of the free-space sheet: thinning that keeps every loop, then chains of cells."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.roadways.sheet import Sheet, components

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
I32 = NDArray[np.int32]
Bool = NDArray[np.bool_]


def thin(links: I32, clearance: F64) -> Bool:
    """(n,) cells of the skeleton: cells are removed in the order of rising clearance.

    A cell goes if this neither cuts nor closes anything (Hilditch's crossing number of its 8 neighbours is one) and it
    is not the end of a line. Equals go in a shuffled order: the ridge of an even width is two cells wide, and taken in
    rows it would come off from its end, cell by cell, with nothing left. Working on links, it needs no picture, so
    levels may lie over one another.

    Args:
        links: (n, 8) neighbours, counter-clockwise from +x, -1: none.
        clearance: (n,) distance to the nearest rock.
    """
    shuffled = np.random.default_rng(0).permutation(len(clearance))
    return _thin(links, np.lexsort((shuffled, clearance)))


@njit(cache=True)
def _thin(links: I32, order: I64) -> Bool:
    alive = np.ones(len(links), np.bool_)
    around = np.empty(8, np.bool_)
    changed = True
    while changed:
        changed = False
        for i in order:
            if not alive[i]:
                continue
            count = 0
            for k in range(8):
                around[k] = links[i, k] >= 0 and alive[links[i, k]]
                count += around[k]
            if count <= 1:
                continue
            crossings = 0
            for k in range(0, 8, 2):
                if not around[k] and (around[k + 1] or around[(k + 2) % 8]):
                    crossings += 1
            if crossings == 1:
                alive[i] = False
                changed = True
    return alive


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Skeleton cells in a row.

    Attributes:
        cells: (k,) indices in the sheet.
        start, end: junction (its number) at either end, None: a dead end.
    """

    cells: I64
    start: int | None
    end: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """Junctions and the chains between them.

    Attributes:
        junctions: for each junction its cells.
        chains: all of them.
    """

    junctions: list[I64]
    chains: list[Chain]


def trace(sheet: Sheet, alive: Bool) -> Skeleton:
    """Take the skeleton apart: cells with three or more neighbours are junctions, the others form chains."""
    cells = np.flatnonzero(alive)
    links = sheet.keep(alive).links
    branching = (links >= 0).sum(axis=1) >= 3
    junction_of = _numbered(links, branching)
    junctions = [cells[junction_of == j] for j in range(int(junction_of.max(initial=-1)) + 1)]
    chain_of = _numbered(links, ~branching)
    by_chain = np.argsort(chain_of, kind="stable")
    first = np.searchsorted(chain_of[by_chain], np.arange(int(chain_of.max(initial=-1)) + 2))
    chains = [_chain(by_chain[a:b], links, chain_of, junction_of, cells) for a, b in pairwise(first)]
    return Skeleton(junctions, chains)


def _numbered(links: I32, members: Bool) -> I64:
    """(n,) number of the connected part among the members, -1 for the others."""
    index = np.full(len(links) + 1, -1, np.int32)
    index[:-1][members] = np.arange(int(members.sum()), dtype=np.int32)
    out = np.full(len(links), -1, np.int64)
    out[members] = components(np.ascontiguousarray(index[links[members]]))
    return out


def _chain(members: I64, links: I32, chain_of: I64, junction_of: I64, cells: I64) -> Chain:
    """Order the cells of one chain and see what lies at its ends."""
    own = chain_of[members[0]]

    def beside(cell: int) -> list[int]:
        return [int(j) for j in links[cell] if j >= 0 and chain_of[j] == own]

    start = next((int(cell) for cell in members if len(beside(int(cell))) <= 1), int(members[0]))
    row = [start]
    seen = {start}
    while True:
        ahead = [cell for cell in beside(row[-1]) if cell not in seen]
        if not ahead:
            break
        row.append(ahead[0])
        seen.add(ahead[0])
    touched = [
        [int(junction_of[j]) for j in links[cell] if j >= 0 and junction_of[j] >= 0] for cell in (row[0], row[-1])
    ]
    if len(row) == 1:
        both = touched[0]
        touched = [both[:1], both[1:2]]
    head, tail = (junctions[0] if junctions else None for junctions in touched)
    return Chain(cells[np.array(row)], head, tail)
