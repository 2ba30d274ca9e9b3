from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from mineloc import se3
from mineloc.data import Trajectory
from mineloc.errors import FormatError, OutputError
from mineloc.io.trajectories import load_trajectory, read_kitti, read_trajectory, read_tum, write_kitti, write_tum

DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"


def _text(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _random(n: int, seed: int, *, start_ns: int = 1_790_000_000_000_000_001) -> Trajectory:
    rng = np.random.default_rng(seed)
    stamps = start_ns + np.cumsum(rng.integers(1, 10**9, n))
    xi = rng.normal(size=(n, 6)) * [2, 2, 2, 500, 500, 50]
    return Trajectory(stamps.astype(np.int64), se3.exp(xi))


@settings(max_examples=40, deadline=None)
@given(
    stamps=st.lists(st.integers(-(10**18), 9 * 10**18), min_size=1, max_size=20, unique=True),
    xi=hnp.arrays(np.float64, (20, 6), elements=st.floats(-3, 3)),
)
def test_tum_keeps_every_nanosecond_and_pose(tmp_path_factory, stamps, xi):
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    before = Trajectory(np.array(sorted(stamps), np.int64), se3.exp(xi[: len(stamps)]))
    write_tum(path, before)
    after = read_tum(path)
    np.testing.assert_array_equal(after.stamps_ns, before.stamps_ns)
    np.testing.assert_allclose(after.poses, before.poses, atol=2e-9)


def test_kitti_keeps_poses_and_says_that_it_has_no_times(tmp_path):
    before = _random(7, 1)
    write_kitti(tmp_path / "k.txt", before)
    after = read_kitti(tmp_path / "k.txt")
    assert not after.timed
    np.testing.assert_array_equal(after.stamps_ns, np.arange(7))
    np.testing.assert_allclose(after.poses, before.poses, atol=1e-8)
    with pytest.raises(ValueError, match="needs times"):
        write_tum(tmp_path / "t.tum", after)


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1311868164.363181", 1_311_868_164_363_181_000),
        ("1311868164.363181001", 1_311_868_164_363_181_001),
        ("1311868164.3631810014", 1_311_868_164_363_181_001),
        ("1311868164.36318100151", 1_311_868_164_363_181_002),
        ("1.311868164363181e9", 1_311_868_164_363_181_000),
        ("1e3", 10**12),
        ("0", 0),
        ("12.", 12 * 10**9),
        ("-0.5", -500_000_000),
    ],
)
def test_seconds_become_nanoseconds_without_a_float(tmp_path, text, stamp_ns):
    assert read_tum(_text(tmp_path / "t.tum", f"{text} 0 0 0 0 0 0 1")).stamps_ns.tolist() == [stamp_ns]


