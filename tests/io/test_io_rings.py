from __future__ import annotations

import numpy as np
import pytest
from driver_clouds import vlp16_sweep

from mineloc.io import rings

SWEEP = vlp16_sweep(columns=400)
HORIZON_DEG = np.arange(-12, 6) / 3
VLP32C_DEG = np.array(
    [-25, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, *HORIZON_DEG, 2.333, 3.333, 4.667, 7, 10.333, 15]
)


def _fan(elevations_deg, *, columns=300, seed=0, noise_deg=0.0, range_m=(2.5, 15.0)):
    rng = np.random.default_rng(seed)
    k = len(elevations_deg)
    el = np.deg2rad(np.tile(elevations_deg, columns) + noise_deg * rng.normal(size=k * columns))
    az = -2 * np.pi * np.repeat(np.arange(columns), k) / columns
    r = rng.uniform(*range_m, k * columns)
    points = np.stack([r * np.cos(el) * np.cos(az), r * np.cos(el) * np.sin(az), r * np.sin(el)], -1)
    return points.astype(np.float32), np.tile(np.arange(k), columns)


@pytest.mark.parametrize(
    "beams", [np.arange(-15, 16, 2.0), np.linspace(-30.67, 10.67, 32), VLP32C_DEG, [-1.0, 1.0, 3.0]]
)
def test_beams_are_found_without_a_formula(beams):
    points, ring = _fan(beams)
    found = rings.find_beams(points)
    assert found is not None
    np.testing.assert_allclose(np.rad2deg(found), beams, atol=0.02)
    rule = rings.rule_for_missing([points], [(1, len(points))], [np.arange(len(points))], count=None)
    np.testing.assert_array_equal(rings.apply_rule(rule, points, None, None, (1, len(points))), ring)


def test_offset_lasers_are_told_apart_from_afar():
    """Velodyne's lasers sit up to 11 mm off the centre: near points leave their fan."""
    points, ring = _fan(np.arange(-15, 16, 2.0), range_m=(0.6, 8.0))
    points[:, 2] += np.where(ring % 2, 0.0112, -0.0112).astype(np.float32)
    found = rings.find_beams(points)
    assert found is not None
    np.testing.assert_allclose(np.rad2deg(found), np.arange(-15, 16, 2.0), atol=0.3)


@pytest.mark.parametrize(
    ("elevations", "noise_deg", "count"),
    [
        (np.random.default_rng(1).uniform(-7, 52, 64), 8.0, None),
        (np.arange(-15, 16, 2.0), 0.9, None),
        (np.arange(-15, 16, 2.0), 0.9, 16),
        (np.arange(-15, 16, 2.0), 0.0, 7),
        ([0.0], 0.0, None),
    ],
)
def test_beams_that_do_not_stand_apart_are_refused(elevations, noise_deg, count):
    points, _ = _fan(elevations, noise_deg=noise_deg)
    assert rings.find_beams(points, count=count) is None
    rule = rings.rule_for_missing([points], [(1, len(points))], [np.arange(len(points))], count=count)
    assert rule.source == "none"
    assert rings.apply_rule(rule, points, None, None, (1, len(points))) is None


def test_too_few_points_are_refused():
    points, _ = _fan(np.arange(-15, 16, 2.0), columns=20)
    assert rings.find_beams(points) is None
    assert rings.rule_for_missing([points[:0]], [(1, 0)], [np.arange(0)], count=None).source == "none"


def test_rising_rings_are_left_alone():
    points, ring = _fan(VLP32C_DEG)
    rule = rings.rule_for_numbers(ring, points, source="field")
    assert (rule.source, rule.table, rule.detail) == ("field", None, "")
    np.testing.assert_array_equal(rings.apply_rule(rule, points, ring.astype(np.uint8), None, (1, 1)), ring)


