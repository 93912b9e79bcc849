"""Outputs of the analysis commands: files, tables, figures and their captions."""

import csv
import dataclasses
import re
from contextlib import nullcontext
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from analysis.commands.figures.decay_figure import decay_figure
from analysis.commands.figures.determined_lines import determined_band, is_determined, is_smooth
from analysis.commands.figures.frf_figure import frf_figure
from analysis.commands.figures.modes_figure import modes_figure
from analysis.commands.figures.peak_marks import above_curves, drawn_response, peak_marks
from analysis.commands.presentation.backbone_findings import _draw as _draw_backbone
from analysis.commands.presentation.decay_findings import present_decay
from analysis.commands.presentation.fit_findings import present_fit
from analysis.commands.presentation.frf_findings import _draw_figures, describe_frfs, present_frf
from analysis.commands.presentation.mode_findings import describe_modes, theory_warnings
from analysis.commands.presentation.tables import modes_table
from analysis.commands.presentation.theory import theoretical_modes
from analysis.core.damper_motion.comparison import resonance_peaks
from analysis.core.modal.modes import Modes, UncertainMode
from analysis.core.modal_models.lscf import ChartPole
from analysis.core.recordings.descriptions import excitation_text
from analysis.core.recordings.names import baseline_label, belongs_to
from analysis.core.tracking.backbone import Backbone
from rig.core.base.errors import RecordingError
from rig.core.base.palette import BASELINE, BODIES, RECORDINGS, faded, recording_styles
from rig.core.results.response import Response
from tests.analysis.responses import synthetic

FREQUENCIES = np.linspace(8.0, 60.0, 53)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    synthetic.stepped_sine(folder / "one.mcap", FREQUENCIES, noise=1e-6, name="first scene")
    synthetic.stepped_sine(folder / "two.mcap", FREQUENCIES, noise=1e-6, seed=1, name="second scene")
    synthetic.impulses(folder / "hit.mcap", interval=3.0, name="hit scene")
    return folder


def read_rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.thorough
def test_figures_and_table_lie_next_to_recording(folder):
    result = present_frf([folder / "one.mcap"], theory=True)
    assert [path.name for path in result.files] == ["one-frf.png", "one-frf.svg", "one-frf.csv"]
    assert all(path.stat().st_size > 1000 for path in result.files)
    rows = read_rows(result.files[-1])
    assert len(rows) == 3 * FREQUENCIES.size
    assert rows[0]["scene"] == "first scene" and float(rows[0]["frequency_Hz"]) == 8.0
    assert {"real m/N", "imag m/N", "phase_deg", "coherence"} <= rows[0].keys()


@pytest.mark.thorough
@pytest.mark.usefixtures("undrawn_figures")
def test_two_recordings_share_one_figure(folder, tmp_path):
    result = present_frf([folder / "one.mcap", folder / "two.mcap"], tmp_path, ["body3"])
    assert [path.name for path in result.files] == ["one+two-frf.png", "one+two-frf.svg", "one+two-frf.csv"]
    svg_text = (tmp_path / "one+two-frf.svg").read_text(encoding="utf-8")
    assert "first scene" in svg_text and "second scene" in svg_text


@pytest.mark.thorough
@pytest.mark.usefixtures("undrawn_figures")
def test_overlaid_scenes_are_named_by_file(folder, tmp_path):
    synthetic.stepped_sine(tmp_path / "again.mcap", FREQUENCIES, noise=1e-6, seed=2, name="first scene")
    result = present_frf([folder / "one.mcap", tmp_path / "again.mcap"], tmp_path, ["body3", "body1"])
    assert [path.name for path in result.files if path.suffix == ".png"] == [
        f"one+again-frf-body{body}.png" for body in (3, 1)
    ]
    for body in (3, 1):
        svg_text = (tmp_path / f"one+again-frf-body{body}.svg").read_text(encoding="utf-8")
        assert svg_text.count(">one<") == svg_text.count(">again<") == 1
        # The title names the common scene.
        assert svg_text.count("first scene") == 1
    assert {row["scene"] for row in read_rows(result.files[-1])} == {"one", "again"}
    headings = [line for line in result.lines if not line.startswith((" ", "intervals"))]
    assert [line.split(",")[0] for line in headings] == ["one", "again"]


@pytest.mark.usefixtures("undrawn_figures")
def test_overlaid_decays_are_named_by_file(folder, tmp_path):
    synthetic.impulses(tmp_path / "again.mcap", interval=3.0, name="hit scene")
    result = present_decay([folder / "hit.mcap", tmp_path / "again.mcap"], tmp_path)
    svg_text = next(path for path in result.files if path.suffix == ".svg").read_text(encoding="utf-8")
    assert ">hit<" in svg_text and ">again<" in svg_text
    assert {row["scene"] for row in read_rows(result.files[-1])} == {"hit", "again"}
    assert sum(line.startswith("again, body3") for line in result.lines) == 1


