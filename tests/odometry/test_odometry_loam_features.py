from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from analytic_scenes import room, smooth_tunnel, vlp16_sweep, with_pillar
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc import se3
from mineloc.config import LoamConfig
from mineloc.data import F32, F64, Sweep
from mineloc.odometry.loam_features import (
    FLAT,
    LESS_SHARP,
    PLAIN,
    REGION,
    SHARP,
    UNUSED,
    LoamFeatures,
    curvature_plainly,
    extract_features,
    label_points,
    ring_starts,
)

HALF = np.array([6.0, 4.0, 1.5])
AT = se3.exp([0, 0, 0.3, 0.7, -0.4, 0.1])


@cache
def room_sweep(*, pillar: bool = False, sigma_m: float = 0.0) -> Sweep:
    scene = room(*HALF)
    scene = with_pillar(scene, 3.0, 1.0, 0.4) if pillar else scene
    return vlp16_sweep(scene, AT, np.zeros(6), sigma_m=sigma_m, rng=np.random.default_rng(0))


def features(sweep: Sweep, **changes: object) -> LoamFeatures:
    return extract_features(sweep, LoamConfig.model_validate(changes))


def distance_to_edges(sweep: Sweep) -> F64:
    """To the nearest edge of the room: the second smallest distance to its walls."""
    return np.sort(HALF - np.abs(se3.apply(AT, sweep.points_lidar)), axis=1)[:, 1]


def test_sharp_points_lie_on_the_edges_of_a_room_and_flat_ones_on_its_walls() -> None:
    found = features(room_sweep())
    assert len(found.sharp) >= 40
    assert distance_to_edges(found.sharp).max() < 0.15
    assert len(found.flat) == 4 * 6 * 16
    assert np.sort(HALF - np.abs(se3.apply(AT, found.flat.points_lidar)), axis=1)[:, 0].max() < 1e-3
    assert np.median(distance_to_edges(found.flat)) > 0.5


def test_counts_stay_within_the_published_limits() -> None:
    sweep = room_sweep(sigma_m=0.03)  # noise at which every second point passes for an edge (METHOD 0.6)
    found = features(sweep)
    rings = [np.bincount(f.ring, minlength=16) for f in (found.sharp, found.less_sharp, found.flat)]  # type: ignore[arg-type]
    assert rings[0].max() == 2 * 6
    assert rings[1].max() <= 20 * 6
    assert rings[1].min() > 2 * 6
    assert rings[2].max() <= 4 * 6
    sharp = {tuple(p) for p in found.sharp.points_lidar}
    assert sharp <= {tuple(p) for p in found.less_sharp.points_lidar}


def test_less_flat_points_are_one_a_voxel_and_ring() -> None:
    found = features(room_sweep(), less_flat_voxel_m=0.2)
    cells = np.floor(found.less_flat.points_lidar.astype(float) / 0.2)
    assert found.less_flat.ring is not None
    keyed = np.column_stack([cells, found.less_flat.ring])
    assert len(np.unique(keyed, axis=0)) >= 0.99 * len(keyed)
    assert 1000 < len(found.less_flat) < 0.4 * len(room_sweep())
    assert found.less_flat.offsets_ns is not None
    azimuth = np.arctan2(-found.less_flat.points_lidar[:, 1], found.less_flat.points_lidar[:, 0]) % (2 * np.pi)
    expected = azimuth / (2 * np.pi) * 99.5e6
    assert np.median(np.abs(found.less_flat.offsets_ns - expected)) < 0.2e6  # times were averaged with the points


def test_the_shadow_of_a_pillar_is_no_edge() -> None:
    """Points on the far wall beside a pillar's outline jump in depth without an edge being there."""

    def false_edges(*, reject: bool) -> int:
        sharp = features(room_sweep(pillar=True), reject_unreliable=reject).sharp
        p = se3.apply(AT, sharp.points_lidar)
        on_pillar = np.abs(p[:, :2] - [3.0, 1.0]).max(axis=1) < 0.45
        return int((~on_pillar & (distance_to_edges(sharp) > 0.25)).sum())

    assert false_edges(reject=True) == 0
    assert false_edges(reject=False) > 10


def test_walls_along_the_beam_are_no_edges() -> None:
    """Far along a tunnel neighbours lie so wide apart that a smooth wall has the curvature of an edge."""
    sweep = vlp16_sweep(smooth_tunnel(), np.eye(4), np.zeros(6))

    def false_edges(*, reject: bool) -> int:
        p = np.abs(features(sweep, reject_unreliable=reject).less_sharp.points_lidar)
        on_one_wall = np.abs((2.0 - p[:, 1]) - (1.5 - p[:, 2])) > 0.3
        return int((on_one_wall & (p[:, 0] > 8)).sum())

    assert false_edges(reject=True) == 0
    assert false_edges(reject=False) > 100


