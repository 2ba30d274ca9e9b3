"""An evaluation as tables for people."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table

from mineloc.metrics.statistics import Statistics
from mineloc.stages.evaluate import Evaluation
from mineloc.stages.scores import Scores

_NOTHING = "-"


def heading(evaluation: Evaluation) -> list[str]:
    """What was compared, how the poses were paired and how much of the reference that covers, line by line."""
    lines = [f"estimate   {evaluation.estimate}", f"reference  {evaluation.reference}"]
    if evaluation.trusted_share is not None:
        lines.append(f"trusted    {evaluation.trusted_share:.1%} of the sweeps")
    for scores in evaluation.scores:
        lines += [f"{scores.name}: {_pairing(scores)}; {_covered(scores)}"]
        lines += [f"{scores.name}: {note}" for note in scores.notes]
    return lines + list(evaluation.notes)


def tables(evaluation: Evaluation) -> list[Table]:
    """The absolute errors by alignment, and the errors over pieces of the flight."""
    return [_absolute(evaluation), _pieces(evaluation)]


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
    table = _table("absolute error (APE)")
    table.add_column("trajectory")
    table.add_column("aligned")
    for name in ("rmse m", "mean m", "median m", "std m", "max m", "rmse °", "max °"):
        table.add_column(name, justify="right")
    for scores in evaluation.scores:
        for one in scores.aligned:
            t, r = one.absolute.translation_m, one.absolute.rotation_deg
            numbers = [t.rmse, t.mean, t.median, t.std, t.max]
            angles = [f"{r.rmse:.2f}", f"{r.max:.2f}"]
            table.add_row(scores.name, one.absolute.alignment, *(f"{x:.3f}" for x in numbers), *angles)
    return table


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
