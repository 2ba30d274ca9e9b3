from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic_run import SyntheticRun, write_synthetic_run
from typer.testing import CliRunner

from mineloc import se3
from mineloc.cli import app
from mineloc.config import EvaluateConfig
from mineloc.data import Calibration, FlightInfo, Sweep, Trajectory
from mineloc.errors import EvaluationError, FormatError
from mineloc.io.flight_writer import FlightWriter
from mineloc.io.trajectories import write_kitti, write_tum
from mineloc.stages.evaluate import evaluate

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
START_NS = 1_790_000_000 * 10**9


def _flight(n: int, *, period_s: float = 0.1, start_ns: int = START_NS, seed: int = 0) -> Trajectory:
    """A bend of 1 m a tenth of a second."""
    t = np.arange(n) * period_s
    xi = np.zeros((n, 6))
    xi[:, 2] = 0.05 * t
    poses = se3.exp(xi)
    poses[:, :3, 3] = np.stack([200 * np.sin(0.05 * t), 200 * (1 - np.cos(0.05 * t)), 0.2 * t], axis=1)
    return Trajectory(start_ns + np.round(t * 1e9).astype(np.int64), poses)


def _drifting(truth: Trajectory, percent: float) -> Trajectory:
    poses = truth.poses.copy()
    poses[:, 2, 3] += percent / 100 * truth.path_m
    return Trajectory(truth.stamps_ns, poses, timed=truth.timed)


def _tum(folder: Path, name: str, trajectory: Trajectory) -> Path:
    write_tum(folder / name, trajectory)
    return folder / name


def test_a_known_drift_is_found_with_every_measure(tmp_path):
    truth = _flight(2000)
    reference = _tum(tmp_path, "ref.tum", truth)
    evaluation = evaluate(_tum(tmp_path, "est.tum", _drifting(truth, 1.0)), reference)
    (scores,) = evaluation.scores
    by_alignment = {one.absolute.alignment: one for one in scores.aligned}
    assert set(by_alignment) == {"none", "origin", "se3"}
    path = float(truth.path_m[-1])
    assert by_alignment["none"].absolute.translation_m.max == pytest.approx(0.01 * path, rel=1e-4)
    assert by_alignment["se3"].absolute.translation_m.rmse < by_alignment["none"].absolute.translation_m.rmse
    assert scores.segments.percent == pytest.approx(1.0, rel=1e-3)
    for rep in scores.percent[:4]:
        assert rep.literal is not None
        # the toolbox's tolerance also takes shorter pieces than it divides by
        assert 0.9 < rep.literal.mean < 1.0
    assert scores.percent[4].strict is not None
    assert scores.percent[4].strict.mean == pytest.approx(1.0, rel=1e-3)
    assert (scores.coverage.time, scores.coverage.path) == pytest.approx((1, 1))
    json.dumps(evaluation.to_dict(), allow_nan=False)


def test_an_estimate_of_the_first_half_says_so(tmp_path):
    truth = _flight(400)
    half = Trajectory(truth.stamps_ns[:201], truth.poses[:201])
    reference = _tum(tmp_path, "ref.tum", truth)
    scores = evaluate(_tum(tmp_path, "est.tum", half), reference).scores[0]
    assert scores.coverage.path == pytest.approx(200 / 399, rel=1e-6)
    assert scores.percent[4].literal is None
    assert scores.aligned[0].absolute.translation_m.max < 1e-8


def test_a_run_has_both_trajectories_scored_and_may_bring_its_reference(tmp_path):
    run = write_synthetic_run(tmp_path / "run", SyntheticRun(poses=300))
    evaluation = evaluate(run)
    assert [one.name for one in evaluation.scores] == ["smoothed", "online"]
    smoothed, online = (one.aligned[0].absolute.translation_m.rmse for one in evaluation.scores)
    assert smoothed == pytest.approx(0.3 * online, rel=0.05)
    assert evaluation.reference.endswith("reference.tum")
    assert evaluation.trusted_share is not None
    other = evaluate(run, run / "trajectory.tum")
    assert other.scores[0].aligned[0].absolute.translation_m.max < 1e-8
    bare = write_synthetic_run(tmp_path / "bare", SyntheticRun(poses=300, reference=False))
    with pytest.raises(EvaluationError, match="brings no reference along"):
        evaluate(bare)


def test_a_flight_is_a_reference(tmp_path):
    truth = _flight(300, period_s=0.01)
    path = tmp_path / "f.mcap"
    with FlightWriter(path, FlightInfo(flight="f"), Calibration()) as writer:
        writer.add_reference(truth)
        for k in range(3):
            writer.add_sweep(Sweep(START_NS + k * 10**9, np.ones((5, 3), np.float32)))
    sparse = Trajectory(truth.stamps_ns[::10], truth.poses[::10])
    evaluation = evaluate(_tum(tmp_path, "est.tum", sparse), path)
    assert evaluation.reference == f"{path}:/pose"
    assert evaluation.scores[0].aligned[0].absolute.translation_m.max < 1e-8
    with FlightWriter(tmp_path / "g.mcap", FlightInfo(flight="g"), Calibration()) as writer:
        writer.add_sweep(Sweep(START_NS, np.ones((5, 3), np.float32)))
    with pytest.raises(FormatError, match="no reference"):
        evaluate(tmp_path / "est.tum", tmp_path / "g.mcap")