def test_rings_from_the_top_are_turned_round_even_when_some_never_return():
    points, ring = _fan(np.linspace(-16, 16, 64))
    top = 63 - ring
    seen = (top > 1) & (top < 60)
    rule = rings.rule_for_numbers(top[seen], points[seen], source="field")
    assert "turned round" in rule.detail
    np.testing.assert_array_equal(rings.apply_rule(rule, points, top, None, (1, 1)), ring)


def test_laser_ids_in_firing_order_are_sorted_by_elevation():
    vlp16_firing_deg = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15.0])
    points, laser = _fan(vlp16_firing_deg)
    rule = rings.rule_for_numbers(laser, points, source="field", count=16)
    expected = np.argsort(np.argsort(vlp16_firing_deg))[laser]
    np.testing.assert_array_equal(rings.apply_rule(rule, points, laser, None, (1, 1)), expected)
    # a laser that the first sweeps did not see still gets a ring of its own
    seen = laser != 7
    rule = rings.rule_for_numbers(laser[seen], points[seen], source="field", count=16)
    assert rule.table is not None
    assert sorted(rule.table.tolist()) == list(range(16))


def test_lines_that_are_no_beams_are_dropped():
    points, _ = _fan(np.linspace(-7, 52, 40))
    lines = np.arange(len(points)) // 40 % 4
    assert rings.rule_for_numbers(lines, points, source="field").source == "none"
    assert rings.rule_for_numbers(lines + 300, points, source="field").source == "none"
    assert rings.rule_for_numbers(lines - 1, points, source="field").source == "none"


@pytest.mark.parametrize("by", ["rows", "columns"])
def test_organised_clouds_without_ring(by):
    n = len(SWEEP)
    order = np.arange(n).reshape(-1, 16)[:, ::-1]
    order = order.T.reshape(-1) if by == "rows" else order.reshape(-1)
    shape = (16, n // 16) if by == "rows" else (n // 16, 16)
    points, ring = SWEEP.points_lidar[order], SWEEP.ring[order]
    kept = np.flatnonzero(np.random.default_rng(0).random(n) > 0.3)
    rule = rings.rule_for_missing([points[kept]] * 2, [shape] * 2, [kept] * 2, count=None)
    assert rule.source == by
    np.testing.assert_array_equal(rings.apply_rule(rule, points[kept], None, kept, shape), ring[kept])


def test_angle_gives_the_share_of_the_revolution_in_both_senses():
    columns = np.repeat(np.arange(400), 16) / 400
    for points in (SWEEP.points_lidar, SWEEP.points_lidar * np.float32([1, -1, 1])):
        np.testing.assert_allclose(rings.azimuth_fraction(points), columns, atol=1e-6)


def test_angle_bears_beams_that_look_ahead_and_missing_points():
    elevation = np.deg2rad(np.tile(VLP32C_DEG, 600))
    share = np.repeat(np.arange(600), 32) / 600
    ahead = np.deg2rad(np.tile([-4.2, 1.4, -1.4, 4.2], 600 * 8))
    az = 1.0 + 2 * np.pi * share + ahead
    points = np.stack([np.cos(elevation) * np.cos(az), np.cos(elevation) * np.sin(az), np.sin(elevation)], -1)
    kept = np.random.default_rng(0).random(len(points)) > 0.4
    fraction = rings.azimuth_fraction((5 * points).astype(np.float32)[kept])
    assert fraction is not None
    assert np.abs(fraction - share[kept]).max() < 10 / 360
    assert 0 <= fraction.min() < fraction.max() < 1


def test_angle_is_refused_out_of_firing_order():
    rng = np.random.default_rng(0)
    points = SWEEP.points_lidar
    assert rings.azimuth_fraction(points[rng.permutation(len(points))]) is None
    ring_major = points.reshape(-1, 16, 3).transpose(1, 0, 2).reshape(-1, 3)
    assert rings.azimuth_fraction(ring_major) is None
    assert rings.azimuth_fraction(points[:100]) is None
    assert rings.azimuth_fraction(np.tile(points, (2, 1))) is None
    # a quarter of a revolution tells nothing about its start
    assert rings.azimuth_fraction(points[:1600]) is None
