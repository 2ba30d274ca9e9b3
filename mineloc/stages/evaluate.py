"""The evaluate stage: a run or a trajectory file against a reference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mineloc.config import EvaluateConfig
from mineloc.data import Trajectory
from mineloc.errors import EvaluationError
from mineloc.io.trajectories import LoadedTrajectory, load_trajectory
from mineloc.metrics.alignment import Alignment
from mineloc.metrics.association import Pairs
from mineloc.stages.recognitions import Recognition, recognition_of
from mineloc.stages.run_folder import RunFolder
from mineloc.stages.scores import Scores, pair, score

SCHEMA = "mineloc.evaluation/1"
ALIGNMENTS: tuple[Alignment, ...] = ("none", "origin", "se3")


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """How far an estimate is from a reference.

    Attributes:
        estimate, reference: where they came from.
        scores: one entry a trajectory; a run has `smoothed` and `online`.
        trusted_share: share of the run's sweeps whose pose rests on more than the motion prior; None for a file.
        notes: what was left out while reading.
        recognition: of a run that was given a database of intersections and a reference in its map.
    """

    estimate: str
    reference: str
    scores: tuple[Scores, ...]
    trusted_share: float | None = None
    notes: tuple[str, ...] = ()
    recognition: Recognition | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without the arrays along the flight."""
        return {
            "schema": SCHEMA,
            "estimate": self.estimate,
            "reference": self.reference,
            "trusted_share": self.trusted_share,
            "notes": list(self.notes),
            "trajectories": [one.to_dict() for one in self.scores],
            "recognition": None if self.recognition is None else self.recognition.to_dict(),
        }


def evaluate(
    estimate: str | Path,
    reference: str | Path | None = None,
    *,
    align: Alignment | None = None,
    config: EvaluateConfig | None = None,
) -> Evaluation:
    """Score an estimate.

    Args:
        estimate: a run folder (both its trajectories are scored), or a TUM, KITTI or MCAP file; `file.mcap:/topic`
            names a topic.
        reference: a flight, or a file as above. None takes the reference that a run brings along.
        align: one alignment; None scores `none`, `origin` and `se3`.
        config: association, distances, gaps.

    Raises:
        EvaluationError: no times or poses in common, too few poses, an alignment that the poses leave open, no
            reference.
        FormatError: a file cannot be read; NaN is told with its line.
    """
    config = config if config is not None else EvaluateConfig()
    given = _estimates(estimate)
    truth = _reference(estimate, reference, given.reference)
    positions_only = truth.positions_only or given.positions_only
    kinds = _alignments(estimate, align, positions_only=positions_only)
    scores: list[Scores] = []
    for name, trajectory in given.trajectories.items():
        pairs = _pairs(str(estimate), trajectory, truth, config)
        one = score(name, truth.trajectory, trajectory, pairs, kinds, config, positions_only=positions_only)
        if not one.aligned:
            raise EvaluationError(estimate, one.notes[0], todo="choose --align origin or none")
        scores.append(one)
    return Evaluation(
        estimate=str(estimate),
        reference=truth.source,
        scores=tuple(scores),
        trusted_share=given.trusted_share,
        notes=(*given.notes, *_remarks(truth)),
        recognition=None if given.run is None else recognition_of(given.run, truth.trajectory),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Estimates:
    """What is to be scored, by name, and what came along with it."""

    trajectories: dict[str, Trajectory]
    reference: LoadedTrajectory | None = None
    trusted_share: float | None = None
    notes: tuple[str, ...] = ()
    positions_only: bool = False
    run: RunFolder | None = None


def _estimates(estimate: str | Path) -> _Estimates:
    folder = Path(estimate)
    if not folder.is_dir():
        loaded = load_trajectory(estimate)
        return _Estimates({"estimate": loaded.trajectory}, notes=_remarks(loaded), positions_only=loaded.positions_only)
    run = RunFolder.open(folder)
    own = None
    if run.reference is not None:
        own = LoadedTrajectory(run.reference, str(folder / "reference.tum"), "tum")
    trusted = run.sweeps["trusted"].to_numpy()
    share = float(trusted.mean()) if len(trusted) else None
    return _Estimates({"smoothed": run.smoothed, "online": run.online}, own, share, run=run)


def _alignments(estimate: str | Path, align: Alignment | None, *, positions_only: bool) -> tuple[Alignment, ...]:
    if not positions_only:
        return (align,) if align else ALIGNMENTS
    if align == "origin":
        raise EvaluationError(
            estimate,
            "--align origin needs orientations on both sides",
            expected="one of none, posyaw, se3",
            todo="choose --align se3",
        )
    return (align,) if align else tuple(kind for kind in ALIGNMENTS if kind != "origin")


def _reference(
    estimate: str | Path, reference: str | Path | None, own_reference: LoadedTrajectory | None
) -> LoadedTrajectory:
    if reference is not None:
        return load_trajectory(reference)
    if own_reference is None:
        raise EvaluationError(
            estimate, "brings no reference along", expected="something to compare with", todo="give --reference"
        )
    return own_reference


def _remarks(loaded: LoadedTrajectory) -> tuple[str, ...]:
    out: list[str] = []
    if loaded.duplicates or loaded.conflicts:
        out.append(
            f"{loaded.source}: left out {loaded.duplicates} repeated poses and "
            f"{loaded.conflicts} others for a time that had one"
        )
    if loaded.positions_only:
        out.append(f"{loaded.source}: positions only; what needs orientations is left out")
    return tuple(out)


def _pairs(where: str, trajectory: Trajectory, truth: LoadedTrajectory, config: EvaluateConfig) -> Pairs:
    for source, one in ((where, trajectory), (truth.source, truth.trajectory)):
        if len(one) < 2:
            raise EvaluationError(
                source, f"{len(one)} pose{'s' * (len(one) != 1)}", expected="a trajectory of 2 poses or more"
            )
    try:
        pairs = pair(truth.trajectory, trajectory, config)
    except ValueError as error:
        raise EvaluationError(
            where, f"cannot be compared with {truth.source}: {error}", expected="both with times, or as many poses"
        ) from None
    if len(pairs) < 2:
        raise EvaluationError(
            where,
            f"{len(pairs)} of {len(trajectory)} poses have one near in time in {truth.source} "
            f"({_span(trajectory)} against {_span(truth.trajectory)})",
            expected=f"the same clock, within {config.max_time_difference_s} s",
            todo="check the times, or raise evaluate.max_time_difference_s",
        )
    return pairs


def _span(trajectory: Trajectory) -> str:
    first, last = trajectory.stamps_ns[[0, -1]] * 1e-9
    return f"{first:.3f} … {last:.3f} s"