def label_plainly(points: F32, starts: np.ndarray, config: LoamConfig) -> np.ndarray:
    """A-LOAM's picking without rejection, as its paper tells it."""
    labels = np.full(len(points), UNUSED)
    p = points.astype(float)
    for s, e in pairwise(starts):
        a, b = s + REGION, e - REGION - 1
        if b - a < config.sectors:
            continue
        curvature = np.full(len(points), np.nan)
        curvature[a : b + 1] = curvature_plainly(points[s:e])
        labels[a:b] = PLAIN
        taken: set[int] = set()

        def take(i: int, label: int, taken: set[int] = taken) -> None:
            labels[i] = label
            taken.add(i)
            for side in (1, -1):
                for k in range(1, REGION + 1):
                    if np.sum((p[i + side * k] - p[i + side * (k - 1)]) ** 2) > config.neighbour_gap_m2:
                        break
                    taken.add(i + side * k)

        for sector in range(config.sectors):
            first, last = (a + (b - a) * k // config.sectors for k in (sector, sector + 1))
            order = first + np.argsort(curvature[first:last], kind="stable")
            edges = flats = 0
            for i in order[::-1]:
                if (
                    i not in taken
                    and curvature[i] > config.curvature_threshold_m2
                    and edges < config.less_sharp_per_sector
                ):
                    edges += 1
                    take(int(i), SHARP if edges <= config.sharp_per_sector else LESS_SHARP)
            for i in order:
                if i not in taken and curvature[i] < config.curvature_threshold_m2 and flats < config.flat_per_sector:
                    flats += 1
                    take(int(i), FLAT)
    return labels


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 1000), sigma=st.sampled_from([0.0, 0.01, 0.05]))
def test_the_kernel_picks_what_the_plain_version_picks(seed: int, sigma: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 300))
    angle = np.linspace(0, 3, n)
    radius = 3 + np.cumsum(rng.choice([0.0, 0.0, 0.0, 0.4], n) * rng.normal(0, 1, n)) + rng.normal(0, sigma, n)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(n)], 1).astype(np.float32)
    ring = np.sort(rng.integers(0, 3, n)).astype(np.uint16)
    config = LoamConfig(reject_unreliable=False)
    starts = ring_starts(Sweep(0, points, None, ring))
    fast = label_points(points, starts, 0.1, 6, 2, 20, 4, 0.05, False)
    assert np.array_equal(fast, label_plainly(points, starts, config))


@given(seed=st.integers(0, 1000))
def test_curvature_of_a_straight_even_line_is_zero_and_does_not_depend_on_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    line = rng.normal(0, 1, 3) + np.arange(30)[:, None] * rng.normal(0, 0.02, 3)
    assert curvature_plainly(line.astype(np.float32)).max() < 1e-8
    bent = rng.normal(0, 0.1, (30, 3)).astype(np.float32)
    assert np.allclose(curvature_plainly(bent), curvature_plainly(bent + np.float32(2.0)), rtol=1e-3, atol=1e-4)


def test_curvature_of_pure_noise_is_the_published_threshold_at_3_cm() -> None:
    """METHOD 0.6: mean 110 σ² an axis of noise; 0.099 for σ = 3 cm."""
    noise = np.zeros((20_000, 3), np.float32)
    noise[:, 0] = np.random.default_rng(0).normal(0, 0.03, len(noise))
    assert curvature_plainly(noise).mean() == pytest.approx(0.099, rel=0.05)


def test_empty_and_short_sweeps_have_no_features() -> None:
    for n in (0, 1, 11, 16):
        sweep = Sweep(0, np.ones((n, 3), np.float32), None, np.zeros(n, np.uint16))
        found = features(sweep)
        assert [len(f) for f in (found.sharp, found.less_sharp, found.flat, found.less_flat)] == [0, 0, 0, 0]


def test_points_at_the_sensor_itself_do_no_harm() -> None:
    sweep = room_sweep()
    points = sweep.points_lidar.copy()
    points[::97] = 0.0
    assert len(features(replace(sweep, points_lidar=points)).flat) > 300


def test_the_order_of_rings_does_not_matter_but_times_follow() -> None:
    sweep = room_sweep()
    assert sweep.ring is not None
    by_ring = sweep.keep(np.argsort(sweep.ring, kind="stable"))
    a, b = features(sweep), features(by_ring)
    assert np.array_equal(a.sharp.points_lidar, b.sharp.points_lidar)
    assert np.array_equal(a.less_flat.offsets_ns, b.less_flat.offsets_ns)  # type: ignore[arg-type]


def test_a_sweep_without_rings_is_a_callers_mistake() -> None:
    with pytest.raises(ValueError, match="rings"):
        features(Sweep(0, np.ones((20, 3), np.float32)))
