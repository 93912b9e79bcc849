"""Layouts of the viewer for a replay and for a live view.

Rerun calls a layout a blueprint, and a drawn item an entity; entities have paths such as test/phase as names.
"""

from collections.abc import Sequence

import rerun.blueprint as rrb

from daq.core.drawing.palette import BACKGROUND

# Time that the plots show on each side of the time cursor, natural periods of the lowest mode.
CURSOR_PERIODS = 2.5
TIMELINE = "time"
# Parent of the entities of overloaded channels.
OVERLOAD_ENTITY = "overload"
# Parent of the entities of the envelopes of channels.
ENVELOPE_ENTITY = "envelopes"
#: Position of the camera, and the point it looks at [m].
Camera = tuple[tuple[float, ...], tuple[float, ...]]


def layout(
    plots: Sequence[tuple[str, str]],
    damper_count: int,
    overloaded_count: int,
    lowest_mode_hz: float,
    camera: Camera,
    span_s: tuple[float, float],
    is_whole: bool,
    speed: float,
) -> rrb.Blueprint:
    """Arrange a replay: rig, phases of the test and notes at the left, plots at the right.

    The plot at the top shows the envelope of each channel in the whole segment: filled curves would hide each other.
    The plots below show some periods of the lowest mode around the time cursor.

    `plots` lists entity and title of the plot of each quantity, the most important first. `damper_count` is the number
    of dampers with known gaps. `camera` is the position of the camera and the point at which it looks. `span_s` is the
    start and the end on the timeline; `is_whole` states whether this is the whole recording. `speed` is the playback
    speed (1 is real time).
    """
    cursor_range = _cursor_range(CURSOR_PERIODS / lowest_mode_hz, CURSOR_PERIODS / lowest_mode_hz)
    title = plots[0][1]
    # Without limits the viewer shows only about a minute around the cursor.
    begin, end = (rrb.TimeRangeBoundary.absolute(seconds=time_s) for time_s in span_s)
    axis = rrb.TimeAxis(view_range=rrb.TimeRange(start=begin, end=end))
    part = "whole recording" if is_whole else f"{round(span_s[0], 3):g} s to {round(span_s[1], 3):g} s of the recording"
    overview = rrb.TimeSeriesView(
        origin=ENVELOPE_ENTITY,
        name=f"{title}, {part}: envelopes",
        plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop),
        axis_x=axis,
    )
    phase_view = rrb.StateTimelineView(
        contents=["test", f"{OVERLOAD_ENTITY}/**"],
        name="test (gray: settling; green: measurement, decay; red: overload)",
        time_view=axis,
    )
    # The legend of the plot above is also valid for its quantity; here it would hide curves.
    curve_views = [
        _curve_view(entity, f"{title} around the cursor", cursor_range, has_legend=position > 0)
        for position, (entity, title) in enumerate(plots)
    ]
    right_column: list[rrb.View | rrb.Tabs] = [overview]
    right_column.append(curve_views[0] if len(curve_views) == 1 else rrb.Tabs(*curve_views, active_tab=0))
    if damper_count:
        right_column.append(
            _curve_view("dampers/gap_mm", "damper gap / mm around the cursor (truth)", cursor_range, True)
        )
        contacts = rrb.TimeSeriesView(
            origin="dampers/contact",
            name="contact of each damper (truth; yellow: flight, brown: floor, red: ceiling)",
            axis_y=rrb.ScalarAxis(range=(0.5, damper_count + 0.5)),
            plot_legend=rrb.PlotLegend(visible=False),
            time_ranges=rrb.VisibleTimeRange(TIMELINE, cursor_range),
        )
        right_column.append(contacts)
    notes = rrb.Tabs(
        rrb.Spatial2DView(origin="spectrum", name="spectrum"),
        rrb.TextDocumentView(origin="about", name="recording"),
        rrb.TextLogView(origin="markers", name="markers"),
        active_tab=0,
    )
    row_heights = [3.3, 3.9, 3.2, 0.8 + 0.6 * damper_count] if damper_count else [3.6, 4.5]
    panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, playback_speed=speed, loop_mode="all")
    position, target = camera
    rig = rrb.Spatial3DView(
        origin="rig",
        name="rig",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0, 0, 1)),
    )
    # The lanes of a state timeline have a fixed height, so the height of their view must grow with their number. The
    # rig ends at the same height as the second plot.
    left_column = rrb.Vertical(rig, phase_view, notes, row_shares=[1.5, 0.27 + 0.13 * overloaded_count, 0.94])
    return rrb.Blueprint(
        rrb.Horizontal(left_column, rrb.Vertical(*right_column, row_shares=row_heights), column_shares=[1.0, 1.35]),
        panel,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _curve_view(entity: str, title: str, cursor_range: rrb.TimeRange, has_legend: bool) -> rrb.TimeSeriesView:
    ranges = rrb.VisibleTimeRange(TIMELINE, cursor_range)
    legend = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=has_legend)
    return rrb.TimeSeriesView(origin=entity, name=title, time_ranges=ranges, plot_legend=legend)


def _cursor_range(before_s: float, after_s: float) -> rrb.TimeRange:
    start, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=time_s) for time_s in (-before_s, after_s))
    return rrb.TimeRange(start=start, end=end)
