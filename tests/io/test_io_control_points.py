from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mineloc.data import Calibration, ControlPoint, FlightInfo, Observation
from mineloc.data.control import is_plain, z_up_from_y_up
from mineloc.errors import FormatError
from mineloc.io.control_points import (
    control_points_csv,
    merged_control_points,
    observations_csv,
    parse_control_points,
    parse_observations,
    read_control_points,
    read_flight_survey,
    read_observations,
)
from mineloc.io.flight import FlightReader, FlightWriter

HEAD = "name,e_m,n_m,z_m,sigma_m,role"
SEEN = "target,flight,stamp_ns,x_m,y_m,z_m,sigma_m"

# Paper A, Table II as published: y is up, tag 8 has the wrong sign (METHOD 1.11, D9)
TABLE_II = """\
0.00 0.00 0.00
4.177 0.107 -5.920
4.177 0.035 -22.196
5.118 0.079 -24.418
14.365 0.105 -24.418
25.270 0.070 -24.498
34.235 -0.011 -24.103
44.420 -0.060 -24.103
66.020 0.145 24.103
73.990 0.177 -24.103
74.203 0.075 -18.443
74.00 0.070 -5.193
73.910 0.240 7.312
58.085 0.105 23.137
53.043 0.220 28.179
41.701 0.262 39.521
17.435 0.135 -23.155
17.435 0.059 -5.63
13.695 0.150 -3.180
5.255 0.340 -3.180
"""
ROUTE = [*range(16), 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 16, 17, 18, 19, 0]


def _points(*lines: str, head: str = HEAD, axes: str = "z_up") -> tuple[ControlPoint, ...]:
    return parse_control_points("\n".join([head, *lines]).encode(), where="targets.csv", axes=axes)  # type: ignore[arg-type]


def _table_ii(*, corrected: bool) -> tuple[ControlPoint, ...]:
    rows = [line.split() for line in TABLE_II.splitlines()]
    if corrected:
        rows[8][2] = "-" + rows[8][2]
    lines = [f"tag {k},{x},{y},{z},0.005,control,{k},0.2" for k, (x, y, z) in enumerate(rows)]
    return _points(*lines, head="name,x_m,y_m,z_m,sigma_m,role,tag_id,tag_size_m", axes="y_up")


def _travelled_m(points: tuple[ControlPoint, ...]) -> float:
    line = np.array([points[k].position_grid for k in ROUTE])
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def test_table_ii_of_paper_a_is_read_with_y_up() -> None:
    points = _table_ii(corrected=True)
    assert len(points) == 20
    assert len(ROUTE) == 31
    # z is height now: a corridor is flat
    assert np.ptp([p.position_grid[2] for p in points]) < 0.5
    np.testing.assert_allclose(points[9].position_grid, [73.990, 24.103, 0.177])
    assert points[5].tag_id == 5
    # the route of 420 m cannot be longer from tag to tag, which the printed sign of tag 8 would make it
    assert _travelled_m(points) == pytest.approx(342, abs=1)
    assert _travelled_m(_table_ii(corrected=False)) == pytest.approx(486, abs=1)


def test_y_up_turns_and_does_not_mirror() -> None:
    axes = z_up_from_y_up(np.eye(3))
    np.testing.assert_array_equal(np.cross(axes[0], axes[1]), axes[2])
    np.testing.assert_array_equal(axes[1], [0, 0, 1])


NAMES = st.text(min_size=1, max_size=12).filter(is_plain)
METRES = st.floats(-1e7, 1e7, allow_nan=False)


