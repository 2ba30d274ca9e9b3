"""An evaluation as tables for people."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table

from mineloc.metrics.statistics import Statistics
from mineloc.stages.before_after import BeforeAfter
from mineloc.stages.evaluate import Evaluation
from mineloc.stages.recognitions import Recognition
from mineloc.stages.scores import Scores

_NOTHING = "-"


def heading(evaluation: Evaluation) -> list[str]:
    """What was compared, how the poses were paired and how much of the reference that covers, line by line."""
    return [f"estimate   {evaluation.estimate}", f"reference  {evaluation.reference}", *_facts(evaluation, "")]


def before_after_heading(both: BeforeAfter) -> list[str]:
    """As `heading`, of baseline and estimate."""
    return [
        f"before     {both.before.estimate}",
        f"after      {both.after.estimate}",
        f"reference  {both.after.reference}",
        *_facts(both.before, "before, "),
        *_facts(both.after, "after, "),
    ]


def before_after_table(both: BeforeAfter) -> Table:
    """Paper B's tables 1 and 2 in one: statistics of the translation error in metres, before and after."""
    table = _table("absolute error (APE) in metres")
    for name in ("", "trajectory", "aligned"):
        table.add_column(name)
    for name in ("max", "min", "mean", "rmse", "std", "coverage"):
        table.add_column(name, justify="right")
    for one in both.changes:
        for when, name, t, covered in (
            ("before", one.baseline_trajectory, one.before_m, one.before_coverage),
            ("after", one.trajectory, one.after_m, one.after_coverage),
        ):
            numbers = (_number(x, 4) for x in (t.max, t.min, t.mean, t.rmse, t.std))
            table.add_row(when, name, one.alignment, *numbers, f"{covered:.1%}")
    return table


def before_after_lines(both: BeforeAfter) -> list[str]:
    """The change of each rmse, a line each."""
    return [
        f"{one.trajectory}, {one.alignment}: rmse {_number(one.before_m.rmse, 4)} -> {_number(one.after_m.rmse, 4)} m, "
        + ("no error before" if one.rmse_percent is None else f"{one.rmse_percent:+.1f} %")
        for one in both.changes
    ]


def _facts(evaluation: Evaluation, prefix: str) -> Iterator[str]:
    if evaluation.trusted_share is not None:
        yield f"{prefix + 'trusted':<10} {evaluation.trusted_share:.1%} of the sweeps"
    for scores in evaluation.scores:
        yield f"{prefix}{scores.name}: {_pairing(scores)}; {_covered(scores)}"
        yield from (f"{prefix}{scores.name}: {note}" for note in scores.notes)
    if evaluation.recognition is not None:
        yield f"{prefix}{_recognition(evaluation.recognition)}"
    yield from evaluation.notes


def _recognition(found: Recognition) -> str:
    score = found.score
    wrong = f"{score.wrong} of {score.accepted} recognitions wrong"
    if found.recall is None:
        return f"recognition: {wrong}, no intersection was passed"
    first = "" if score.first_m is None else f", the first after {score.first_m:.0f} m"
    return f"recognition: {found.recall:.1%} of the passages of intersections, {wrong}{first}"


def tables(evaluation: Evaluation) -> list[Table]:
    """The absolute errors by alignment, and the errors over pieces of the flight, which need orientations."""
    pieces = [] if all(scores.positions_only for scores in evaluation.scores) else [_pieces(evaluation)]
    return [_absolute(evaluation), *pieces]


def _pairing(scores: Scores) -> str:
    facts = scores.pairs.to_dict()
    how = {
        "nearest": f"nearest in time, {1e3 * facts['time_difference_mean_s']:.1f} ms apart on average "
        f"(at most {1e3 * facts['time_difference_max_s']:.1f})",
        "interpolate": "reference interpolated",
        "index": "without times, by their order",
    }
    return f"{facts['pairs']} of {facts['estimate_poses']} poses paired, {how[scores.pairs.method]}"