@pytest.mark.usefixtures("undrawn_figures")
@pytest.mark.parametrize(("names", "count"), [(["hit"], 0), (["one"], 1), (["one", "hit"], 1)])
def test_only_stepped_tests_have_jump_marks(folder, tmp_path, monkeypatch, names, count):
    monkeypatch.setattr("analysis.commands.presentation.frf_findings.find_jumps", lambda _: [(20.0, "jump down")])
    present_frf([folder / f"{name}.mcap" for name in names], tmp_path, ["body3"])
    [path] = tmp_path.glob("*.svg")
    assert path.read_text(encoding="utf-8").count(">jump down<") == count


def test_error_for_force_channel_lists_motion_channels(folder):
    arguments = ["decay", str(folder / "hit.mcap"), "--channel", "hammer"]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, RecordingError)
    assert "measures force, not motion. Choose one of body1, body2, body3" in str(result.exception)


@pytest.mark.thorough
@pytest.mark.usefixtures("undrawn_figures")
def test_command_prints_results_and_names_of_files(folder, tmp_path):
    result = CliRunner().invoke(app, ["modes", str(folder / "one.mcap"), "-o", str(tmp_path)])
    assert result.exit_code == 0
    assert "13.03" in result.output and "wrote" in result.output
    assert (tmp_path / "one-modes.png").exists()


def test_error_for_missing_recording_suggests_record_command(tmp_path):
    with pytest.raises(RecordingError, match=r"no such file. Make one: `daq record SCENE -o"):
        present_frf([tmp_path / "none.mcap"])


def test_file_that_is_not_a_recording_is_rejected(tmp_path):
    (tmp_path / "no.mcap").write_bytes(b"\0" * 500)
    with pytest.raises(RecordingError):
        present_frf([tmp_path / "no.mcap"])


@pytest.mark.parametrize(
    ("natural", "remarks"),
    [
        (20.8, ["body1: the peak between", "body1: the half-power width at 20.8 Hz"]),
        (21.0, ["body1: the half-power width at 21 Hz"]),
        (40.0, ["body1: the highest point, at 29.5 Hz, is at the end of the band"]),
    ],
)
@pytest.mark.parametrize("motion", ["displacement", "acceleration"])
def test_peak_between_points_is_reported(natural, motion, remarks):
    f, ratio = np.arange(15.0, 30.0, 0.5), 0.005
    value = 1e-6 / (1.0 - (f / natural) ** 2 + 2j * ratio * f / natural)
    curve = Response.curve(f, value, "body1", error=1e-3 * abs(value), degrees_of_freedom=100.0 * np.ones(f.size)).to(
        motion
    )
    lines = describe_frfs([curve])[3:]
    assert [line.strip()[: len(text)] for line, text in zip(lines, remarks, strict=True)] == remarks
    if natural == 20.8:
        peak, bound = map(float, re.search(r"\(([\d.]+) ± ([\d.]+)\)", lines[0]).groups())
        exact = 1e-6 / (2.0 * ratio) * (1e6 if motion == "displacement" else (2.0 * np.pi * natural) ** 2)
        assert peak == pytest.approx(exact, abs=bound + 1e-3 * exact)
        assert "at 20.80 Hz, is" in lines[0]


def test_highest_of_all_resonances_is_reported():
    # The highest peak lies between two points; the highest point is at a different resonance.
    f = np.arange(20.4, 60.0, 0.8)
    value = sum(
        height * 2j * ratio / (1.0 - (f / fn) ** 2 + 2j * ratio * f / fn)
        for fn, ratio, height in ((30.4, 0.003, 72e-6), (48.0, 0.01, 55e-6))
    )
    curve = Response.curve(f, value, "board", error=1e-5 * abs(value), degrees_of_freedom=100.0 * np.ones(f.size))
    assert abs(curve.frequency[curve.peak_line()] - 48.0) < 0.5
    # Dampers may move between points that are far apart, so that the peak at 30.4 Hz has no value.
    [spacing] = describe_frfs([curve])[3:]
    assert "30.4 and 48 Hz has fewer than 3 points" in spacing and "Measure every 0.05 Hz there" in spacing


def test_jump_next_to_peak_needs_no_further_points():
    # A sweep up with a fold between 22 and 22.25 Hz.
    f = np.arange(20.0, 24.1, 0.25)
    before = [11.92, 12.95, 14.25, 15.66, 17.59, 19.77, 22.32, 25.16, 27.9]
    value = np.array([*before, 2.979, 2.859, 2.752, 2.658, 2.573, 2.498, 2.431, 2.371], dtype=complex)
    curve = Response.curve(f, value, "tray", error=1e-3 * abs(value), degrees_of_freedom=100.0 * np.ones(f.size))
    [remark] = describe_frfs([curve])[3:]
    assert "the response jumps near 22.12 Hz" in remark and "half-power width" not in remark