@settings(max_examples=60, deadline=None)
@given(
    names=st.lists(NAMES, min_size=1, max_size=6, unique=True),
    place=st.lists(st.tuples(METRES, METRES, METRES), min_size=6, max_size=6, unique=True),
    sigma=st.floats(1e-4, 0.9),
    tagged=st.booleans(),
    role=st.sampled_from(["control", "check"]),
)
def test_targets_come_back_exactly_as_they_were_written(names, place, sigma, tagged, role) -> None:
    before = [
        ControlPoint(name, np.array(p), sigma, sigma / 2, role, k if tagged else None, 0.3 if tagged else None)
        for k, (name, p) in enumerate(zip(names, place, strict=False))
    ]
    after = parse_control_points(control_points_csv(before), where="x")
    assert [(p.name, p.sigma_m, p.sigma_z_m, p.role, p.tag_id, p.tag_size_m) for p in after] == [
        (p.name, p.sigma_m, p.sigma_z_m, p.role, p.tag_id, p.tag_size_m) for p in before
    ]
    np.testing.assert_array_equal([p.position_grid for p in after], [p.position_grid for p in before])


def test_the_mine_grid_keeps_its_tenths_of_millimetres(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(f"{HEAD}\nA,500000.0001,7100000.0002,-350.0003,0.005,control\n")
    (point,) = read_control_points(tmp_path / "t.csv")
    np.testing.assert_allclose(point.position_grid - [500000, 7100000, -350], [1e-4, 2e-4, -3e-4], atol=2e-9)


def test_columns_in_any_order_comments_and_optional_values() -> None:
    head = "\ufeffrole, name ,z_m,n_m,e_m,sigma_m,tag_size_m,tag_id,sigma_z_m"
    a, b = _points(
        "", "# the old drift", 'check,"A, upper",3,2,1,0.004,,,0.008', "control,B,6,5,4,.01,0.25,17,", head=head
    )
    assert (a.name, a.role, a.tag_id, a.tag_size_m) == ("A, upper", "check", None, None)
    assert (b.tag_id, b.tag_size_m, b.sigma_z_m) == (17, 0.25, 0.01)
    np.testing.assert_array_equal(a.position_grid, [1, 2, 3])
    np.testing.assert_allclose(a.covariance_grid, np.diag([16e-6, 16e-6, 64e-6]))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["A,1,2,3,0.005,control", "A,4,5,6,0.005,check"], r"line 3: target 'A' is in line 2 already"),
        (["A,1,2,3,0.005,control", "B,1,2,3,0.005,check"], r"line 3: B is exactly where A in line 2 is"),
        (["A,1,2,3,0.005,kontrolle"], r"line 2: role 'kontrolle'; expected control or check"),
        (["A,1,2,3,0.005,"], r"line 2: role ''"),
        (["A,500 000,2,3,0.005,control"], r"line 2: e_m = '500 000'; expected a finite number of metres"),
        (["A,1,2,nan,0.005,control"], r"line 2: z_m = 'nan'"),
        (["A,1,inf,3,0.005,control"], r"line 2: n_m = 'inf'"),
        (["A,1,,3,0.005,control"], r"line 2: n_m = ''"),
        (["A,1,7.1e12,3,0.005,control"], r"line 2: n_m = 7.1e12; expected at most 1e\+08 m"),
        (["A,1,2,3,-0.005,control"], r"line 2: sigma_m = -0.005; expected metres above 0"),
        (["A,1,2,3,0,control"], r"line 2: sigma_m = 0;"),
        (["A,1,2,3,5,control"], r"line 2: sigma_m = 5; .* not millimetres"),
        (["A,1,2,3,0.005"], r"line 2: 5 values; expected 6: name,e_m"),
        (["A,1,5,2,5,3,0.005,control"], r"line 2: 8 values; .* decimals have a point"),
        ([",1,2,3,0.005,control"], r"line 2: name ''"),
        (['"A,1,2,3,0.005,control', "B,1,2,3,0.005,control"], r"line 2: no CSV"),
        (["", "# nothing"], r"targets.csv: holds no targets"),
    ],
)
def test_a_faulty_target_is_told_by_its_line(lines: list[str], said: str) -> None:
    with pytest.raises(FormatError, match=said) as error:
        _points(*lines)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("head", "line", "said"),
    [
        ("name,e_m,n_m,z_m,sigma_m", "A,1,2,3,0.005", r"line 1: no column role"),
        (HEAD + ",colour", "A,1,2,3,0.005,control,red", r"line 1: unknown column 'colour'"),
        (HEAD + ",role", "A,1,2,3,0.005,control,control", r"line 1: column role twice"),
        (HEAD.replace(",", ";"), "A;1;2;3;0.005;control", r"line 1: columns are not separated by commas"),
        (HEAD.replace("e_m,n_m", "x_m,y_m"), "A,1,2,3,0.005,control", r"line 1: unknown column 'x_m'"),
        (HEAD + ",tag_id", "A,1,2,3,0.005,control,4", r"line 2: tag_id without tag_size_m"),
        (HEAD + ",tag_size_m", "A,1,2,3,0.005,control,0.2", r"line 2: tag_size_m without tag_id"),
        (HEAD + ",tag_id,tag_size_m", "A,1,2,3,0.005,control,587,0.2", r"line 2: tag_id = '587'; .* 0 to 586"),
        (HEAD + ",tag_id,tag_size_m", "A,1,2,3,0.005,control,-1,0.2", r"line 2: tag_id = '-1'"),
        (HEAD + ",tag_id,tag_size_m", "A,1,2,3,0.005,control,1,200", r"line 2: tag_size_m = 200; expected 0.01 to 5"),
        (HEAD + ",sigma_z_m", "A,1,2,3,0.005,control,-1", r"line 2: sigma_z_m = -1"),
    ],
)
def test_faulty_columns_and_tags_are_told(head: str, line: str, said: str) -> None:
    with pytest.raises(FormatError, match=said):
        _points(line, head=head)


