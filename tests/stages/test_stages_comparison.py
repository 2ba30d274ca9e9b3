from __future__ import annotations

import json
import shutil
from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from synthetic_run import SyntheticRun

from mineloc.config import EvaluateConfig
from mineloc.io.trajectories import write_tum
from mineloc.stages.comparison import compare, frame_of
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.stretches import MAX_GAP_SWEEPS, degenerate_stretches, untrusted_stretches


def test_drift_is_the_end_error_over_the_metres_flown(synthetic_run):
    run = RunFolder.open(synthetic_run(SyntheticRun(poses=900)))
    one = compare(run, EvaluateConfig())["online"]
    # first pose on first pose: undo the first pose of both
    est = np.linalg.inv(run.online.poses[0]) @ run.online.poses[-1]
    ref = np.linalg.inv(run.reference.poses[0]) @ run.reference.poses[-1]
    end = np.linalg.norm(est[:3, 3] - ref[:3, 3])
    assert one.drift.end_error_m == pytest.approx(end, rel=1e-6)
    assert one.drift.percent == pytest.approx(100 * end / run.reference.path_m[-1], rel=1e-6)
    assert one.drift.one_in == pytest.approx(run.reference.path_m[-1] / end, rel=1e-6)


def test_a_run_is_drawn_by_its_first_pose_but_in_a_prior_map_as_it_is(tmp_path, synthetic_run):
    source = synthetic_run(SyntheticRun(poses=1500))
    run = RunFolder.open(source)
    shown = compare(run, EvaluateConfig())["smoothed"].shown
    assert shown.alignment == "origin"
    assert shown.error_m[0] < 1e-9
    assert compare(run, EvaluateConfig(shown_alignment="se3"))["smoothed"].shown.alignment == "se3"
    mapped = tmp_path / "mapped"
    shutil.copytree(source, mapped)
    manifest = json.loads((mapped / "manifest.json").read_text())
    for is_grid, found, alignment in ((True, True, "none"), (True, False, "origin"), (False, True, "origin")):
        known = {"manifest_sha256": "ab" * 32, "grid_origin_m": [0.0] * 3, "is_grid": is_grid, "found": found}
        (mapped / "manifest.json").write_text(json.dumps(manifest | {"map": known}))
        assert compare(RunFolder.open(mapped), EvaluateConfig())["smoothed"].shown.alignment == alignment


def test_an_alignment_that_the_poses_leave_open_is_replaced_and_told(synthetic_run):
    run = RunFolder.open(synthetic_run(SyntheticRun(poses=1)))
    one = compare(run, EvaluateConfig(shown_alignment="se3"))["smoothed"]
    assert one.shown.alignment == "origin"
    assert any("se3" in note for note in one.scores.notes)
    assert (one.drift.percent, one.drift.one_in) == (None, None)


def test_without_common_times_there_is_no_comparison(tmp_path, synthetic_run):
    late = tmp_path / "late"
    shutil.copytree(synthetic_run(SyntheticRun(poses=60)), late)
    run = RunFolder.open(late)
    write_tum(
        late / "reference.tum",
        type(run.smoothed)(run.reference.stamps_ns + 10**12, run.reference.poses),
        overwrite=True,
    )
    assert compare(RunFolder.open(late), EvaluateConfig()) == {}
    assert compare(RunFolder.open(synthetic_run(SyntheticRun(poses=60, reference=False))), EvaluateConfig()) == {}
    assert (frame_of(None) == np.eye(4)).all()


def _sweeps(troubled: list[bool], reasons: list[str] | None = None) -> pl.DataFrame:
    n = len(troubled)
    return pl.DataFrame(
        {
            "stamp_ns": np.arange(n) * 100_000_000,
            "trusted": [not t for t in troubled],
            "reason": reasons or ["bad" if t else "" for t in troubled],
            "is_degenerate": troubled,
        },
        schema={"stamp_ns": pl.Int64, "trusted": pl.Boolean, "reason": pl.String, "is_degenerate": pl.Boolean},
    )


@given(st.lists(st.booleans(), max_size=120))
def test_stretches_hold_every_troubled_sweep_once_and_lie_apart(troubled):
    stretches = degenerate_stretches(_sweeps(troubled))
    assert sum(one.sweeps for one in stretches) == sum(troubled)
    inside = [k for one in stretches for k in range(one.first, one.last + 1)]
    assert {k for k, t in enumerate(troubled) if t} <= set(inside)
    assert all(troubled[one.first] and troubled[one.last] for one in stretches)
    gaps = [b.first - a.last - 1 for a, b in pairwise(stretches)]
    assert all(gap > MAX_GAP_SWEEPS for gap in gaps)


def test_a_stretch_names_its_most_frequent_reason():
    reasons = ["", "too few points", "inliers 0.1 < 0.2", "inliers 0.1 < 0.2", "", ""]
    (one,) = untrusted_stretches(_sweeps([False, True, True, True, False, False], reasons))
    assert (one.first, one.last, one.sweeps, one.reason) == (1, 3, 3, "inliers 0.1 < 0.2")
    assert (one.start_ns, one.end_ns) == (100_000_000, 300_000_000)
