"""Passages of tags, on the route of paper A's second experiment."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mineloc.metrics.tag_passages import tag_passages

# the order in which paper A passed its tags (METHOD 1.11)
ROUTE = [*range(16), 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 16, 17, 18, 19, 0]
NAMES = [f"tag {k}" for k in range(20)]


def _flight(drift_m: float, *, each: int = 4, seed: int = 0):
    """Sightings of the whole route with an error that grows by `drift_m` a passage."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-50, 50, (20, 3))
    target = np.repeat(ROUTE, each)
    stamps = np.repeat(np.arange(31), each) * 20 * 10**9 + np.tile(np.arange(each), 31) * 200_000_000
    off = (
        np.repeat(np.arange(31), each)[:, None] * [drift_m, 0, 0] + np.tile(rng.normal(size=(each, 3)), (31, 1)) * 0.01
    )
    order = rng.permutation(len(target))
    return places, target[order], stamps.astype(np.int64)[order], (places[target] + off)[order]


def test_paper_a_s_route_makes_31_passages_whose_errors_grow() -> None:
    places, target, stamps, estimated = _flight(0.1)
    found = tag_passages(NAMES, places, target, stamps, estimated)
    assert [passage.tag for passage in found.passages] == [f"tag {k}" for k in ROUTE]
    assert {passage.sightings for passage in found.passages} == {4}
    assert found.max_m == pytest.approx(3.0, abs=0.02)
    assert found.mean_m == pytest.approx(1.5, abs=0.02)
    assert found.passages[10].dx_m == pytest.approx(1.0, abs=0.02)
    assert json.loads(json.dumps(found.to_dict()))["max_m"] == found.max_m


def test_the_tag_that_fixes_the_frame_is_no_evidence() -> None:
    places, target, stamps, estimated = _flight(0.1)
    shifted = estimated + np.array([5.0, -3.0, 1.0])
    fixed = tag_passages(NAMES, places, target, stamps, shifted, fixed_by="tag 0")
    assert fixed.passages[0].error_m == 0.0
    # thirty passages count, the last one by tag 0 again
    assert fixed.mean_m == pytest.approx(0.1 * np.arange(1, 31).mean(), abs=1e-9)
    assert fixed.max_m == pytest.approx(3.0)
    known = tag_passages(NAMES, places, target, stamps, shifted)
    assert known.mean_m is not None
    assert known.mean_m > 5.0


def test_few_or_no_passages() -> None:
    none = tag_passages(["A"], np.zeros((1, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    assert (none.passages, none.mean_m, none.max_m) == ((), None, None)
    stamps = np.array([0, 4 * 10**9, 9 * 10**9 + 1])
    one = tag_passages(["A"], np.zeros((1, 3)), np.zeros(3, np.int64), stamps, np.ones((3, 3)), fixed_by="A")
    assert [passage.sightings for passage in one.passages] == [2, 1]
    assert one.mean_m == pytest.approx(0.0)
    with pytest.raises(ValueError, match="tag 'B' was not seen"):
        tag_passages(["A"], np.zeros((1, 3)), np.zeros(3, np.int64), stamps, np.ones((3, 3)), fixed_by="B")
    with pytest.raises(ValueError, match="sighting"):
        tag_passages(["A"], np.zeros((1, 3)), np.zeros(3, np.int64), stamps[:2], np.ones((3, 3)))