def _covered(scores: Scores) -> str:
    c = scores.coverage
    time = f" and {c.time:.1%} of its {c.reference_duration_s:.1f} s" if c.reference_duration_s else ""
    return f"coverage {c.path:.1%} of the reference's {c.reference_path_m:.1f} m{time}"


def _table(title: str) -> Table:
    # narrow enough for 80 columns, which is what a pipe gets
    return Table(title=f"\n{title}", title_justify="left", box=None, padding=(0, 2, 0, 0), pad_edge=False)


def _absolute(evaluation: Evaluation) -> Table:
    table = _table("absolute error (APE) in metres and degrees")
    table.add_column("trajectory")
    table.add_column("aligned")
    for name in ("rmse", "mean", "median", "std", "min", "max", "rmse °", "max °"):
        table.add_column(name, justify="right")
    for scores in evaluation.scores:
        for one in scores.aligned:
            t, r = one.absolute.translation_m, one.absolute.rotation_deg
            metres = (_number(x, 3) for x in (t.rmse, t.mean, t.median, t.std, t.min, t.max))
            angles = (_NOTHING, _NOTHING) if scores.positions_only else (f"{r.rmse:.2f}", f"{r.max:.2f}")
            table.add_row(scores.name, one.absolute.alignment, *metres, *angles)
    return table


def _number(value: float, decimals: int) -> str:
    """So many decimals below 10, and no wider above: the columns must fit."""
    whole = len(f"{value:.0f}")
    return f"{value:.{max(decimals + 1 - whole, 1)}f}"


def _pieces(evaluation: Evaluation) -> Table:
    table = _table("error over pieces of the flight")
    table.add_column("trajectory")
    table.add_column("measure")
    table.add_column("over", justify="right")
    for name in ("mean", "rmse", "°/m", "pieces"):
        table.add_column(name, justify="right")
    for scores in evaluation.scores:
        for row in [*_rep_rows(scores), *_segment_rows(scores), *_relative_rows(scores)]:
            table.add_row(scores.name, *row)
    return table


def _rep_rows(scores: Scores) -> Iterator[tuple[str, ...]]:
    for k, rep in enumerate(scores.percent, start=1):
        over = f"{rep.distance_m:.1f} m"
        yield (f"REP-{k} ({rep.percent_of_path:g} %)", over, *_percents(rep.literal, rep.literal_deg_per_m))
        if rep.percent_of_path == 100:
            yield (f"REP-{k} strict", over, *_percents(rep.strict, rep.strict_deg_per_m))


def _percents(share: Statistics | None, turn: Statistics | None) -> tuple[str, ...]:
    if share is None or turn is None:
        return (_NOTHING, _NOTHING, _NOTHING, "0")
    return (f"{share.mean:.3f} %", f"{share.rmse:.3f} %", f"{turn.mean:.5f}", str(share.count))


def _segment_rows(scores: Scores) -> Iterator[tuple[str, ...]]:
    for length, percent, deg_per_m, count in scores.segments.by_length[:1]:
        yield ("KITTI shortest", f"{length:g} m", f"{percent:.3f} %", _NOTHING, f"{deg_per_m:.5f}", str(count))
    segments = scores.segments
    if segments.percent is None or segments.deg_per_m is None:
        yield ("KITTI", _NOTHING, _NOTHING, _NOTHING, _NOTHING, "0")
    else:
        over = f"{segments.by_length[0][0]:g} … {segments.by_length[-1][0]:g} m"
        yield ("KITTI", over, f"{segments.percent:.3f} %", _NOTHING, f"{segments.deg_per_m:.5f}", str(segments.count))


def _relative_rows(scores: Scores) -> Iterator[tuple[str, ...]]:
    for one in scores.aligned[0].relative:
        unit = "poses" if one.unit == "frames" else "m"
        over = f"{one.delta:g} {unit}"
        if one.translation_m is None:
            yield ("RPE", over, _NOTHING, _NOTHING, _NOTHING, "0")
        else:
            t = one.translation_m
            yield ("RPE", over, f"{t.mean:.4f} m", f"{t.rmse:.4f} m", _NOTHING, str(t.count))
