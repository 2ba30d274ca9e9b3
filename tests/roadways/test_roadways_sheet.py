"""Free-space sheet and skeleton: scipy as oracle, the known traps of skeletons, levels that cross in plan."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import distance_transform_edt, label

from mineloc.roadways.sheet import Sheet, clearance_cells, components, link
from mineloc.roadways.skeleton import thin, trace


def _sheet(mask: np.ndarray) -> Sheet:
    """One level: a picture as a sheet."""
    row, column = (values.astype(np.int64) for values in np.nonzero(mask))
    floor, roof = np.zeros(len(row)), np.full(len(row), 3.0)
    return Sheet(1.0, np.zeros(2), column, row, floor, roof, link(column, row, floor, roof, 1.2))


MASKS = arrays(np.bool_, st.tuples(st.integers(3, 14), st.integers(3, 14)), elements=st.booleans())


@settings(max_examples=60, deadline=None)
@given(MASKS)
def test_components_equal_scipy(mask: np.ndarray) -> None:
    if not mask.any():
        return
    sheet = _sheet(mask)
    ours = components(sheet.links)
    theirs = label(mask, np.ones((3, 3)))[0][mask]
    assert len(np.unique(ours)) == len(np.unique(theirs))
    assert len(np.unique(np.column_stack([ours, theirs]), axis=0)) == len(np.unique(ours))


@settings(max_examples=60, deadline=None)
@given(MASKS)
def test_thinning_keeps_pieces_and_holes(mask: np.ndarray) -> None:
    if not mask.any():
        return
    sheet = _sheet(mask)
    alive = thin(sheet.links, clearance_cells(sheet.links, sheet.column, sheet.row))
    left = np.zeros_like(mask)
    left[sheet.row[alive], sheet.column[alive]] = True
    eight, four = np.ones((3, 3)), None
    assert label(left, eight)[1] == label(mask, eight)[1]
    # holes are 4-connected parts of the background, the outside among them
    assert label(~np.pad(left, 1), four)[1] == label(~np.pad(mask, 1), four)[1]


def test_clearance_equals_the_distance_transform() -> None:
    rng = np.random.default_rng(0)
    from scipy.ndimage import gaussian_filter

    mask = np.pad(gaussian_filter(rng.standard_normal((120, 90)), 5) > -0.01, 1)
    sheet = _sheet(mask)
    ours = clearance_cells(sheet.links, sheet.column, sheet.row)
    theirs = distance_transform_edt(mask)[mask]
    # the way to the nearest rock may be barred within the sheet, so ours may be longer, rarely
    assert (ours >= theirs - 1e-9).all()
    assert np.isclose(ours, theirs).mean() > 0.99


@pytest.mark.parametrize("width", [9, 10, 11, 12])
def test_crossing_drives_give_one_junction_whatever_their_width(width: int) -> None:
    """The case in which the usual skeleton loses the junction at even widths."""
    mask = np.zeros((160, 160), np.bool_)
    mask[75 : 75 + width, 5:155] = True
    mask[5:155, 75 : 75 + width] = True
    sheet = _sheet(mask)
    alive = thin(sheet.links, clearance_cells(sheet.links, sheet.column, sheet.row))
    skeleton = trace(sheet, alive)
    long = [chain for chain in skeleton.chains if len(chain.cells) > width]
    assert len(long) == 4
    assert all((chain.start is None) != (chain.end is None) or len(skeleton.junctions) > 1 for chain in long)
    assert 230 < alive.sum() < 400
    # the middle of a drive is within a cell of the skeleton
    off = np.abs(sheet.row[alive][sheet.column[alive] < 60] - (75 + (width - 1) / 2))
    assert off[sheet.column[alive][sheet.column[alive] < 60] > 20].max() <= 1.0


def test_ring_stays_a_ring_and_levels_do_not_touch() -> None:
    y, x = np.mgrid[-30:30, -30:30]
    one = _sheet((np.hypot(x, y) < 25) & (np.hypot(x, y) > 17))
    skeleton = trace(one, thin(one.links, clearance_cells(one.links, one.column, one.row)))
    cells = np.concatenate([chain.cells for chain in skeleton.chains] + skeleton.junctions)
    assert 2 * np.pi * 21 * 0.8 < len(cells) < 2 * np.pi * 21 * 1.2
    # the same picture twice, one four metres above the other, in one sheet
    row, column = np.repeat(one.row, 2), np.repeat(one.column, 2)
    floor = np.tile([0.0, 4.0], len(one))
    links = link(column, row, floor, floor + 3.0, 1.2)
    part = components(links)
    assert len(np.unique(part)) == 2
    assert (part == part[0]).sum() == len(one)
    # a ramp of half a metre a cell joins them, a shelf with too small an opening does not
    assert _joined(step=0.5)
    assert not _joined(step=2.0)


def _joined(step: float) -> bool:
    column = np.arange(10, dtype=np.int64)
    floor = step * column
    return len(np.unique(components(link(column, np.zeros(10, np.int64), floor, floor + 3.0, 1.2)))) == 1
