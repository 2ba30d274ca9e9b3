"""What the viewer opens on: the mine large, the curves beside it, the decisions below."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun.blueprint as rrb

from mineloc.data import F64
from mineloc.view.recorder import TIMELINE

_CURVES = (
    ("error", "Position error (m)"),
    ("uncertainty", "Claimed uncertainty (m)"),
    ("health", "Registration (0 to 1)"),
    ("speed", "Speed (m/s)"),
    ("force", "Specific force (m/s²)"),
    ("turn", "Turn rate (°/s)"),
)


def flight_layout(
    low_m: F64,
    high_m: F64,
    *,
    first_ns: int,
    last_ns: int,
    curves: Mapping[str, tuple[float, float]],
    log: bool,
    recognitions: bool = False,
) -> rrb.Blueprint:
    """The layout of a run or a flight.

    Args:
        low_m, high_m: (3,) corners of what the eye shall take in, local origin already subtracted.
        first_ns, last_ns: all curves open on this span of time.
        curves: groups of curves below `/curves` that the recording has, with their lowest and highest value.
        log: whether it has decisions and states.
        recognitions: whether it has recognised intersections: they get a tab of their own.
    """
    span = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.absolute(nanos=first_ns),
        end=rrb.TimeRangeBoundary.absolute(nanos=last_ns),
    )
    axis = rrb.TimeAxis(view_range=span)
    lanes: list[rrb.View] = [
        rrb.TimeSeriesView(
            origin=f"curves/{key}",
            name=name,
            axis_x=axis,
            axis_y=rrb.ScalarAxis(range=_with_margin(*curves[key])),
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        )
        for key, name in _CURVES
        if key in curves
    ]
    about = rrb.TextDocumentView(origin="about", name="About")
    mine = rrb.Spatial3DView(origin="map", name="Mine", eye_controls=_eye(low_m, high_m), line_grid=False)
    if log:
        lanes.append(rrb.StateTimelineView(origin="states", name="States", time_view=axis))
        seen = rrb.Horizontal(mine, rrb.Vertical(*lanes), column_shares=[3, 2])
        root = rrb.Vertical(
            seen,
            rrb.Horizontal(rrb.TextLogView(origin="log", name="Decisions"), about),
            row_shares=[3, 1],
            name="Flight",
        )
    else:
        root = rrb.Horizontal(mine, rrb.Vertical(*lanes, about), column_shares=[3, 2])
    if recognitions:
        root = rrb.Tabs(root, _recognitions(), active_tab=0)
    return rrb.Blueprint(
        root,
        rrb.TimePanel(timeline=TIMELINE, state=rrb.PanelState.Collapsed),
        rrb.SelectionPanel(state=rrb.PanelState.Hidden),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
        auto_views=False,
    )


def _recognitions() -> rrb.Container:
    """One recognition at a time, that of the time cursor; a line of the list takes the cursor to another."""
    eye = rrb.EyeControls3D(position=(0.0, -11.0, 20.0), look_target=(0.0, -0.5, 0.5), eye_up=(0.0, 0.0, 1.0))
    clouds = rrb.Spatial3DView(origin="recognised", name="Stored and seen", eye_controls=eye, line_grid=False)
    contours = rrb.Spatial2DView(
        origin="contours",
        name="Contours (PWCV), a ring every 2 m",
        visual_bounds=rrb.VisualBounds2D(x_range=[-9.0, 9.0], y_range=[-9.0, 9.0]),
    )
    listed = rrb.TextLogView(origin="recognitions/list", name="Recognised, by time: click one")
    steps = rrb.TextDocumentView(origin="recognitions/steps", name="Why it was accepted")
    return rrb.Horizontal(
        rrb.Vertical(clouds, listed, row_shares=[3, 1]),
        rrb.Vertical(contours, steps, row_shares=[1, 2]),
        column_shares=[3, 2],
        name="Recognitions",
    )


def map_layout(low_m: F64, high_m: F64) -> rrb.Blueprint:
    """The layout of a map: the mine without its roof, the facts beside it.

    Args:
        low_m, high_m: (3,) corners of what the eye shall take in, local origin already subtracted.
    """
    mine = rrb.Spatial3DView(
        origin="map",
        name="Map",
        eye_controls=_eye(low_m, high_m),
        line_grid=False,
        overrides={"map/roof": rrb.EntityBehavior(visible=False)},
    )
    return rrb.Blueprint(
        rrb.Horizontal(mine, rrb.TextDocumentView(origin="about", name="About"), column_shares=[4, 1]),
        rrb.TimePanel(state=rrb.PanelState.Hidden),
        rrb.SelectionPanel(state=rrb.PanelState.Hidden),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
        auto_views=False,
    )


def database_layout(low_m: F64, high_m: F64) -> rrb.Blueprint:
    """The layout of a database of intersections: the mine, and beside it how alike they are and the facts.

    Args:
        low_m, high_m: (3,) corners of what the eye shall take in, local origin already subtracted.
    """
    mine = rrb.Spatial3DView(origin="map", name="Intersections", eye_controls=_eye(low_m, high_m), line_grid=False)
    alike = rrb.Horizontal(
        rrb.Spatial2DView(origin="similarity/contours", name="Contours alike (PWCV)"),
        rrb.Spatial2DView(origin="similarity/matrices", name="Matrices alike (CWC)"),
    )
    about = rrb.TextDocumentView(origin="about", name="About")
    return rrb.Blueprint(
        rrb.Horizontal(mine, rrb.Vertical(alike, about, row_shares=[2, 3]), column_shares=[3, 2]),
        rrb.TimePanel(state=rrb.PanelState.Hidden),
        rrb.SelectionPanel(state=rrb.PanelState.Hidden),
        rrb.BlueprintPanel(state=rrb.PanelState.Collapsed),
        auto_views=False,
    )


def _eye(low_m: F64, high_m: F64) -> rrb.EyeControls3D:
    """From the south, steep enough that roadways do not hide each other, near enough to fill the view."""
    width, depth, height = np.maximum(high_m - low_m, 1.0).tolist()
    # the near end looks larger than the far one: aim a little south of the middle
    target = (low_m + high_m) / 2 - np.array([0.0, 0.05 * depth, 0.0])
    away = max(0.75 * width, 1.1 * depth) + height + 5.0
    return rrb.EyeControls3D(
        position=target + away * np.array([0.0, -0.5, 0.87]), look_target=target, eye_up=(0.0, 0.0, 1.0)
    )


def _with_margin(low: float, high: float) -> tuple[float, float]:
    # room above for the legend
    size = max(high - low, 1e-3)
    return low - 0.05 * size, high + 0.4 * size