@pytest.mark.parametrize(
    ("estimate", "reference", "align", "says"),
    [
        (_flight(50, start_ns=0), _flight(50), None, "0 of 50 poses"),
        (_flight(1), _flight(50), None, "est.tum: 1 pose; expected a trajectory"),
        (_flight(50), _flight(1), None, "ref.tum: 1 pose; expected a trajectory"),
        (_flight(2), _flight(50), "se3", "needs 3"),
        (_flight(2, period_s=7), _flight(50), None, "1 of 2 poses"),
        (
            Trajectory(_flight(50).stamps_ns, np.tile(np.eye(4), (50, 1, 1))),
            _flight(50),
            "se3",
            "one point or one line",
        ),
    ],
)
def test_what_cannot_be_compared_is_one_line(tmp_path, estimate, reference, align, says):
    ref, est = _tum(tmp_path, "ref.tum", reference), _tum(tmp_path, "est.tum", estimate)
    with pytest.raises(EvaluationError) as caught:
        evaluate(est, ref, align=align)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_alignment_left_open_is_a_note_when_nobody_asked_for_it(tmp_path):
    ref, est = _tum(tmp_path, "ref.tum", _flight(50)), _tum(tmp_path, "est.tum", _flight(2))
    scores = evaluate(est, ref).scores[0]
    assert [one.absolute.alignment for one in scores.aligned] == ["none", "origin"]
    assert scores.notes == ("no se3 alignment: 2 positions, a free rotation needs 3",)


def test_times_on_one_side_only_cannot_be_paired(tmp_path):
    write_kitti(tmp_path / "k.txt", _flight(50))
    ref = _tum(tmp_path, "ref.tum", _flight(50))
    with pytest.raises(EvaluationError, match="the estimate has no times"):
        evaluate(tmp_path / "k.txt", ref)
    write_kitti(tmp_path / "l.txt", _flight(40))
    with pytest.raises(EvaluationError, match="50 poses against 40"):
        evaluate(tmp_path / "k.txt", tmp_path / "l.txt")
    assert evaluate(tmp_path / "k.txt", tmp_path / "k.txt").scores[0].pairs.method == "index"


def test_nan_is_told_with_its_line(tmp_path):
    ref = _tum(tmp_path, "ref.tum", _flight(5))
    (tmp_path / "nan.tum").write_text("1 nan 0 0 0 0 0 1\n")
    with pytest.raises(FormatError, match="line 1: NaN"):
        evaluate(tmp_path / "nan.tum", ref)


def test_the_command_prints_tables_or_json(tmp_path):
    truth = _flight(300)
    ref, est = _tum(tmp_path, "ref.tum", truth), _tum(tmp_path, "est.tum", _drifting(truth, 2.0))
    shown = CliRunner().invoke(app, ["evaluate", str(est), "--reference", str(ref)])
    assert shown.exit_code == 0
    for text in ("none", "origin", "se3", "coverage 100.0%", "300 of 300 poses paired, nearest", "REP-5 strict"):
        assert text in shown.stdout
    told = ["evaluate", str(est), "--reference", str(ref), "--json", "--align", "posyaw", "--set"]
    result = CliRunner().invoke(app, [*told, "evaluate.rpe_frames=[1, 5]"])
    assert result.exit_code == 0
    (trajectory,) = json.loads(result.stdout)["trajectories"]
    assert [one["alignment"] for one in trajectory["aligned"]] == ["posyaw"]
    assert [(one["delta"], one["unit"]) for one in trajectory["aligned"][0]["rpe"]] == [
        (1, "frames"),
        (5, "frames"),
        (100, "m"),
    ]
    assert CliRunner().invoke(app, ["evaluate", str(est), "--align", "sim3"]).exit_code == 2


_TRUTH = "/lidarodom/ground_truth/pose"
CASES = {
    "KITTI_00_ORB": ("trajectories/KITTI_00_gt.txt", "trajectories/KITTI_00_ORB.txt"),
    "fr2_desk_ORB": ("trajectories/fr2_desk_groundtruth.txt", "trajectories/fr2_desk_ORB.txt"),
    **{
        f"evo_{name}": (f"recordings/evo_{name}.mcap:{_TRUTH}", f"recordings/evo_{name}.mcap:{topic}")
        for name, topic in (
            ("kiss_2", "/lidarodom/pose"),
            ("kiss_3", "/lidarodom/pose"),
            ("glim_1", "/glim_ros_node/odom"),
            ("glim_2", "/glim_ros_node/odom"),
        )
    },
}


@pytest.mark.data
@pytest.mark.parametrize("name", CASES)
def test_reference_metrics(name):
    if not DATA.exists():
        pytest.skip("no ../shared/data beside the repository")
    known = json.loads((DATA / "trajectories" / "reference_metrics.json").read_text())[name]
    # the recordings were compared with a wider window: motion capture with holes
    config = EvaluateConfig(max_time_difference_s=0.02 if name.startswith("evo_") else 0.01)
    reference, estimate = (f"{DATA}/{part}" for part in CASES[name])
    (scores,) = evaluate(estimate, reference, config=config).scores
    assert len(scores.pairs) == known["n"]
    assert scores.pairs.reference_path_m[-1] == pytest.approx(known["ref_path_length_m"], abs=1e-6)
    for one in scores.aligned:
        frames, metres = one.relative
        found = {
            "ape_trans_m": one.absolute.translation_m,
            "ape_rot_deg": one.absolute.rotation_deg,
            "rpe_trans_m_delta1frames": frames.translation_m,
            "rpe_rot_deg_delta1frames": frames.rotation_deg,
            "rpe_trans_m_delta100m": metres.translation_m,
            "rpe_rot_deg_delta100m": metres.rotation_deg,
        }
        for measure, expected in known[one.absolute.alignment].items():
            statistics = found[measure]
            if isinstance(expected, str):
                assert statistics is None, measure
                continue
            assert statistics is not None
            for key, value in expected.items():
                assert getattr(statistics, key) == pytest.approx(value, rel=1e-9, abs=1e-6), (measure, key)
