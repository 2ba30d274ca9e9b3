"""Every metric of one estimated trajectory against a reference, as configured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mineloc.config import EvaluateConfig
from mineloc.data import Trajectory
from mineloc.metrics.absolute import AbsoluteError, absolute_error
from mineloc.metrics.alignment import Alignment
from mineloc.metrics.association import Pairs, associate
from mineloc.metrics.coverage import Coverage, coverage
from mineloc.metrics.relative import RelativeError, relative_error
from mineloc.metrics.subtrajectories import PercentError, SegmentError, percent_errors, segment_errors


@dataclass(frozen=True, slots=True, eq=False)
class AlignedScores:
    """What depends on the alignment (RPE only in its last digits: evo measures it after aligning)."""

    absolute: AbsoluteError
    relative: tuple[RelativeError, ...]

    def to_dict(self, *, positions_only: bool = False) -> dict[str, Any]:
        """Plain values by name."""
        return {
            "alignment": self.absolute.alignment,
            "ape": self.absolute.to_dict() | ({"rotation_deg": None} if positions_only else {}),
            "rpe": [one.to_dict() for one in self.relative],
        }


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """All metrics of one trajectory.

    Attributes:
        name: `estimate`, or `smoothed` and `online` of a run.
        pairs: what was compared with what.
        coverage: of which share of the reference the scores speak.
        aligned: one entry an alignment.
        percent: REP-1, REP-2 …
        segments: KITTI.
        notes: what could not be scored, and why.
        positions_only: no orientations were compared; measures that need them are empty, rotation errors mean nothing.
    """

    name: str
    pairs: Pairs
    coverage: Coverage
    aligned: tuple[AlignedScores, ...]
    percent: tuple[PercentError, ...]
    segments: SegmentError
    notes: tuple[str, ...]
    positions_only: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name, without the arrays along the flight."""
        return {
            "name": self.name,
            "association": self.pairs.to_dict(),
            "coverage": self.coverage.to_dict(),
            "aligned": [one.to_dict(positions_only=self.positions_only) for one in self.aligned],
            "rep": [one.to_dict() for one in self.percent],
            "segments": self.segments.to_dict(),
            "notes": list(self.notes),
        }


def pair(reference: Trajectory, estimate: Trajectory, config: EvaluateConfig) -> Pairs:
    """`associate` as configured."""
    return associate(
        reference,
        estimate,
        method=config.association,
        max_time_difference_s=config.max_time_difference_s,
        max_reference_gap_s=config.max_reference_gap_s,
    )


def score(
    name: str,
    reference: Trajectory,
    estimate: Trajectory,
    pairs: Pairs,
    alignments: Sequence[Alignment],
    config: EvaluateConfig,
    *,
    positions_only: bool = False,
) -> Scores:
    """Score the pairs of one estimate. An alignment that the poses leave open becomes a note.

    With `positions_only` RPE, REP and KITTI are left out: they compare motions in the frame of the pose before.

    Raises:
        ValueError: no pairs.
    """
    if not len(pairs):
        raise ValueError("no pairs to score")
    aligned: list[AlignedScores] = []
    notes: list[str] = []
    for kind in alignments:
        try:
            absolute = absolute_error(pairs, kind)
        except ValueError as error:
            notes.append(f"no {kind} alignment: {error}")
            continue
        aligned.append(AlignedScores(absolute, () if positions_only else _relative(pairs, absolute, config)))
    percents, lengths_m = ((), ()) if positions_only else (config.rep_percents, config.segment_lengths_m)
    return Scores(
        name=name,
        pairs=pairs,
        coverage=coverage(reference, estimate, max_gap_s=config.max_gap_s),
        aligned=tuple(aligned),
        percent=percent_errors(pairs, path_length_m=float(reference.path_m[-1]), percents=percents),
        segments=segment_errors(pairs, lengths_m=lengths_m, step=config.segment_step),
        notes=tuple(notes),
        positions_only=positions_only,
    )


def _relative(pairs: Pairs, absolute: AbsoluteError, config: EvaluateConfig) -> tuple[RelativeError, ...]:
    frames = [(float(count), "frames") for count in config.rpe_frames]
    metres = [(length, "m") for length in config.rpe_lengths_m]
    return tuple(
        relative_error(
            pairs,
            delta=delta,
            unit="frames" if unit == "frames" else "m",
            all_pairs=config.rpe_all_pairs,
            tolerance=config.rpe_tolerance,
            T_reference_estimate=absolute.T_reference_estimate,
        )
        for delta, unit in frames + metres
    )
