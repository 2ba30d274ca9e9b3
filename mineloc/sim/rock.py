"""The surface of a planned mine: profiles swept along centre-lines, joined, roughened, and turned into triangles.

The rock is a signed distance that is negative in the free space: the union of all roadways and rooms is the least of
their distances, so intersections open by themselves; pillars are taken out of it. The field is sampled in blocks near
centre-lines and rooms only and meshed with surface nets (Gibson, *Constrained elastic surface nets*, 1998): one vertex
a cell that the surface passes, at the mean of the crossings of its edges; one quadrilateral an edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mineloc.compiled import njit
from mineloc.sim.plan import BoxPlan, MinePlan

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BLOCK = 24
FOOT_M = 1.0
FINE_CELLS = 2.5
# standard deviation of one octave of the lattice noise below, measured over 10⁶ points
NOISE_SIGMA = 0.270


def rock_mesh(plan: MinePlan) -> tuple[F64, I64]:
    """Vertices (n, 3) and triangles (m, 3) of a plan's surface, closed, wound to face the free space."""
    segments, rooms, pillars = _segments(plan), _boxes(plan.room), _boxes(plan.pillar)
    blocks = _blocks(segments, rooms, plan)
    octaves = _octaves(plan)
    keys: list[I64] = []
    vertices: list[F64] = []
    quads: list[I64] = []
    for block in blocks:
        low, size = block * BLOCK * plan.cell_m, BLOCK * plan.cell_m
        field = _field(
            segments[_near(segments, low, size)],
            rooms[_box_near(rooms, low, size)],
            pillars[_box_near(pillars, low, size)],
            octaves,
            block * BLOCK - 1,
            BLOCK + 2,
            plan.cell_m,
            plan.roughness.floor,
            plan.seed,
        )
        key, vertex, quad = _surface_nets(field, block * BLOCK - 1, plan.cell_m)
        keys.append(key)
        vertices.append(vertex)
        quads.append(quad)
    names, first = np.unique(np.concatenate(keys), return_index=True)
    quad = np.searchsorted(names, np.concatenate(quads).reshape(-1, 4))
    triangles = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return np.concatenate(vertices)[first], triangles


def _segments(plan: MinePlan) -> F64:
    """(k, 9) rows `[ax ay az bx by bz half-width height spring-height]` of all straight pieces."""
    rows: list[F64] = []
    for road in plan.roadway:
        line = road.line_m
        profile = np.array([road.width_m / 2, road.height_m, road.height_m * (1 - road.arch)])
        rows += [np.concatenate([a, b, profile]) for a, b in pairwise(line)]
    return np.array(rows)


def _boxes(plans: Sequence[BoxPlan]) -> F64:
    """(k, 8) rows `[x y z half-length half-width height cos sin]`."""
    rows = np.empty((len(plans), 8))
    for row, box in zip(rows, plans, strict=True):
        heading = np.deg2rad(box.heading_deg)
        row[:] = *box.centre_m, box.length_m / 2, box.width_m / 2, box.height_m, np.cos(heading), np.sin(heading)
    return rows


def _octaves(plan: MinePlan) -> F64:
    """(k, 2) rows `[wavelength, amplitude]`: octaves of equal slope between the longest and the shortest, and fine."""
    rough = plan.roughness
    count = max(1, round(np.log2(rough.longest_m / rough.shortest_m)) + 1)
    wave = rough.longest_m * (rough.shortest_m / rough.longest_m) ** (np.arange(count) / max(count - 1, 1))
    amplitude = wave * rough.wall_m / np.linalg.norm(wave) / NOISE_SIGMA
    fine = [FINE_CELLS * plan.cell_m, rough.fine_m / NOISE_SIGMA]
    return np.vstack([np.column_stack([wave, amplitude]), fine])


def _margin(plan: MinePlan) -> float:
    rough = plan.roughness
    return 4 * float(np.hypot(rough.wall_m, rough.fine_m)) + 3 * plan.cell_m


