"""Layout of the replay on the screen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from daq.drawing.palette import BACKGROUND

if TYPE_CHECKING:
    import rerun.blueprint as rrb

# Natural periods of the lowest mode on each side of the time cursor in the plots around it.
PERIODS = 2.5
TIMELINE = "time"
# Below this entity each channel that was overloaded has a lane.
OVERLOADS = "test/overload"
# Duration of a live plot, s.
LIVE_S = 0.5


@dataclass(frozen=True)
class Content:
    """Content of the layout."""

    plots: Sequence[tuple[str, str]]
    """Entity and title of each group of channels, the most important first."""
    dampers: int
    """Number of dampers with gaps and contacts."""
    overloaded: int
    """Number of overloaded channels."""
    lowest_hz: float
    """Lowest natural frequency, which determines the span of the plots around the time cursor."""
    eye: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Position and target of the camera."""
    span_s: tuple[float, float]
    """Start and end on the timeline, s."""
    speed: float
    """Playback speed, 1 is real time."""


def layout(content: Content) -> rrb.Blueprint:
    """Arrange a replay: rig and notes at the left, plots at the right.

    The plot at the top shows the whole recording with the phases of the test under it; the plots below show
    the surroundings of the time cursor.
    """
    import rerun.blueprint as rrb

    around = PERIODS / content.lowest_hz
    entity, title = content.plots[0]
    # By default the viewer shows about a minute around the cursor.
    begin, end = (rrb.TimeRangeBoundary.absolute(seconds=at) for at in content.span_s)
    axis = rrb.TimeAxis(view_range=rrb.TimeRange(start=begin, end=end))
    whole = rrb.TimeSeriesView(
        origin=entity, name=f"{title}, whole recording", plot_legend=_legend(), axis_x=axis
    )
    phases = rrb.StateTimelineView(
        origin="test",
        contents=["test/phase", f"{OVERLOADS}/**"],
        name="test (grey: settling, green: measuring, or the decay after a hit; red: overloaded)",
        time_view=axis,
    )
    near = [
        rrb.TimeSeriesView(
            origin=entity, name=f"{title} around the cursor", time_ranges=_near(around), plot_legend=_legend()
        )
        for entity, title in content.plots
    ]
    channels = near[0] if len(near) == 1 else rrb.Tabs(*near, active_tab=0)
    right: list[rrb.TimeSeriesView | rrb.StateTimelineView | rrb.Tabs] = [whole, phases, channels]
    if content.dampers:
        right.append(
            rrb.TimeSeriesView(
                origin="dampers/gap_mm", name="damper gap [mm] around the cursor (truth)",
                time_ranges=_near(around), plot_legend=_legend(),
            )
        )  # fmt: skip
        right.append(
            rrb.StateTimelineView(
                origin="dampers/contact",
                name="contact (truth)",
                time_view=rrb.TimeAxis(view_range=_around(around)),
            )
        )
    notes = rrb.Tabs(
        rrb.Spatial2DView(origin="spectrum", name="spectrum"),
        rrb.TextDocumentView(origin="about", name="recording"),
        rrb.TextLogView(origin="test", contents="test/marks", name="markers"),
        active_tab=0,
    )
    # A lane of a state timeline has a fixed height, which determines that of its view.
    lanes = 0.6 * content.overloaded
    shares = [3.0, 1.0 + lanes, 4.5]
    if content.dampers:
        shares = [3.0, 1.5 + lanes, 3.8, 3.0, 0.8 + 0.6 * content.dampers]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(_rig_view(content.eye), notes, row_shares=[1.6, 1.0]),
            rrb.Vertical(*right, row_shares=shares),
            column_shares=[1.0, 1.35],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, playback_speed=content.speed, loop_mode="all"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def live_layout(
    plots: Sequence[tuple[str, str]], dampers: int, eye: tuple[tuple[float, ...], tuple[float, ...]]
) -> rrb.Blueprint:
    """Arrange a live view: rig and readings at the left, the last seconds of every curve at the right.

    `plots` are entity and title of each group of channels, `eye` position and target of the camera.
    """
    import rerun.blueprint as rrb

    latest = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-LIVE_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    ranges = rrb.VisibleTimeRange(TIMELINE, latest)
    right: list[rrb.View] = [
        rrb.TimeSeriesView(origin=entity, name=title, time_ranges=ranges, plot_legend=_legend())
        for entity, title in plots
    ]
    shares = [4.0] * len(right)
    if dampers:
        right.append(
            rrb.TimeSeriesView(
                origin="dampers/gap_mm", name="damper gap [mm]", time_ranges=ranges, plot_legend=_legend()
            )
        )
        axis = rrb.TimeAxis(view_range=latest)
        right.append(rrb.StateTimelineView(origin="dampers/contact", name="contact", time_view=axis))
        shares += [3.0, 0.8 + 0.6 * dampers]
    left = rrb.Vertical(
        _rig_view(eye), rrb.TextDocumentView(origin="reading", name="reading"), row_shares=[1.6, 1.0]
    )
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Vertical(*right, row_shares=shares), column_shares=[1.0, 1.35]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _rig_view(eye: tuple[tuple[float, ...], tuple[float, ...]]) -> rrb.Spatial3DView:
    import rerun.blueprint as rrb

    position, target = eye
    return rrb.Spatial3DView(
        origin="rig",
        name="rig",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 0, 1)),
    )


def _near(seconds: float) -> rrb.VisibleTimeRange:
    import rerun.blueprint as rrb

    return rrb.VisibleTimeRange(TIMELINE, _around(seconds))


def _around(seconds: float) -> rrb.TimeRange:
    import rerun.blueprint as rrb

    return rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-seconds),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=seconds),
    )


def _legend() -> rrb.PlotLegend:
    import rerun.blueprint as rrb

    return rrb.PlotLegend(rrb.Corner2D.RightTop)
