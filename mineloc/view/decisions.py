"""What the localization decided and why, as lines of a log and as states over time."""

from __future__ import annotations

import json

import polars as pl

from mineloc.data import Trajectory
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.stretches import Stretch, degenerate_stretches, untrusted_stretches

Line = tuple[int, str, str]

HELD, DEGENERATE, UNTRUSTED = "held on all sides", "degenerate", "motion prior alone"


def run_decisions(run: RunFolder, smoothed: Trajectory) -> list[Line]:
    """(time, level, text) of begin and end, untrusted and degenerate stretches and recognitions, by time."""
    lines = [_untrusted(stretch) for stretch in untrusted_stretches(run.sweeps)]
    lines += [_degenerate(stretch, smoothed) for stretch in degenerate_stretches(run.sweeps)]
    lines += [_recognition(row) for row in run.fixes.iter_rows(named=True)]
    return [_begin(run, smoothed), *sorted(lines), _end(smoothed)]


def run_states(sweeps: pl.DataFrame) -> dict[int, str]:
    """{time: state} of the registration; untrusted wins where it is degenerate too."""
    state = pl.when(~pl.col("trusted")).then(pl.lit(UNTRUSTED))
    state = state.when(pl.col("is_degenerate")).then(pl.lit(DEGENERATE)).otherwise(pl.lit(HELD))
    table = sweeps.select("stamp_ns", state=state)
    changed = table.filter(pl.col("state").ne_missing(pl.col("state").shift()))
    return dict(changed.iter_rows())


def _begin(run: RunFolder, smoothed: Trajectory) -> Line:
    return int(smoothed.stamps_ns[0]), "INFO", f"first pose; {len(run.sweeps)} sweeps, {len(run.keyframes)} keyframes"


def _end(smoothed: Trajectory) -> Line:
    seconds = int(smoothed.stamps_ns[-1] - smoothed.stamps_ns[0]) * 1e-9
    return int(smoothed.stamps_ns[-1]), "INFO", f"last pose, {smoothed.path_m[-1]:.1f} m and {seconds:.1f} s on"


def _seconds(stretch: Stretch) -> float:
    return (stretch.end_ns - stretch.start_ns) * 1e-9


def _untrusted(stretch: Stretch) -> Line:
    sweeps = "1 sweep" if stretch.sweeps == 1 else f"{stretch.sweeps} sweeps"
    text = f"pose by motion prior alone for {sweeps} ({_seconds(stretch):.1f} s): {stretch.reason}"
    return stretch.start_ns, "WARN", text


def _degenerate(stretch: Stretch, smoothed: Trajectory) -> Line:
    origin = int(smoothed.stamps_ns[0])
    inside = (smoothed.stamps_ns >= stretch.start_ns) & (smoothed.stamps_ns <= stretch.end_ns)
    path = smoothed.path_m[inside]
    length = float(path[-1] - path[0]) if len(path) else 0.0
    text = (
        f"degenerate for {length:.0f} m ({_seconds(stretch):.1f} s), from {(stretch.start_ns - origin) * 1e-9:.1f} s on"
    )
    return stretch.start_ns, "INFO", text


def _recognition(row: dict[str, object]) -> Line:
    numbers: dict[str, float | None] = json.loads(str(row["scores"]))
    scores = ", ".join(f"{name} {value:.3g}" for name, value in numbers.items() if value is not None)
    told = f" ({scores})" if scores else ""
    stamp = int(str(row["stamp_ns"]))
    if row["trusted"]:
        return stamp, "INFO", f"keyframe {row['keyframe']}: recognised {row['target'] or 'the map'}{told}"
    return stamp, "WARN", f"keyframe {row['keyframe']}: refused, {row['reason']}{told}"