def test_highest_point_next_to_omitted_frequencies_is_reported():
    f = np.array([15.0, 16.0, 17.0, 18.0, 25.0, 26.0])
    curve = Response.curve(f, 1e-6 / (1.0 - (f / 20.0) ** 2 + 0.01j), "body1", omitted=np.arange(19.0, 25.0))
    assert "body1: the highest point, at 18 Hz, is next to omitted frequencies" in describe_frfs([curve])[3]


def test_omitted_frequencies_are_marked_as_a_range():
    f, omitted = np.array([15.0, 16.0, 18.0, 25.0]), np.array([17.0, 20.0, 19.0, 21.0])
    curve = Response.curve(f, 1e-6 / (1.0 - (f / 20.0) ** 2 + 0.01j), "body1", omitted=omitted)
    magnitude_axes = frf_figure([curve], "Receptance").axes[0]
    marked = [tuple(line.get_xdata()) for line in magnitude_axes.lines if not np.any(line.get_ydata())]
    assert marked == [(17.0, 17.0), (19.0, 21.0)]
    drawn = magnitude_axes.lines[-1]
    assert np.isnan(np.interp([17.0, 19.5], drawn.get_xdata(), drawn.get_ydata())).all()


def test_long_title_does_not_overlap_axes(folder):
    with daq.open(folder / "one.mcap") as rec:
        [curves] = analysis.frequency_responses(rec)
    figure = frf_figure(curves, "Receptance: " + "a scene of many words, " * 5)
    figure.canvas.draw()
    upper, _, lower = figure.axes
    legend_box, label_box = figure.legends[0].get_window_extent(), lower.xaxis.label.get_window_extent()
    assert upper._left_title.get_window_extent().x1 < figure.bbox.x1
    assert legend_box.y1 <= label_box.y0 and legend_box.y0 >= 0.0


@pytest.mark.parametrize(("error", "is_drawn"), [(0.01, True), (np.nan, False)])
def test_coherence_is_drawn_if_error_is_known(error, is_drawn):
    frequency = np.linspace(10.0, 20.0, 11)
    curve = Response.curve(
        frequency, np.ones(11, dtype=complex), "body3", error=np.full(11, error), coherence=np.full(11, 0.9)
    )
    axes = frf_figure([curve], "Compliance").axes[2]
    assert [line.get_ydata().tolist() for line in axes.lines] == ([[0.9] * 11] if is_drawn else [])
    assert bool(axes.texts) != is_drawn


@pytest.mark.parametrize(("coherence", "notes"), [(0.9, []), (0.01, ["phase not determined at any line"])])
def test_undetermined_phase_has_a_note(coherence, notes):
    ones = np.ones(11)
    curve = Response.curve(
        np.linspace(10.0, 20.0, 11), ones.astype(complex), "body3", error=0.01 * ones, coherence=coherence * ones
    )
    axes = frf_figure([curve], "Compliance").axes[1]
    assert [text.get_text() for text in axes.texts] == notes


def draw_curve(limit_m_per_n, omitted=()):
    """Draw a curve of 1 µm/N from 10 to 20 Hz with a standard uncertainty of 1 %; return the axes and the caption.

    `limit_m_per_n`: limit of a systematic error; `omitted`: frequencies without a value, Hz.
    """
    ones, value = np.ones(11), 1e-6
    curve = Response.curve(
        np.linspace(10.0, 20.0, 11), value * ones.astype(complex), "body3", error=0.01 * value * ones, coherence=ones,
        degrees_of_freedom=38.0 * ones, limits={"sensors' sensitivity": limit_m_per_n * ones},
        omitted=np.array(omitted), label="a scene",
    )  # fmt: skip
    figure = frf_figure([curve], "Compliance")
    return figure.axes[0], figure.legends[0].get_title().get_text()


def test_curve_is_interrupted_at_omitted_points():
    axes, caption = draw_curve(0.0, [14.5, 25.0])
    x, y = axes.lines[-1].get_data()
    assert np.isnan(y[x == 14.5]).all() and np.isfinite(y[x != 14.5][:-1]).all()
    assert axes.get_xlim() == (10.0, 25.0)
    assert [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "x"] == [14.5, 25.0]
    assert caption.replace("\n", " ").endswith("Gaps with a mark at the axis: omitted frequencies.")


def test_axis_contains_wide_bounds():
    axes, caption = draw_curve(0.8e-6)
    low, high = axes.get_ylim()
    assert high >= 1.8 and low <= 0.2 and "sensors' sensitivity" in caption.replace("\n", " ")


def test_axis_contains_antiresonance_between_points():
    f = np.linspace(8.0, 60.0, 120)
    value = 1.0 / (13.0**2 - f**2 + 0.03j * f) + 1.0 / (35.0**2 - f**2 + 0.03j * f)
    axes = frf_figure([Response.curve(f, value, "body1")], "Compliance").axes[0]
    drawn = np.concatenate([line.get_ydata() for line in axes.lines])
    assert np.nanmin(drawn) < 0.5e6 * abs(value).min() and axes.get_ylim()[0] < np.nanmin(drawn)