def _blocks(segments: F64, rooms: F64, plan: MinePlan) -> I64:
    """(k, 3) indices of the blocks that any roadway or room may reach into, sorted."""
    size = BLOCK * plan.cell_m
    margin = _margin(plan)
    found: list[I64] = []
    for row in segments:
        a, b, half, height = row[:3], row[3:6], row[6], row[7]
        count = max(2, int(np.ceil(np.linalg.norm(b - a) / (size / 2))) + 1)
        points = a + np.linspace(0, 1, count)[:, None] * (b - a)
        step = np.abs(b - a) / (count - 1)
        low = np.floor((points - np.array([half, half, 0.0]) - margin - step) / size).astype(np.int64)
        high = np.floor((points + np.array([half, half, height]) + margin + step) / size).astype(np.int64)
        found += [_between(one, other) for one, other in zip(low, high, strict=True)]
    for row in rooms:
        reach = _reach(row)
        low = row[:3] - np.append(reach, 0.0) - margin
        high = row[:3] + np.append(reach, row[5]) + margin
        found.append(_between(np.floor(low / size).astype(np.int64), np.floor(high / size).astype(np.int64)))
    return np.unique(np.concatenate(found), axis=0)


def _between(low: I64, high: I64) -> I64:
    """(k, 3) all indices from `low` to `high`, both included."""
    axes = [np.arange(low[k], high[k] + 1) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _reach(box: F64) -> F64:
    """(2,) half extents along x and y of a turned box."""
    c, s = abs(box[6]), abs(box[7])
    return np.array([c * box[3] + s * box[4], s * box[3] + c * box[4]])


def _near(segments: F64, low_m: F64, size_m: float) -> NDArray[np.bool_]:
    """The segments whose boxes, two metres larger, touch a block; others cannot be the nearest surface there."""
    half = segments[:, 6:7] + 2.0
    a, b = segments[:, :3], segments[:, 3:6]
    box_low = np.minimum(a, b) - np.concatenate([half, half, np.full_like(half, 2.0)], axis=1)
    box_high = np.maximum(a, b) + np.concatenate([half, half, segments[:, 7:8] + 2.0], axis=1)
    return np.all((box_low <= low_m + size_m) & (box_high >= low_m), axis=1)


def _box_near(boxes: F64, low_m: F64, size_m: float) -> NDArray[np.bool_]:
    """As `_near`, for rooms and pillars."""
    reach = np.array([_reach(row) for row in boxes]).reshape(-1, 2) + 2.0
    low = boxes[:, :3] - np.column_stack([reach, np.full(len(boxes), 2.0 + FOOT_M)])
    high = boxes[:, :3] + np.column_stack([reach, boxes[:, 5] + 2.0])
    return np.all((low <= low_m + size_m) & (high >= low_m), axis=1)


@njit(cache=True)
def _field(
    segments: F64,
    rooms: F64,
    pillars: F64,
    octaves: F64,
    first: I64,
    count: int,
    cell: float,
    floor: float,
    seed: int,
) -> F64:
    """(count, count, count) signed distance to the rock at grid points, roughness included."""
    out = np.full((count, count, count), 10.0)
    # farther from the profile than this, roughness cannot bring the surface here
    reach = 0.0
    for k in range(len(octaves)):
        reach += octaves[k, 1]
    for i in range(count):
        x = (first[0] + i) * cell
        for j in range(count):
            y = (first[1] + j) * cell
            for k in range(count):
                z = (first[2] + k) * cell
                value, near_floor = _union(segments, rooms, x, y, z)
                value = max(value, -_solid(pillars, x, y, z))
                if abs(value) < reach:
                    rough = 0.0
                    for o in range(len(octaves)):
                        wave = octaves[o, 0]
                        rough += octaves[o, 1] * _noise(x / wave, y / wave, z / wave, seed * 64 + o)
                    value += rough * (floor + (1.0 - floor) * near_floor)
                out[i, j, k] = value
    return out


@njit(cache=True)
def _union(segments: F64, rooms: F64, x: float, y: float, z: float) -> tuple[float, float]:
    """Signed distance to the surface of the nearest roadway or room, and 0 on its floor … 1 half a metre above it."""
    best, above = 10.0, 1.0
    for s in range(len(segments)):
        ux, uy = segments[s, 3] - segments[s, 0], segments[s, 4] - segments[s, 1]
        px, py = x - segments[s, 0], y - segments[s, 1]
        u = min(max((px * ux + py * uy) / max(ux * ux + uy * uy, 1e-12), 0.0), 1.0)
        side = np.hypot(px - u * ux, py - u * uy)
        up = z - (segments[s, 2] + u * (segments[s, 5] - segments[s, 2]))
        value = _profile(side, up, segments[s, 6], segments[s, 7], segments[s, 8])
        if value < best:
            best = value
            above = min(max(2.0 * up, 0.0), 1.0)
    for r in range(len(rooms)):
        up = z - rooms[r, 2]
        value = max(_rectangle(rooms[r], x, y), -up, up - rooms[r, 5])
        if value < best:
            best = value
            above = min(max(2.0 * up, 0.0), 1.0)
    return best, above


@njit(cache=True)
def _solid(pillars: F64, x: float, y: float, z: float) -> float:
    """Signed distance to the nearest pillar, negative in it; they stand deeper than any floor is uneven."""
    best = 10.0
    for p in range(len(pillars)):
        up = z - pillars[p, 2]
        best = min(best, max(_rectangle(pillars[p], x, y), -FOOT_M - up, up - pillars[p, 5]))
    return best


@njit(cache=True)
def _rectangle(box: F64, x: float, y: float) -> float:
    """Signed distance in plan to a turned rectangle."""
    px, py = x - box[0], y - box[1]
    along = abs(box[6] * px + box[7] * py) - box[3]
    side = abs(box[6] * py - box[7] * px) - box[4]
    return np.hypot(max(along, 0.0), max(side, 0.0)) + min(max(along, side), 0.0)


@njit(cache=True)
def _profile(side: float, up: float, half: float, height: float, spring: float) -> float:
    """Signed distance (first order) to a profile: straight walls up to the spring line, a half ellipse above."""
    below = -up
    if up <= spring or height - spring < 1e-6:
        return max(side - half, below, up - height)
    a, b = half, height - spring
    p, q = side / a, (up - spring) / b
    k = np.sqrt(p * p + q * q)
    slope = np.sqrt((p / a) ** 2 + (q / b) ** 2)
    return k * (k - 1.0) / max(slope, 1e-9) if k > 1e-9 else -min(a, b)


@njit(cache=True)
def _noise(x: float, y: float, z: float, seed: int) -> float:
    """Gradient noise on the integer lattice (Perlin 2002): zero at lattice points, smooth, within ±1."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    dx, dy, dz = x - fx, y - fy, z - fz
    wx = dx * dx * dx * (dx * (6 * dx - 15) + 10)
    wy = dy * dy * dy * (dy * (6 * dy - 15) + 10)
    wz = dz * dz * dz * (dz * (6 * dz - 15) + 10)
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                h = _hash(ix + a, iy + b, iz + c, seed)
                # the twelve directions to the edges of a cube
                axis, sign1, sign2 = h % 3, 1.0 - 2.0 * ((h >> 4) & 1), 1.0 - 2.0 * ((h >> 5) & 1)
                ex, ey, ez = dx - a, dy - b, dz - c
                if axis == 0:
                    slope = sign1 * ey + sign2 * ez
                elif axis == 1:
                    slope = sign1 * ex + sign2 * ez
                else:
                    slope = sign1 * ex + sign2 * ey
                weight = (wx if a else 1 - wx) * (wy if b else 1 - wy) * (wz if c else 1 - wz)
                total += weight * slope
    return total


@njit(cache=True)
def _hash(x: int, y: int, z: int, seed: int) -> int:
    """A well-mixed non-negative integer for a lattice point (multiply and shift, 32 bits)."""
    h = (x * 73856093) ^ (y * 19349663) ^ (z * 83492791) ^ (seed * 2654435761)
    h &= 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    return h ^ (h >> 16)


@njit(cache=True)
def _surface_nets(field: F64, first: I64, cell: float) -> tuple[I64, F64, I64]:
    """Vertices of a block's cells and the quadrilaterals of its edges.

    The block's field begins one cell early, so that the four cells round each of its own edges are there; vertices are
    named by their cell, equal in neighbouring blocks.

    Returns:
        names (n,), vertices (n, 3), quads (m, 4) of names.
    """
    size = field.shape[0]
    names = np.empty(size**3, np.int64)
    vertices = np.empty((size**3, 3))
    quads = np.empty((3 * size**3, 4), np.int64)
    n = m = 0
    for i in range(size - 1):
        for j in range(size - 1):
            for k in range(size - 1):
                found, vx, vy, vz = _cell_vertex(field, i, j, k)
                if found:
                    names[n] = _name(first[0] + i, first[1] + j, first[2] + k)
                    vertices[n, 0] = (first[0] + i + vx) * cell
                    vertices[n, 1] = (first[1] + j + vy) * cell
                    vertices[n, 2] = (first[2] + k + vz) * cell
                    n += 1
    for i in range(1, size - 1):
        for j in range(1, size - 1):
            for k in range(1, size - 1):
                here = field[i, j, k] < 0
                for axis in range(3):
                    di, dj, dk = axis == 0, axis == 1, axis == 2
                    if here == (field[i + di, j + dj, k + dk] < 0):
                        continue
                    # the two other directions, in cyclic order
                    bi, bj, bk = axis == 2, axis == 0, axis == 1
                    ci, cj, ck = axis == 1, axis == 2, axis == 0
                    x, y, z = first[0] + i, first[1] + j, first[2] + k
                    quads[m, 0] = _name(x - bi - ci, y - bj - cj, z - bk - ck)
                    quads[m, 2] = _name(x, y, z)
                    one, other = _name(x - ci, y - cj, z - ck), _name(x - bi, y - bj, z - bk)
                    quads[m, 1] = other if here else one
                    quads[m, 3] = one if here else other
                    m += 1
    return names[:n], vertices[:n], quads[:m]


@njit(cache=True)
def _name(x: int, y: int, z: int) -> int:
    """One number for a cell; 2²⁰ cells each way."""
    offset = 1 << 20
    return ((x + offset) << 42) | ((y + offset) << 21) | (z + offset)


@njit(cache=True)
def _cell_vertex(field: F64, i: int, j: int, k: int) -> tuple[bool, float, float, float]:
    """Mean of the zero crossings on a cell's twelve edges, in cell units from its corner."""
    count = 0
    sx = sy = sz = 0.0
    for axis in range(3):
        for p in range(2):
            for q in range(2):
                # corner where the edge starts: 0 along its axis, (p, q) along the other two
                a = 0 if axis == 0 else p
                b = 0 if axis == 1 else (p if axis == 0 else q)
                c = 0 if axis == 2 else q
                start = field[i + a, j + b, k + c]
                end = field[i + a + (axis == 0), j + b + (axis == 1), k + c + (axis == 2)]
                if (start < 0) != (end < 0):
                    u = start / (start - end)
                    sx += a + (u if axis == 0 else 0.0)
                    sy += b + (u if axis == 1 else 0.0)
                    sz += c + (u if axis == 2 else 0.0)
                    count += 1
    if not count:
        return False, 0.0, 0.0, 0.0
    return True, sx / count, sy / count, sz / count
