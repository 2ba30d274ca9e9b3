"""What is told of the results."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from mineloc.config.section import Section


class EvaluateConfig(Section):
    """Comparison with a reference."""

    association: Literal["auto", "nearest", "interpolate"] = Field(
        default="auto", description="auto takes the nearest pose, but interpolates the reference where the rates differ"
    )
    max_time_difference_s: float = Field(default=0.01, gt=0)
    max_reference_gap_s: float = Field(default=0.5, gt=0, description="no interpolation over longer gaps")
    max_gap_s: float = Field(default=1.0, gt=0, description="longer gaps of the estimate are not covered")
    rep_percents: tuple[Annotated[float, Field(gt=0, le=100)], ...] = (20.0, 40.0, 60.0, 80.0, 100.0)
    segment_lengths_m: tuple[PositiveFloat, ...] = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
    segment_step: int = Field(default=10, ge=1, description="a segment starts every so many poses (KITTI)")
    rpe_frames: tuple[PositiveInt, ...] = (1,)
    rpe_lengths_m: tuple[PositiveFloat, ...] = (100.0,)
    rpe_all_pairs: bool = False
    rpe_tolerance: float = Field(default=0.1, gt=0, lt=1)
    shown_alignment: Literal["auto", "none", "origin", "se3"] = Field(
        default="auto", description="under which report and viewer draw: auto is none in a prior map, else origin"
    )


class ReportConfig(Section):
    """The accuracy report."""

    title: str = "Localization accuracy report"


class ViewConfig(Section):
    """The Rerun recording."""

    sweep_stride: int = Field(default=5, ge=1, description="every n-th sweep is shown")
    sweep_points: int = Field(default=1_000_000, ge=1000, description="points of all shown sweeps together, at most")
    map_points: int = Field(default=250_000, ge=1000, description="points of the mine, at most")