@pytest.mark.parametrize("limit", [2e-6, np.inf])
def test_undetermined_curve_is_pale_without_band(limit):
    axes, caption = draw_curve(limit)
    bands = [band for band in axes.collections if len(band.get_paths()) and band.get_alpha()]
    assert not bands and "undetermined" in caption
    assert {line.get_color() for line in axes.lines if np.isfinite(line.get_ydata()).any()} == {faded(BODIES[0])}


def test_many_undetermined_points_are_drawn():
    # Of a curve with this number of points, some points would have markers.
    ones = np.ones(200)
    curve = Response.curve(
        np.linspace(10.0, 20.0, 200), ones + 0j, "body3", error=0.01 * ones, limits={"clock": np.inf * ones},
        label="a scene",
    )  # fmt: skip
    figure = frf_figure([curve], "Compliance")
    figure.canvas.draw()
    assert "undetermined" in figure.legends[0].get_title().get_text()


def test_lines_between_gaps_are_undetermined():
    f = np.linspace(1.0, 100.0, 1000)
    is_noise = (f > 60.0) & (np.arange(f.size) % 10 < 4)
    coherence = np.where(is_noise | (abs(f - 30.0) < 0.1), 0.1, 1.0)
    magnitude = np.where(is_noise, 1e-9, 1e-6)
    curve = Response.curve(f, magnitude + 0j, "body1", error=1e-9 * magnitude, coherence=coherence)
    assert f[is_determined(curve)].min() == 1.0 and f[is_determined(curve)].max() == pytest.approx(60.0, abs=1.5)
    assert (~is_determined(curve)[f < 58.0]).sum() == 2
    assert frf_figure([curve], "Compliance").axes[0].get_ylim()[0] > 0.01


def test_levels_of_one_recording_are_short_in_legend(tmp_path):
    f = np.linspace(10.0, 20.0, 11)
    curves = [Response.curve(f, np.ones(11, dtype=complex), "body1", label=f"a scene, {n} N up") for n in (1, 2)]
    _draw_figures(curves, [], tmp_path / "held", "", {"a scene": "stepped sine, 1 to 2 N"})
    text = (tmp_path / "held.svg").read_text("utf-8")
    assert "1 N" in text and "1 N up" not in text and ": a scene" in text


def test_reference_is_gray_in_any_order(folder):
    [responses] = analysis.frf(folder / "one.mcap")
    curve = replace(responses.curves()[0], label="with")
    reference = baseline_label({"with": True, "without": False})
    curves = [curve, replace(curve, label="without")]
    styles = recording_styles([belongs_to(curve.label, reference) for curve in curves])
    axes = frf_figure(curves, "Compliance", styles=styles).axes[0]
    colors = {line.get_label(): line.get_color() for line in axes.lines}
    assert colors["without"] == BASELINE != colors["with"]


def text_of_two_levels(folder, scenes):
    f = np.linspace(10.0, 20.0, 11)
    curves = [Response.curve(f, np.ones(11, dtype=complex), "body1", label=name) for name in ("one", "two")]
    tests = {"one": "stepped sine, 1 N", "two": "stepped sine, 2 N"}
    _draw_figures(curves, [], folder / "both", "", tests, scenes=scenes)
    return (folder / "both.svg").read_text("utf-8")


def test_recordings_of_one_rig_are_named_by_level(tmp_path):
    text = text_of_two_levels(tmp_path, ["a scene"])
    assert ">2 N<" in text and ": a scene" in text and "two" not in text


def test_rigs_of_one_name_keep_their_labels(tmp_path):
    text = text_of_two_levels(tmp_path, ["a scene", "a scene"])
    assert "two" in text and ": a scene" not in text


def uncertain_jump(**settings):
    """Return tones of a sweep up with a fold next to the highest tone, 22 Hz, with an expanded uncertainty of 20 %."""
    f = np.arange(20.0, 24.1, 0.25)
    before = [11.92, 12.95, 14.25, 15.66, 17.59, 19.77, 22.32, 25.16, 27.9]
    value = np.array([*before, 2.979, 2.859, 2.752, 2.658, 2.573, 2.498, 2.431, 2.371], dtype=complex)
    curve = Response.curve(f, value, "tray", error=0.1 * abs(value), degrees_of_freedom=100.0 * np.ones(f.size))
    return replace(curve, **settings)


def test_peak_that_may_be_higher_has_a_bar():
    axes = frf_figure([uncertain_jump()], "Compliance").axes[0]
    [bars] = axes.containers
    centers = [segment.mean(axis=0) for segment in bars.lines[2][0].get_segments()]
    factor = uncertain_jump().shown_in[1]
    assert (22.0, pytest.approx(27.9 * factor)) in [tuple(center) for center in centers]