def test_two_targets_cannot_have_one_tag() -> None:
    with pytest.raises(FormatError, match=r"line 3: tag 7 is that of A in line 2"):
        _points("A,1,2,3,0.005,control,7,0.2", "B,4,5,6,0.005,control,7,0.2", head=HEAD + ",tag_id,tag_size_m")


def test_files_that_are_no_text_or_not_there(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no such file"):
        read_control_points(tmp_path / "none.csv")
    with pytest.raises(FormatError, match="cannot be read"):
        read_control_points(tmp_path)
    with pytest.raises(FormatError, match="not UTF-8"):
        parse_control_points("name,e_m\nSchächte".encode("latin-1"), where="x")
    with pytest.raises(FormatError, match="is empty"):
        parse_control_points(b"\n# only words\n", where="x")


@settings(max_examples=200, deadline=None)
@given(
    st.binary(max_size=200) | st.text(alphabet='Aa1.,-\n;"#e_m', max_size=120).map(lambda t: f"{HEAD}\n{t}".encode())
)
def test_whatever_comes_in_is_read_or_refused_in_one_line(content: bytes) -> None:
    said = ""
    try:
        assert parse_control_points(content, where="x")
    except FormatError as error:
        said = str(error)
    assert "\n" not in said


TARGETS = (
    ControlPoint("A", np.array([1.0, 2, 3]), 0.005, 0.005, "control"),
    ControlPoint("B", np.array([4.0, 5, 6]), 0.005, 0.005, "check"),
)


def test_observations_come_back_exactly(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    before = [
        Observation.picked("AB"[k % 2], "flight one", 1_790_000_000_000_000_001 + k, rng.normal(size=3), sigma_m=0.01)
        for k in range(9)
    ]
    (tmp_path / "o.csv").write_bytes(observations_csv(before))
    after = read_observations(tmp_path / "o.csv", TARGETS)
    assert [(o.target, o.flight, o.stamp_ns) for o in after] == [(o.target, o.flight, o.stamp_ns) for o in before]
    np.testing.assert_array_equal([o.point_lidar for o in after], [o.point_lidar for o in before])
    assert [o.sigma_m for o in after] == pytest.approx([0.01] * 9, rel=1e-12)
    assert parse_observations(SEEN.encode(), TARGETS, where="x") == ()


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["C,,1,1,2,3,0.01"], r"line 2: target 'C' is not surveyed; expected one of A, B"),
        (["A,,1.5,1,2,3,0.01"], r"line 2: stamp_ns = '1.5'; expected whole nanoseconds"),
        (["A,,1e18,1,2,3,0.01"], r"line 2: stamp_ns = '1e18'"),
        (["A,,-5,1,2,3,0.01"], r"line 2: stamp_ns = '-5'"),
        (["A,,9223372036854775808,1,2,3,0.01"], r"line 2: stamp_ns"),
        (["A,,1,500000,7100000,3,0.01"], r"line 2: a point 7117584 m away; expected coordinates in the lidar frame"),
        (["A,,1,NaN,2,3,0.01"], r"line 2: x_m = 'NaN'"),
        (["A,,1,1,2,3,-0.01"], r"line 2: sigma_m = -0.01"),
        (["A,,1,1,2,3,0.01", "A,,1,1,2,4,0.01"], r"line 3: A at 1 is in line 2 already"),
    ],
)
def test_a_faulty_observation_is_told_by_its_line(lines: list[str], said: str) -> None:
    with pytest.raises(FormatError, match=said):
        parse_observations("\n".join([SEEN, *lines]).encode(), TARGETS, where="seen.csv")


