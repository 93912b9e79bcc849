"""Layout of the replay on the screen."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from daq.drawing.palette import BACKGROUND

# Natural periods of the lowest mode on each side of the time cursor in the plots around it.
PERIODS = 2.5
TIMELINE = "time"
# Below this entity each channel that was overloaded has a lane.
OVERLOADS = "test/overload"
# Duration of a live plot, s.
LIVE_S = 0.5


def layout(
    plots: Sequence[tuple[str, str]],
    dampers: int,
    overloaded: int,
    lowest_hz: float,
    eye: tuple[tuple[float, ...], tuple[float, ...]],
    span_s: tuple[float, float],
    speed: float,
) -> rrb.Blueprint:
    """Arrange a replay: rig and notes at the left, plots at the right.

    The plot at the top shows the whole recording with the phases of the test under it; the plots below show
    the surroundings of the time cursor, as wide as the lowest natural frequency requires. `plots` are entity and title
    of each group of channels, the most important first; `dampers` counts those with gaps and contacts, `overloaded` the
    overloaded channels; `eye` is position and target of the camera, `span_s` start and end on the timeline, `speed` the
    playback speed (1 is real time).
    """
    cursor_range = _cursor_range(PERIODS / lowest_hz, PERIODS / lowest_hz)
    entity, title = plots[0]
    # By default the viewer shows about a minute around the cursor.
    begin, end = (rrb.TimeRangeBoundary.absolute(seconds=at) for at in span_s)
    axis = rrb.TimeAxis(view_range=rrb.TimeRange(start=begin, end=end))
    full_view = rrb.TimeSeriesView(origin=entity, name=f"{title}, whole recording", plot_legend=_legend(), axis_x=axis)
    phases = rrb.StateTimelineView(
        origin="test",
        contents=["test/phase", f"{OVERLOADS}/**"],
        name="test (gray: settling, green: measuring, or the decay after a hit; red: overloaded)",
        time_view=axis,
    )
    curves = [_curves(entity, f"{title} around the cursor", cursor_range) for entity, title in plots]
    right: list[rrb.TimeSeriesView | rrb.StateTimelineView | rrb.Tabs] = [full_view, phases]
    right.append(curves[0] if len(curves) == 1 else rrb.Tabs(*curves, active_tab=0))
    if dampers:
        right.append(_curves("dampers/gap_mm", "damper gap [mm] around the cursor (truth)", cursor_range))
        axis = rrb.TimeAxis(view_range=cursor_range)
        right.append(rrb.StateTimelineView(origin="dampers/contact", name="contact (truth)", time_view=axis))
    notes = rrb.Tabs(
        rrb.Spatial2DView(origin="spectrum", name="spectrum"),
        rrb.TextDocumentView(origin="about", name="recording"),
        rrb.TextLogView(origin="test", contents="test/marks", name="markers"),
        active_tab=0,
    )
    # A lane of a state timeline has a fixed height, which determines that of its view.
    lanes = 0.6 * overloaded
    shares = [3.0, 1.0 + lanes, 4.5]
    if dampers:
        shares = [3.0, 1.5 + lanes, 3.8, 3.0, 0.8 + 0.6 * dampers]
    panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, playback_speed=speed, loop_mode="all")
    return _page(eye, notes, right, shares, panel)


def live_layout(
    plots: Sequence[tuple[str, str]], dampers: int, eye: tuple[tuple[float, ...], tuple[float, ...]]
) -> rrb.Blueprint:
    """Arrange a live view: rig and readings at the left, the last seconds of every curve at the right.

    `plots` are entity and title of each group of channels, `eye` position and target of the camera.
    """
    latest = _cursor_range(LIVE_S, 0.0)
    right: list[rrb.View] = [_curves(entity, title, latest) for entity, title in plots]
    shares = [4.0] * len(right)
    if dampers:
        right.append(_curves("dampers/gap_mm", "damper gap [mm]", latest))
        axis = rrb.TimeAxis(view_range=latest)
        right.append(rrb.StateTimelineView(origin="dampers/contact", name="contact", time_view=axis))
        shares += [3.0, 0.8 + 0.6 * dampers]
    reading = rrb.TextDocumentView(origin="reading", name="reading")
    panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following")
    return _page(eye, reading, right, shares, panel)


def _page(
    eye: tuple[tuple[float, ...], tuple[float, ...]],
    notes: rrb.View | rrb.Tabs,
    right: Sequence[rrb.View | rrb.Tabs],
    shares: Sequence[float],
    panel: rrb.TimePanel,
) -> rrb.Blueprint:
    position, target = eye
    rig = rrb.Spatial3DView(
        origin="rig",
        name="rig",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 0, 1)),
    )
    left_column = rrb.Vertical(rig, notes, row_shares=[1.6, 1.0])
    return rrb.Blueprint(
        rrb.Horizontal(left_column, rrb.Vertical(*right, row_shares=shares), column_shares=[1.0, 1.35]),
        panel,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _curves(entity: str, title: str, cursor_range: rrb.TimeRange) -> rrb.TimeSeriesView:
    ranges = rrb.VisibleTimeRange(TIMELINE, cursor_range)
    return rrb.TimeSeriesView(origin=entity, name=title, time_ranges=ranges, plot_legend=_legend())


def _cursor_range(before_s: float, after_s: float) -> rrb.TimeRange:
    start, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=at) for at in (-before_s, after_s))
    return rrb.TimeRange(start=start, end=end)


def _legend() -> rrb.PlotLegend:
    return rrb.PlotLegend(rrb.Corner2D.RightTop)