@pytest.mark.parametrize(("is_steady", "text"), [(True, "22.0 Hz"), (False, "(22.0 Hz)")])
def test_label_reports_missing_steady_state(is_steady, text):
    curve = uncertain_jump()
    curve = replace(curve, unsteady=(curve.frequency == 22.0) & (not is_steady))
    axes = frf_figure([curve], "Compliance").axes[0]
    [label] = [each for each in axes.texts if "Hz" in each.get_text()]
    assert label.get_text() == text


def test_model_line_stops_beside_an_arrow():
    curve = uncertain_jump()
    [arrow] = [mark for mark in peak_marks(curve, resonance_peaks(curve)) if mark.symbol == "arrows"]
    drawn = drawn_response(curve, [arrow])
    near = drawn.frequency[np.isfinite(drawn.value) & (abs(drawn.frequency - arrow.frequency) < 0.25)]
    assert near.tolist() == [arrow.frequency] and np.nanmax(drawn.magnitude) <= abs(curve.value).max()


def test_measured_frequency_has_three_digits():
    [arrow] = [
        mark for mark in peak_marks(uncertain_jump(), resonance_peaks(uncertain_jump())) if mark.symbol == "arrows"
    ]
    assert arrow._replace(peak=replace(arrow.peak, highest_frequency=24.0)).label == "22.0 Hz"


def test_arrow_begins_above_other_curves():
    curve = uncertain_jump()
    [arrow] = [mark for mark in peak_marks(curve, resonance_peaks(curve)) if mark.symbol == "arrows"]
    higher = replace(curve, value=2.0 * curve.value)
    [raised] = above_curves([arrow], [curve, higher])
    assert raised.top == pytest.approx(2.0 * 27.9) and raised.height == arrow.height


def phase_scatter():
    """Return a peak with three points in its half-power width, between which their phases determine no curve."""
    f = np.arange(20.0, 24.1, 0.25)
    value = np.exp(0.1j * (-1.0) ** np.arange(f.size)) / (22.1**2 - f**2 + 1.32j * f)
    return Response.curve(f, value, "tray", error=1e-3 * abs(value), degrees_of_freedom=100.0 * np.ones(f.size))


def test_undetermined_curve_is_no_lack_of_points():
    [remark] = describe_frfs([phase_scatter()])[3:]
    assert "the points at 22 Hz do not determine the curve" in remark and "fewer than" not in remark


@pytest.mark.parametrize(("spacing", "symbol"), [(np.inf, "points"), (0.1, "diamonds")])
@pytest.mark.parametrize("natural", [22.0, 22.02])
def test_unresolved_peaks_have_equal_symbols(natural, spacing, symbol):
    f = np.arange(20.0, 24.1, 0.05)
    curve = Response.curve(f, 1.0 / (natural**2 - f**2 + 1.32j * f), "tray")
    [(resonance, peak)] = resonance_peaks(curve)
    assert [mark.symbol for mark in peak_marks(curve, [(replace(resonance, needed_spacing=spacing), peak)])] == [symbol]


def test_peak_between_tones_has_a_marker():
    f = np.linspace(10.0, 30.0, 41)
    curve = Response.curve(
        f, 1e-6 / (1.0 - (f / 20.2) ** 2 + 0.02j), "body1", error=1e-12 * np.ones(41), coherence=np.ones(41)
    )
    axes = frf_figure([curve], "Compliance").axes[0]
    [marker] = [line for line in axes.lines if line.get_markerfacecolor() == "white"]
    assert marker.get_ydata()[0] == pytest.approx(50.0, rel=0.01)
    [drawn] = [line for line in axes.lines if line.get_xdata().size > f.size]
    assert np.nanmax(drawn.get_ydata()) == pytest.approx(50.0, rel=0.01)


def test_peak_at_a_tone_has_a_label_below_the_title():
    f = np.linspace(10.0, 30.0, 41)
    curve = Response.curve(
        f, 1e-6 / (1.0 - (f / 20.0) ** 2 + 0.2j), "body1", error=1e-12 * np.ones(41), coherence=np.ones(41)
    )
    figure = frf_figure([curve], "Compliance")
    figure.draw_without_rendering()
    axes = figure.axes[0]
    [label] = [text for text in axes.texts if text.get_text().endswith(" Hz")]
    assert label.get_text() == "20.00 Hz" and label.get_window_extent().y1 < axes.bbox.y1


def test_compared_peaks_have_labels_in_their_colors():
    f = np.linspace(10.0, 30.0, 41)
    exact = {"error": 1e-12 * np.ones(41), "coherence": np.ones(41)}
    curves = [
        Response.curve(f, 1e-6 / (1.0 - (f / natural) ** 2 + 2j * damping * f / natural), "body1", label=label, **exact)
        for natural, damping, label in ((20.2, 0.01, "bare"), (19.0, 0.06, "damped"))
    ]
    axes = frf_figure(curves, "Compliance", styles=recording_styles([True, False])).axes[0]
    labels = {text.get_text(): text.get_color() for text in axes.texts if text.get_text().endswith(" Hz")}
    assert labels == {"20.20 Hz": BASELINE, "19.00 Hz": RECORDINGS[0]}


