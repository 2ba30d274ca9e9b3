from __future__ import annotations

import tracemalloc
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.config import ScanContextConfig
from mineloc.data import F32
from mineloc.places.context_search import ContextIndex
from mineloc.places.scan_context import ring_key

# made-up places are less unlike than real ones, and the place asked for is the very same: the threshold is tight
CONFIG = ScanContextConfig(min_path_m=30.0, max_distance=0.01)
KEYFRAME_BYTES = 4 * (20 * 60 + 20)


@lru_cache(maxsize=400)
def context(seed: int) -> F32:
    """A place of its own: rings of a height of their own, so that ring keys tell places apart."""
    rng = np.random.default_rng(seed)
    return (rng.uniform(0.2, 6.0, (20, 1)) * rng.uniform(0.5, 1.5, (20, 60))).astype(np.float32)


def flown(count: int, *, step_m: float = 1.0) -> ContextIndex:
    index = ContextIndex(CONFIG)
    for k in range(count):
        index.add(context(k), path_m=k * step_m)
    return index


@pytest.mark.parametrize("count", [31, 32, 80, 81, 300, 301])
def test_the_newest_allowed_keyframe_is_found_and_no_newer_one(count: int) -> None:
    for back, expected in ((30, True), (29, False)):
        index = flown(count - 1)
        seen = index.add(np.roll(context(count - 1 - back), 7, axis=1), path_m=count - 1.0)
        found = [match.index for match in index.candidates(seen)]
        assert (found == [count - 1 - back]) is expected, back
        assert found == [] or expected


@settings(deadline=None, max_examples=12)
@given(count=st.integers(1, 160), place=st.floats(0, 1), shift=st.integers(0, 59))
def test_every_keyframe_can_be_found_in_a_growing_index(count: int, place: float, shift: int) -> None:
    index = ContextIndex(CONFIG)
    for k in range(count):  # asked at each keyframe, as in flight: trees are planted on the way
        index.add(context(k), path_m=float(k))
        assert index.candidates(k) == []
    wanted = int(place * (count - 1))
    seen = index.add(np.roll(context(wanted), -shift, axis=1), path_m=count + 50.0)
    (match,) = index.candidates(seen)
    assert match.index == wanted
    assert match.distance == pytest.approx(0, abs=1e-9)
    assert np.cos(match.yaw_rad - shift * np.pi / 30) == pytest.approx(1)
    # asked later about an earlier keyframe, the tree holds some that are not allowed
    assert index.candidates(wanted) == []


def test_candidates_are_the_nearest_ring_keys_the_most_similar_first() -> None:
    rng = np.random.default_rng(0)
    config = ScanContextConfig(max_distance=1.0, candidates=4)
    index = ContextIndex(config)
    contexts = [(context(1) + rng.uniform(0, 0.02 * k, (20, 60))).astype(np.float32) for k in rng.permutation(120)]
    for k, one in enumerate(contexts):
        index.add(one, path_m=float(k))
    seen = index.add(context(1), path_m=500.0)
    index.candidates(seen)
    found = index.candidates(seen)
    keys = np.stack([ring_key(one) for one in contexts])
    nearest = np.linalg.norm(keys - ring_key(context(1)), axis=1).argsort()[:4]
    assert {match.index for match in found} == set(nearest.tolist())
    assert [match.distance for match in found] == sorted(match.distance for match in found)


def test_an_empty_sweep_has_no_candidate_and_is_none() -> None:
    index = ContextIndex(ScanContextConfig(max_distance=1.0))
    for k in range(4):
        index.add(np.zeros((20, 60), np.float32), path_m=100.0 * k)
    index.add(context(1), path_m=1000.0)
    assert [index.candidates(k) for k in range(5)] == [[]] * 5


def test_unlike_places_are_refused() -> None:
    index = ContextIndex(CONFIG)
    index.add(context(1), path_m=0.0)
    seen = index.add(context(1)[::-1].copy(), path_m=100.0)
    assert index.candidates(seen) == []


def test_memory_is_one_context_a_keyframe() -> None:
    contexts = [context(k) for k in range(40)]
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    index = ContextIndex(CONFIG)
    for k in range(400):
        index.add(contexts[k % 40], path_m=float(k))
        index.candidates(k)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    # beside the arrays: their headers, the tree's copy of the keys
    assert grown < 400 * (KEYFRAME_BYTES + 600)
    assert len(index) == 400


def test_mistakes_are_refused() -> None:
    index = ContextIndex(CONFIG)
    index.add(context(0), path_m=5.0)
    with pytest.raises(ValueError, match="shape"):
        index.add(np.zeros((20, 59), np.float32), path_m=6.0)
    with pytest.raises(ValueError, match="finite"):
        index.add(np.full((20, 60), np.nan, np.float32), path_m=6.0)
    for path_m in (4.9, float("nan")):
        with pytest.raises(ValueError, match="path_m"):
            index.add(context(1), path_m=path_m)
    for k in (-1, 1):
        with pytest.raises(IndexError, match="of 1"):
            index.candidates(k)
