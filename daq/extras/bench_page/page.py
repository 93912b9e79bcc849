"""The web page of `daq bench`: controls, live charts, the moving rig, hits and NI clients."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
from nicegui import ui

from daq.core.drawing.palette import channel_color, hex_color
from daq.extras.bench_page.monitor import MOTION_S, OVERLOAD_HOLD_S
from daq.extras.bench_page.rig_svg import RigDrawing
from rig.core.base.arrays import Array

if TYPE_CHECKING:
    from daq.extras.bench_page.live_bench import LiveBench


# Intervals at which charts and frequency responses are refreshed, s.
_CHART_INTERVAL_S = 0.25
_FRF_INTERVAL_S = 0.5
# Duration of the animation, s. It shows the last `MOTION_S` seconds in slow motion.
_ANIMATION_S = 2.0
# Minimum number of columns of a time history; each shows its minimum and maximum.
_HISTORY_COLUMNS = 300
# Maximum number of frequency bands of a drawn spectrum; each shows its largest line.
_SPECTRUM_BANDS = 600
# Maximum number of listed hits.
_MAX_LISTED_HITS = 8
_TEXT_COLOR = "#c8ccd2"
_GRID = {"lineStyle": {"color": "#2c3037"}}
# JavaScript function that formats the numbers at an axis.
_NUMBER_FORMAT = (
    "v => v && (Math.abs(v) < 1e-3 || Math.abs(v) >= 1e5) ? (+v.toPrecision(3)).toExponential() : +v.toPrecision(5)"
)
# Colors of the overload lamp of a channel.
_LAMP_OFF = "#3a3f47"
_LAMP_ON = "#e0403a"

# Script that moves the parts of the drawing through frames in a given time, and shows the last frame until new frames
# arrive. The frames are {identifier: [heights, scales]}; the scales stretch springs, and are null for other parts.
_ANIMATION = """
<script>
let rigFrames = {}, rigStart = 0, rigTime = 1;
function moveRig(frames, seconds) { rigFrames = frames; rigStart = performance.now(); rigTime = 1000 * seconds; }
function drawRig(now) {
  for (const [name, [heights, scales]] of Object.entries(rigFrames)) {
    const part = document.getElementById(name);
    if (!part) continue;
    const frame = Math.min(heights.length - 1, Math.floor((now - rigStart) / rigTime * heights.length));
    const index = Math.max(0, frame);
    part.setAttribute('transform',
      `translate(0 ${heights[index]})` + (scales ? ` scale(1 ${scales[index]})` : ''));
  }
  requestAnimationFrame(drawRig);
}
requestAnimationFrame(drawRig);
</script>
<style>#rig {width: 100%; max-height: 380px} .nicegui-content {padding: 10px}</style>
"""


def min_max_envelope(time: Array, values: Array, columns: int) -> tuple[Array, Array]:
    """Reduce samples to the minimum and maximum in each column; return the times and values of these.

    There are at least `columns` columns. The first samples, if they do not fill a column, are omitted.

    >>> [each.tolist() for each in min_max_envelope(np.arange(4.0), np.array([1.0, 3.0, 2.0, 0.0]), 2)]
    [[0.0, 1.0, 2.0, 3.0], [1.0, 3.0, 2.0, 0.0]]
    >>> min_max_envelope(np.arange(5.0), np.array([1.0, 3.0, 2.0, 0.0, 7.0]), 2)[1].tolist()
    [3.0, 2.0, 0.0, 7.0]
    """
    samples_per_column = max(1, values.size // columns)
    first = values.size % samples_per_column
    columns_of_samples = values[first:].reshape(-1, samples_per_column)
    start = first + samples_per_column * np.arange(len(columns_of_samples))
    indices = np.sort(
        np.column_stack([columns_of_samples.argmin(axis=1) + start, columns_of_samples.argmax(axis=1) + start]), axis=1
    ).ravel()
    return time[indices], values[indices]


def chart_points(x: Array, y: Array) -> list[list[float]]:
    """Return the finite points [x, y] of a curve for the chart library, rounded to 10 (x) and 4 (y) digits."""
    pairs = zip(x.tolist(), y.tolist(), strict=True)
    return [[float(f"{a:.10g}"), float(f"{b:.4g}")] for a, b in pairs if np.isfinite(b)]


def band_peaks(frequency: Array, values: Array) -> tuple[Array, Array]:
    """Reduce a spectrum to the largest line in each of `_SPECTRUM_BANDS` - 1 bands of equal frequency ratio.

    Returns frequencies and values of these lines, and of the last line.

    >>> band_peaks(np.array([1.0, 2.0, 4.0]), np.array([3.0, 5.0, 4.0]))[1].tolist()
    [3.0, 5.0, 4.0]
    """
    edges = np.geomspace(frequency[0], frequency[-1], _SPECTRUM_BANDS)
    starts = np.unique(np.searchsorted(frequency, edges[:-1]))
    stops = [*starts[1:].tolist(), frequency.size]
    indices = [a + int(np.argmax(values[a:b])) for a, b in zip(starts.tolist(), stops, strict=True)]
    indices += [] if indices[-1] == frequency.size - 1 else [frequency.size - 1]
    return frequency[indices], values[indices]


class Chart:
    """A line chart with a curve for each of `series` (name, unit, color), and a y axis for each unit.

    `x_axis` and `y_axis` are settings for the chart library (ECharts).
    """

    def __init__(
        self, title: str, x_axis: dict[str, Any], series: list[tuple[str, str, str]], y_axis: dict[str, Any]
    ) -> None:
        units = list(dict.fromkeys(unit for _, unit, _ in series)) or [""]
        axes = [
            {"type": "value", "name": unit, "scale": True, "position": "right" if axis_index else "left",
             "splitLine": _GRID if not axis_index else {"show": False}, "axisLabel": {":formatter": _NUMBER_FORMAT},
             **y_axis}
            for axis_index, unit in enumerate(units)
        ]  # fmt: skip
        self.element = ui.echart(
            {
                "animation": False,
                "textStyle": {"color": _TEXT_COLOR},
                "title": {"text": title, "textStyle": {"fontSize": 13, "color": _TEXT_COLOR}},
                "legend": {"right": 10, "top": 0, "icon": "rect", "textStyle": {"color": _TEXT_COLOR}},
                "tooltip": {"trigger": "axis"},
                "grid": {"left": 70, "right": 70, "top": 42, "bottom": 40},
                "toolbox": {"feature": {"dataZoom": {}}, "top": 18, "right": 80, "itemSize": 13},
                "xAxis": {"type": "value", "nameLocation": "middle", "nameGap": 24, "min": "dataMin",
                          "max": "dataMax", "splitLine": _GRID,
                          "axisLabel": {":formatter": _NUMBER_FORMAT, "hideOverlap": True}, **x_axis},
                "yAxis": axes,
                "series": [
                    {"name": name, "type": "line", "showSymbol": False, "yAxisIndex": units.index(unit),
                     "lineStyle": {"width": 1.3}, "color": color, "data": []}
                    for name, unit, color in series
                ],
            }
        ).classes("w-full h-56")  # fmt: skip

    def show(self, curves: list[list[list[float]]]) -> None:
        """Show the points (x, y) of all series."""
        for series, data in zip(self.element.options["series"], curves, strict=True):
            # NiceGUI would observe each point of a list for changes; it sends a tuple as it is.
            series["data"] = tuple(data)
        self.element.update()

    def clear(self) -> None:
        """Remove the points of all series."""
        self.show([[] for _ in self.element.options["series"]])


class Page:
    """The view of the bench in one browser."""

    def __init__(self, bench: LiveBench) -> None:
        self._bench, self._monitor, self._controller = bench, bench.monitor, bench.controller
        scene = bench.chassis.bench.scene
        self._rig, self._shown_svg = RigDrawing(scene), ""
        ui.dark_mode(True)
        ui.page_title(f"daq bench: {scene.name}")
        ui.add_body_html(_ANIMATION)
        with ui.row().classes("w-full items-center"):
            ui.label(scene.name).classes("text-lg font-bold")
            ui.label(f"NI clients: {bench.address}").classes("text-sm opacity-70")
            self._lamps = [
                ui.label(info.name).classes("px-2 rounded").tooltip(f"Lit for {OVERLOAD_HOLD_S:g} s after an overload")
                for info in self._monitor.channels
            ]
        with ui.row().classes("w-full no-wrap items-start"):
            with ui.column().classes("w-72 shrink-0"):
                self._add_controls()
                self._drawing = ui.html("", sanitize=False).classes("w-full")
                ui.label(f"slowed down {_ANIMATION_S / MOTION_S:g} times").classes("text-xs opacity-70")
            with ui.column().classes("grow min-w-0"):
                self._add_charts()
        ui.timer(_CHART_INTERVAL_S, self._refresh)
        ui.timer(_FRF_INTERVAL_S, self._refresh_frf)
        ui.timer(_ANIMATION_S, self._refresh_rig)

    def _add_controls(self) -> None:
        controller, settings = self._controller, self._controller.settings

        def field(label: str, name: str) -> None:
            """Add a number field for the setting `name`, visible for the tests whose form has it."""
            titles = {title for title, each in controller.forms.items() if each.form and name in each.form.fields}
            number = ui.number(label, on_change=controller.apply_settings).bind_value(settings, name)
            number.classes("w-full").props(f"dense data-testid={name}")
            number.bind_visibility_from(settings, "kind", lambda kind: kind in titles)

        tests = ui.select(list(controller.forms), label="Test").bind_value(settings, "kind")
        tests.classes("w-full").props("dense")
        field("Level / N (random: rms, hammer: peak)", "level")
        field("Frequency / Hz", "frequency")
        field("From / Hz", "low")
        field("To / Hz", "high")
        field("Duration / s", "duration")
        field("Time between hits / s", "interval")
        field("Number of hits", "hits")
        with ui.row():
            ui.button("Start", on_click=controller.start).props("data-testid=start")
            ui.button("Stop", on_click=controller.stop, color="gray").props("data-testid=stop")
        recordings = self._bench.recordings
        ui.switch("Record").bind_value(recordings, "enabled").props("data-testid=record")
        self._state_label = ui.label().classes("text-sm").props("data-testid=state")
        self._output_label = ui.label().classes("text-sm").props("data-testid=output")
        self._file_label = ui.label().classes("text-sm break-words").props("data-testid=file")
        self._clients_label = ui.label().classes("text-sm whitespace-pre-line").props("data-testid=clients")

    def _add_charts(self) -> None:
        channels = self._monitor.channels
        series = [(info.name, info.unit, hex_color(channel_color(info.at))) for info in channels]
        with ui.row().classes("items-center"):
            ui.label("Time shown / s")
            self._span_toggle = ui.toggle([0.1, 1.0, 5.0], value=1.0).props("dense")
        self._time = Chart("Time histories", {"name": "time / s"}, series, {})
        log_axis = {"type": "log", "min": None}
        self._spectra = Chart(
            "Amplitude spectra (2 s, Hann)",
            {"name": "frequency / Hz", "type": "log"},
            series,
            {"type": "log", "scale": True},
        )
        bodies = [
            (info.name, "m/N", hex_color(channel_color(info.at)))
            for info in channels
            if info.body and info.quantity != "force"
        ]
        # A hammer excites all modes, a sweep or random test a band.
        frequency_axis = {"name": "frequency / Hz", "type": "log" if self._controller.has_hammer else "value"}
        # Its title is set by `_refresh_frf`.
        self._frf = Chart("", frequency_axis, bodies, log_axis)
        self._coherence = Chart("Coherence", frequency_axis, [(n, "", c) for n, _, c in bodies], {"min": 0, "max": 1})
        self._coherence.element.classes(replace="w-full h-40")
        if self._controller.has_hammer:
            self._hit_chart = Chart("Last hits", {"name": "time / ms"}, [("force", "N", "#f0f0f0")], {})
            self._hit_list = ui.column().classes("w-full")
        # Number of detected hits, and of accepted hits in the list, at the last update of the list.
        self._listed_counts: tuple[int, int] = (-1, -1)

    def _refresh(self) -> None:
        monitor, controller, recordings = self._monitor, self._controller, self._bench.recordings
        for lamp, lit in zip(self._lamps, monitor.overloads(), strict=True):
            lamp.style(f"background: {_LAMP_ON if lit else _LAMP_OFF}")
        samples = monitor.history.last(round(float(self._span_toggle.value) * monitor.rate))
        time = (monitor.history.stop - samples.shape[1] + np.arange(samples.shape[1])) / monitor.rate
        self._time.show([chart_points(*min_max_envelope(time, row, _HISTORY_COLUMNS)) for row in samples])
        frequency, spectra = monitor.spectra()
        self._spectra.show([chart_points(*band_peaks(frequency[1:], row[1:])) for row in np.maximum(spectra, 1e-15)])
        self._state_label.text = "\n".join([controller.message, *self._bench.chassis.problems[-1:]])
        self._output_label.text = "\n".join(self._bench.outputs())
        self._file_label.text = recordings.problem or _recording_line(recordings)
        self._clients_label.text = self._bench.clients()
        if controller.has_hammer:
            self._show_hits()

    def _refresh_frf(self) -> None:
        frf = self._monitor.frf
        curves = None if frf is None else frf.curves()
        chart = self._frf.element.options
        if curves is None:
            title = f"Frequency response ({self._controller.frf_unavailable_reason or 'starts with a test'})"
            if chart["title"]["text"] != title:
                chart["title"]["text"] = title
                # The curves of the last test must not be shown for the next test.
                self._frf.clear()
                self._coherence.clear()
            return
        chart["title"]["text"] = f"Frequency response, H1, {curves.averages} averages"
        self._frf.show([chart_points(curves.frequency, np.abs(row)) for row in curves.value])
        self._coherence.show([chart_points(curves.frequency, row) for row in curves.coherence])

    def _show_hits(self) -> None:
        detector = self._monitor.detector
        hits = [] if detector is None else detector.hits[-_MAX_LISTED_HITS:]
        counts = (len(detector.hits) if detector else 0, sum(hit.accepted for hit in hits))
        if counts == self._listed_counts:
            return
        self._listed_counts = counts
        if hits:
            force = hits[-1].force
            self._hit_chart.show([chart_points(1e3 * np.arange(float(force.size)) / self._monitor.rate, force)])
        self._hit_list.clear()
        with self._hit_list:
            for hit in reversed(hits):
                with ui.row().classes("items-center"):
                    ui.switch("accepted").bind_value(hit, "accepted").props("dense")
                    ui.label(f"hit {hit.number}: {hit.peak:.4g} N, {', '.join(hit.faults) or 'good'}")

    def _refresh_rig(self) -> None:
        motion = self._monitor.motion()
        if motion is None:
            return
        frames = self._rig.frames(motion)
        if self._rig.svg != self._shown_svg:
            self._shown_svg = self._rig.svg
            self._drawing.set_content(self._shown_svg)
        ui.run_javascript(f"moveRig({json.dumps(frames)}, {_ANIMATION_S})")


def _recording_line(recordings: Any) -> str:
    if recordings.running:
        return f"recording to {recordings.paths[-1]}"
    if recordings.enabled:
        return "records as soon as a test or a client's task runs"
    return f"recorded: {recordings.paths[-1]}" if recordings.paths else "not recording"