def test_rough_phase_is_not_drawn():
    f = np.linspace(10.0, 110.0, 401)
    value = 1e-6 * np.exp(-1j * np.where(f < 60.0, 0.0, 40.0 * f))
    ones = np.ones(f.size)
    axes = frf_figure([Response.curve(f, value, "body1", error=1e-9 * ones, coherence=ones)], "Compliance").axes[1]
    shown = max(line.get_xdata()[np.isfinite(line.get_ydata())].max() for line in axes.lines)
    assert shown < 62.0


def test_figure_names_test_and_level(folder, tmp_path):
    with daq.open(folder / "one.mcap") as rec:
        text = excitation_text(rec)
    present_frf([folder / "one.mcap"], tmp_path)
    [figure] = tmp_path.glob("*.svg")
    assert text.endswith(" N") and text in figure.read_text("utf-8")


@pytest.mark.parametrize("count", [5, 6])
def test_titles_of_modes_are_separate(count):
    frequency, ratios = np.geomspace(10.0, 140.0, 200), np.full(count, 0.01)
    frequencies = np.array([20.54, 51.61, 81.117, 97.837, 115.513, 127.402])[:count]
    names = tuple(f"b{body}" for body in range(1, 6))
    poles = tuple(ChartPole(order, f, 0.01, True) for f in frequencies for order in range(5, 25))
    zeros = np.zeros(count)
    modes = Modes(
        frequency=frequencies, frequency_std=zeros, damping=ratios, damping_std=zeros,
        shape_std=np.zeros((5, count)), residue=-1e-3j * np.ones((5, count)), responses=names, chart=poles,
        lower=np.zeros(5), upper=np.zeros((5, 3)), model_error=0.0, label="", warnings=(),
    )  # fmt: skip
    ones = np.ones(frequency.size)
    curves = [
        Response.curve(frequency, value, name, coherence=ones, degrees_of_freedom=4.0 * ones)
        for name, value in zip(names, modes.receptance(frequency), strict=True)
    ]
    figure = modes_figure(curves, modes, "Modes: five bodies")
    uncertain = modes_figure(curves, replace(modes, shape_std=0.3 * np.eye(5)[:, [1] * count]), "Modes")
    assert [figure.axes[2].lines[0].get_alpha() for figure in (figure, uncertain)] == [1.0, 0.35]
    figure.canvas.draw()
    titles = [axes._left_title.get_window_extent() for axes in figure.axes[2:]]
    assert not any(first.overlaps(second) for first, second in combinations(titles, 2))
    assert max(title.x1 for title in titles) < figure.bbox.x1
    assert figure.legends[0].get_window_extent().y1 <= min(axes.get_window_extent().y0 for axes in figure.axes)


def test_uncertain_modes_are_in_text_table_and_diagram(folder, tmp_path):
    with daq.open(folder / "hit.mcap") as rec:
        [curves] = analysis.frequency_responses(rec)
    uncertain = UncertainMode(40.0, 0.1, 0.01, 0.001, "not identified from the even lines")
    modes = replace(analysis.identify(list(curves)), uncertain=(uncertain,))

    heading, *_, line = describe_modes(modes)
    [*_, row] = csv.DictReader(modes_table(tmp_path / "a.csv", [modes]).read_text("utf-8").splitlines())
    [*_, mark] = modes.plot_stabilization(Figure().subplots()).lines

    assert "uncertain: (40.00 ± 0.20) Hz" in modes.summary() and heading.endswith(", 1 uncertain")
    assert modes.table().rows[-1][-1] == uncertain.reason
    assert line.split(maxsplit=6) == ["40.00", "±", "0.20", "1.00", "±", "0.20", uncertain.reason]
    assert (row["mode"], row["frequency_Hz"], row["uncertain_because"]) == ("", "40", uncertain.reason)
    assert mark.get_label() == "uncertain mode" and mark.get_xdata()[0] == 40.0
    corrected = modes.without_exponential_window(10.0).uncertain[0]
    assert corrected.damping == pytest.approx(0.01 - 1.0 / (10.0 * 2 * np.pi * 40.0), rel=1e-3)


def test_title_has_range_of_differing_modes(folder):
    with daq.open(folder / "hit.mcap") as rec:
        decay = analysis.decay(rec)
    shifted_modes = [replace(mode, frequency=0.97 * mode.frequency) for mode in decay.modes]
    figure = decay_figure([decay, replace(decay, modes=tuple(shifted_modes))], "Free decay")
    titles = [axes.get_title(loc="left") for axes in figure.axes[2:]]
    assert titles == [
        f"mode at {shifted.frequency:.1f} to {mode.frequency:.1f} Hz"
        for mode, shifted in zip(decay.modes, shifted_modes, strict=True)
    ]