def test_comments_blank_lines_and_scaled_quaternions(tmp_path):
    path = _text(
        tmp_path / "t.txt", "\ufeff# t x y z", "", "1 1 2 3 0 0 0.7 0.7", "  # more", "2\t1 2 4 0 0 0.7072 0.7071 "
    )
    trajectory = read_trajectory(path)
    np.testing.assert_allclose(trajectory.poses[0, :3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-9)
    np.testing.assert_array_equal(trajectory.positions_m, [[1, 2, 3], [1, 2, 4]])


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        (["1 0 0 0 0 0 0 1", "2 0 0 nan 0 0 0 1"], "line 2: NaN or infinity"),
        (["1 0 0 0 0 0 0 1", "", "2 0 0 0 0 0 1"], "line 3: 7 values"),
        (["1 0 0 0 0 0 0 1", "2 0 0 zero 0 0 0 1"], "line 2: not numbers"),
        (["1 0 0 0 0 0 0 1", "2 0 0 0 0 0 0 0"], "line 2: a quaternion of length 0"),
        (["1 0 0 0 10 0 0 1"], "a quaternion of length 10"),
        (["2 0 0 0 0 0 0 1", "1 0 0 0 0 0 0 1"], "line 2: time goes backwards (1 after 2)"),
        (["1790000000123456789 0 0 0 0 0 0 1"], "convert nanoseconds to seconds"),
        (["1e999999999 0 0 0 0 0 0 1"], "time 1e999999999 s"),
        (["nan 0 0 0 0 0 0 1"], "line 1: time 'nan'"),
        (["12:30 0 0 0 0 0 0 1"], "line 1: time '12:30'"),
        (["1 2 3"], "3 values; expected 8 (TUM: t x y z qx qy qz qw) or 12 (KITTI)"),
        (["# only a comment"], "holds no poses"),
        ([" ".join("1" * 12)], "not a rotation"),
        (["-1 0 0 0 0 1 0 0 0 0 1 0"], "not a rotation"),
        (["1 0 0 0 0 1 0 0 0 0 1 0", "1 0 0 0 0 1 0 0 0 0 1"], "line 2: 11 values"),
    ],
)
def test_damaged_lines_are_told_by_their_number(tmp_path, lines, says):
    with pytest.raises(FormatError) as caught:
        read_trajectory(_text(tmp_path / "t.txt", *lines))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_of_each_time_the_first_pose_is_kept(tmp_path):
    pose = "0 0 0 0 0 0 1"
    lines = [f"1 {pose}", f"1 {pose}", f"2 {pose}", "2 1 0 0 0 0 0 1", "2 2 0 0 0 0 0 1", f"2.000000001 {pose}"]
    loaded = load_trajectory(_text(tmp_path / "t.txt", *lines))
    assert (loaded.duplicates, loaded.conflicts, loaded.kind) == (1, 2, "tum")
    assert (loaded.trajectory.stamps_ns - 10**9).tolist() == [0, 10**9, 10**9 + 1]
    assert loaded.trajectory.positions_m[1, 0] == 0  # the first of its time
    with pytest.raises(FormatError, match="different times"):
        load_trajectory(_text(tmp_path / "u.txt", *[f"1 {k} 0 0 0 0 0 1" for k in range(9)]))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("missing.tum", None, "no such file"),
        ("cloud.ply", b"\x89\xff\x00\xfe", "is not text"),
        ("flight.bag", b"#ROSBAG V2.0\n", "mineloc ingest"),
        ("empty.tum", b"", "holds no poses"),
    ],
)
def test_other_files_are_refused(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError, match=says):
        load_trajectory(tmp_path / name)
    with pytest.raises(FormatError, match="is a folder"):
        load_trajectory(tmp_path)


def test_coarse_rotations_are_made_rigid_and_fine_ones_left_alone(tmp_path):
    row = np.hstack([se3.exp([0.1, 0.2, 0.3, 0, 0, 0])[:3, :3], [[1.0], [2], [3]]]).ravel()
    coarse = _text(tmp_path / "c.txt", " ".join(f"{v:.4f}" for v in row))
    fine = _text(tmp_path / "f.txt", " ".join(f"{v:.9f}" for v in row))
    r = read_kitti(coarse).poses[0, :3, :3]
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(r.ravel(), row.reshape(3, 4)[:, :3].ravel(), atol=1e-4)
    assert read_kitti(fine).poses[0, 0, 0] == float(f"{row[0]:.9f}")


def test_files_are_whole_and_not_overwritten_by_accident(tmp_path):
    path = tmp_path / "t.tum"
    write_tum(path, _random(3, 2))
    with pytest.raises(OutputError, match="exists"):
        write_tum(path, _random(4, 3))
    assert len(read_tum(path)) == 3
    write_tum(path, _random(4, 3), overwrite=True)
    assert len(read_tum(path)) == 4
    assert [p.name for p in tmp_path.iterdir()] == ["t.tum"]


def test_an_empty_trajectory_is_written_and_refused_when_read(tmp_path):
    write_tum(tmp_path / "t.tum", Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4))))
    with pytest.raises(FormatError, match="holds no poses"):
        read_tum(tmp_path / "t.tum")


@pytest.mark.data
def test_real_files():
    folder = DATA / "trajectories"
    if not folder.exists():
        pytest.skip("no ../shared/data beside the repository")
    desk = load_trajectory(folder / "fr2_desk_groundtruth.txt")
    assert (len(desk.trajectory), desk.kind, desk.conflicts) == (20956, "tum", 1)
    kitti = load_trajectory(folder / "KITTI_00_gt.txt")
    assert (len(kitti.trajectory), kitti.kind) == (4541, "kitti")
    assert kitti.trajectory.path_m[-1] == pytest.approx(3724.186990597451, abs=1e-6)