def test_nouns_refuse_what_no_survey_is() -> None:
    with pytest.raises(ValueError, match="sigmas"):
        ControlPoint("A", np.zeros(3), 0.0, 0.01, "control")
    with pytest.raises(ValueError, match="finite"):
        ControlPoint("A", np.array([0, 0, np.nan]), 0.01, 0.01, "control")
    with pytest.raises(ValueError, match="id and a size"):
        ControlPoint("A", np.zeros(3), 0.01, 0.01, "control", tag_id=3)
    with pytest.raises(ValueError, match="positive definite"):
        Observation("A", "", 0, np.zeros(3), np.zeros((3, 3)))


def test_a_flight_brings_its_survey_along(tmp_path: Path) -> None:
    seen = [Observation.picked("A", "", 5, np.array([1.0, 2, 3]), sigma_m=0.01)]
    with FlightWriter(tmp_path / "f.mcap", FlightInfo(), Calibration()) as writer:
        writer.add_attachment("control_points.csv", "text/csv", control_points_csv(TARGETS))
        writer.add_attachment("observations.csv", "text/csv", observations_csv(seen))
    with FlightWriter(tmp_path / "wrong.mcap", FlightInfo(), Calibration()) as writer:
        writer.add_attachment("observations.csv", "text/csv", observations_csv(seen))
    with FlightWriter(tmp_path / "none.mcap", FlightInfo(), Calibration()):
        pass
    with FlightReader(tmp_path / "f.mcap") as flight:
        points, observations = read_flight_survey(flight)
    assert ([p.name for p in points], [o.target for o in observations]) == (["A", "B"], ["A"])
    with FlightReader(tmp_path / "none.mcap") as flight:
        assert read_flight_survey(flight) == ((), ())
    with (
        FlightReader(tmp_path / "wrong.mcap") as flight,
        pytest.raises(FormatError, match=r"wrong.mcap:observations.csv, line 2: target 'A' is not surveyed"),
    ):
        read_flight_survey(flight)


def test_surveys_of_several_flights_become_one_unless_they_differ() -> None:
    other = ControlPoint("C", np.array([7.0, 8, 9]), 0.005, 0.005, "control", 4, 0.2)
    merged = merged_control_points([("one", TARGETS), ("two", [other]), ("three", [TARGETS[0], other])])
    assert [p.name for p in merged] == ["A", "B", "C"]
    moved = ControlPoint("A", np.array([1.0, 2, 3.001]), 0.005, 0.005, "control")
    with pytest.raises(FormatError, match="two: target 'A' is not as 'A' in one; expected one name"):
        merged_control_points([("one", TARGETS), ("two", [moved])])
    again = ControlPoint("D", np.array([7.0, 8, 9]), 0.005, 0.005, "control", 4, 0.2)
    with pytest.raises(FormatError, match="target 'D' is not as 'C' in one"):
        merged_control_points([("one", [other]), ("two", [again])])