def test_decay_has_ring_at_the_stated_time(folder):
    with daq.open(folder / "hit.mcap") as rec:
        decay = analysis.decay(rec)
    _, peaks, ring, *_ = decay_figure([decay], "Free decay").axes[1].lines
    assert ring.get_xydata().tolist() == [[decay.quiet_from, decay.gravity]]
    np.testing.assert_array_equal(peaks.get_ydata(), decay.peak)


@pytest.mark.parametrize(("gravity", "is_named"), [(9.81, True), (1e-12, False)])
def test_caption_names_only_a_drawn_ring(folder, gravity, is_named):
    with daq.open(folder / "hit.mcap") as rec:
        decay = replace(analysis.decay(rec), gravity=gravity)
    figure = decay_figure([decay], "Free decay")
    texts = " ".join(text.get_text() for text in figure.findobj(Text))
    assert ("ring" in texts) == is_named == bool(np.isfinite(decay.quiet_from))


def test_damping_that_may_be_zero_is_a_limit(folder):
    with daq.open(folder / "hit.mcap") as rec:
        decay = analysis.decay(rec)
    [first, *others] = decay.modes
    uncertain = replace(first, damping_std=np.append(first.damping[:1], 0.0 * first.damping[1:]))
    figure = decay_figure([replace(decay, modes=(uncertain, *others))], "Free decay")
    [points, limit] = figure.axes[2].lines[:2]
    assert np.flatnonzero(np.isnan(points.get_ydata())).tolist() == [0]
    assert limit.get_ydata().tolist() == [pytest.approx(sum(uncertain.percent)[0])]


def test_decay_of_undetermined_damping_is_drawn(folder):
    with daq.open(folder / "hit.mcap") as rec:
        decay = analysis.decay(rec)
    uncertain = [replace(mode, damping_std=1e3 * mode.damping) for mode in decay.modes]
    low, high = decay_figure([replace(decay, modes=tuple(uncertain))], "Free decay").axes[2].get_ylim()
    assert 0.0 < low < high


def test_axis_of_constant_damping_has_distinct_labels(folder):
    with daq.open(folder / "hit.mcap") as rec:
        figure = decay_figure([analysis.decay(rec)], "Free decay")
    figure.canvas.draw()
    axes = figure.axes[2]
    low, high = axes.get_ylim()
    labels = [
        tick.get_text() for tick in axes.get_yticklabels() if tick.get_text() and low <= tick.get_position()[1] <= high
    ]
    assert len(labels) >= 3 and len(set(labels)) == len(labels)


def test_fit_command_reports_its_stages(folder, tmp_path, monkeypatch):
    stages = []
    monkeypatch.setattr("analysis.commands.presentation.fit_findings.show_activity", lambda: nullcontext(stages.append))
    output = tmp_path / "fitted.yaml"
    present_fit([folder / "one.mcap"], rig.load("bare-structure"), ["structure.masses"], output, False, print)
    assert stages == ["reading the recordings", "fitting the structure"]


def test_swapped_channels_are_reported():
    path = Path(__file__).parents[3] / "recordings" / "demo-sweep-no-damper.mcap"
    with daq.open(path) as rec:
        modes = analysis.identify(analysis.frfs(rec))
        theory = theoretical_modes(rec, modes)
    assert not theory_warnings(modes, theory) and not theory_warnings(modes, None)
    swapped = theory._replace(shapes=theory.shapes[[2, 1, 0]])
    (note,) = theory_warnings(modes, swapped)
    assert "49.66 Hz (MAC 0." in note and "channels are swapped" in note
    uncertain_shapes = replace(modes, shape_std=np.full(modes.shape_std.shape, np.inf))
    assert not theory_warnings(uncertain_shapes, swapped)
    # With a wrong sign, a shape can be that of a distant mode.
    (note,) = theory_warnings(modes, theory._replace(shapes=theory.shapes[:, [1, 0, 2]]))
    assert "13.04 Hz" in note and "34.78 Hz" in note and "49.66" not in note


# Natural frequencies of the bare structure, Hz.
BARE_FREQUENCIES = np.array([13.04, 34.78, 49.66])


def test_placeholder_structure_is_not_compared(monkeypatch, tmp_path):
    path = Path(__file__).parents[3] / "recordings" / "demo-sweep-no-damper.mcap"
    theory = "analysis.commands.presentation.theory.theoretical_modes"
    for scale, compared in ((1.0, True), (0.1, False)):
        monkeypatch.setattr(
            theory,
            lambda rec, modes, scale=scale: theoretical_modes(rec, modes)._replace(frequency=scale * BARE_FREQUENCIES),
        )
        result = CliRunner().invoke(app, ["modes", str(path), "-o", str(tmp_path), "--overwrite"])
        assert ("MAC with scene" in result.output, "not compared" in result.output) == (compared, not compared)


def test_combination_frequency_is_no_swapped_channel():
    path = Path(__file__).parents[3] / "recordings" / "demo-sweep-no-damper.mcap"
    with daq.open(path) as rec:
        modes = analysis.identify(analysis.frfs(rec))
        theory = theoretical_modes(rec, modes)
    first, second, _ = modes.frequency
    combined = replace(modes, frequency=np.array([first, second, first + second]))
    other_shape = theory._replace(shapes=theory.shapes[:, [0, 1, 1]])
    (linear,) = theory_warnings(combined, other_shape)
    (nonlinear,) = theory_warnings(replace(combined, model_error=0.1), other_shape)
    assert "channels are swapped" in linear
    assert nonlinear.startswith("47.81 Hz (about 13.04 + 34.78 Hz): probably harmonics or combination frequencies")


def test_curve_that_folds_back_has_no_line() -> None:
    frequency, value = np.array([12.0, 11.0, 10.0, 11.5, 11.8]), np.linspace(1.0, 2.0, 5) + 0j
    figure = frf_figure([Response.curve(frequency, value, "body1", error=np.full(5, 0.01))], "fold")
    magnitude, phase, _ = figure.axes
    assert {line.get_linestyle() for axes in (magnitude, phase) for line in axes.lines} == {"None"}
    assert not magnitude.collections and not phase.collections


def test_spectrum_ends_at_determined_lines() -> None:
    frequency = np.linspace(1.0, 100.0, 991)
    error = np.where(frequency < 60.0, 0.01, 2.0)
    curve = Response.curve(frequency, np.ones(991) + 0j, "body1", error=error)
    assert determined_band([curve]) == (1.0, pytest.approx(60.0, abs=2.5))


def test_phase_has_no_islands_in_noise() -> None:
    generator = np.random.default_rng(1)
    angle = generator.uniform(-np.pi, np.pi, 1200)
    angle[:300], angle[700:740] = 0.0, 0.0
    is_drawn = is_smooth(Response.curve(np.linspace(1.0, 100.0, 1200), np.exp(1j * angle), "body1"))
    assert is_drawn[:280].all() and not is_drawn[350:].any()


def test_phase_axis_is_common_to_figures_of_compliances() -> None:
    f = np.linspace(8.0, 60.0, 400)
    # The phase beyond the second mode is -360°.
    value = 1.0 / ((13.0**2 - f**2 + 0.5j * f) * (35.0**2 - f**2 + 1.0j * f))
    _, phase_axes, _ = frf_figure([Response.curve(f, value, "body2")], "").axes
    assert phase_axes.get_yticks().tolist() == [-270.0, -180.0, -90.0, 0.0]


@pytest.mark.parametrize(("frequencies", "sides"), [([48.0, 49.0, 49.2], "rrl"), ([49.2, 49.0, 48.0], "llr")])
def test_labels_of_levels_avoid_the_next_point(frequencies, sides) -> None:
    values = np.array([1.0, 2.0, 3.0])
    points = SimpleNamespace(
        body="body1", label="", frequency=np.array(frequencies), amplitude=values, amplitude_own=0.1 * values,
        frequency_expanded=0.0 * values, frequency_name="",
        marks=lambda: [(f, 1.0, "1 N") for f in frequencies],
    )  # fmt: skip
    axes = Figure().add_subplot()
    Backbone.draw(points, axes)  # type: ignore[arg-type]
    assert "".join(text.get_ha()[0] for text in axes.texts) == sides


@pytest.mark.parametrize(("known", "name"), [(50.1, "natural frequency / Hz"), (np.nan, "excitation frequency / Hz")])
def test_backbone_figure_has_natural_frequencies(known, name) -> None:
    ones = np.ones(2)
    fields = {field.name: ones for field in dataclasses.fields(Backbone)}
    fields |= {"label": "", "body": "body 1", "unit": "N", "frequency": 50.0 * ones, "natural_frequency": known * ones}
    figure = Figure()
    axes = figure.add_subplot()
    _draw_backbone(Backbone(**(fields | {"amplitude_own": 0.5 * ones})), figure, axes)
    [gray] = [each for each in axes.collections if each.get_linewidth() == 5.0]
    assert axes.get_xlabel() == name and np.ptp(gray.get_segments()[0][:, 1]) == pytest.approx(2e3)


def test_gaps_do_not_change_determined_lines():
    f = np.linspace(10.0, 40.0, 121)
    value = 1e-6 / (1.0 - (f / 25.0) ** 2 + 0.02j)
    noise = {"error": 0.01 * abs(value), "degrees_of_freedom": np.full(f.size, 9.0)}
    curve = Response.curve(f, value, "body1", coherence=np.where(f < 20.0, 0.3, 1.0), omitted=np.array([30.1]), **noise)
    gap, known = f.searchsorted(30.1), is_determined(curve)
    assert known.tolist() == (f >= 20.0).tolist()
    assert is_determined(curve.with_gaps()).tolist() == np.insert(known, gap, False).tolist()
