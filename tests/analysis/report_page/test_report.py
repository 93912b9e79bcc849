"""`analysis report`: the page's summary, sections and charts, without a network and in a browser."""

import csv
import re
import shutil
import subprocess
from dataclasses import replace
from importlib.resources import files
from math import inf
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

import analysis
import daq
import rig
from analysis.commands.figures.peak_marks import PEAK_SYMBOLS, PeakMark, peak_marks
from analysis.commands.presentation import frf_findings
from analysis.commands.presentation.comparison import change_table, describe_changes
from analysis.commands.presentation.damper_findings import describe_motions
from analysis.commands.presentation.frf_findings import describe_frfs
from analysis.commands.presentation.mode_findings import describe_modes
from analysis.commands.presentation.tables import modes_table
from analysis.commands.report_page.charts import Chart, ChartWriter, Curve, EvenlySpaced, Panel, Strip
from analysis.commands.report_page.dampers import damper_charts
from analysis.commands.report_page.decays import decay_charts
from analysis.commands.report_page.drawing import rig_drawing
from analysis.commands.report_page.histories import time_histories
from analysis.commands.report_page.levels import _highest_maximum, level_headline
from analysis.commands.report_page.measurements import Measurement, Measurements, highest_peak
from analysis.commands.report_page.mode_drawing import mode_drawing
from analysis.commands.report_page.report import page_title, write_report
from analysis.commands.report_page.responses import force_charts, response_chart, response_charts
from analysis.commands.report_page.stabilization import stabilization_charts
from analysis.commands.report_page.summary import limitations, summarize
from analysis.commands.report_page.sweep_changes import SweepChange
from analysis.commands.report_page.tables import change_text, changes_table, mac_table, motions, resonances
from analysis.commands.report_page.tables import test_sentence as sentence_of
from analysis.core.damper_motion.comparison import Peak, PeakChange, local_model, resonance_peak, resonance_peaks
from analysis.core.damper_motion.motion_types import DamperMotion, motion_table
from analysis.core.modal.mode_warnings import extrapolates_damping
from analysis.core.modal.modes import BodyShapes, Modes, UncertainMode
from analysis.core.tracking.body_motion import LevelPoint
from daq.core.recording.markers import Marker
from rig.core.base.palette import HAMMER, TABLE
from rig.core.results import format_interval
from rig.core.results.response import Response
from rig.core.results.uncertainty import SENSITIVITY, expand
from tests.analysis.responses import synthetic

FREQUENCIES = np.linspace(8.0, 60.0, 53)
BROWSER = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chrome")
in_browser = pytest.mark.skipif(BROWSER is None, reason="needs chromium or chrome")


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("recordings")
    synthetic.stepped_sine(folder / "sweep.mcap", FREQUENCIES, noise=1e-6, name="first scene")
    synthetic.impulses(folder / "hit.mcap", interval=3.0, name="hit scene")
    return [folder / "sweep.mcap", folder / "hit.mcap"]


@pytest.fixture(scope="module")
def page(recordings: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    [page] = write_report(recordings, tmp_path_factory.mktemp("page")).files
    return page


def text_of(page: Path) -> str:
    """Return the text of a page with ordinary spaces."""
    return page.read_text("utf-8").replace("\u00a0", " ")


def browse(page: Path, tmp_path: Path, *options: str) -> str:
    """Open a page in a headless browser and return its standard output; fail if the page logs an error."""
    assert BROWSER is not None
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
        f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000", "--enable-logging=stderr", *options,
        page.as_uri(),
    ]  # fmt: skip
    run = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert "CONSOLE" not in run.stderr
    return run.stdout


def test_page_needs_no_network(page: Path) -> None:
    text = page.read_text("utf-8")
    assert not re.search(r"(src|href)=\"(?!#)|url\(|@import", text)
    assert page.stat().st_size < 2e6


def test_title_states_that_recordings_are_simulated(recordings: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    with Measurements(recordings) as measurements:
        assert page_title(measurements).startswith("Simulated vibration test: ")
        monkeypatch.setitem(measurements.results[0].rec.metadata["run"], "source", "bench.csv")
        assert page_title(measurements).startswith("Simulated vibration test (partly measured): ")
        monkeypatch.setitem(measurements.results[1].rec.metadata["run"], "source", "bench.csv")
        assert page_title(measurements).startswith("Vibration test: ")


def test_page_contains_answer_settings_and_commands(recordings: list[Path], tmp_path: Path) -> None:
    text = text_of(write_report(recordings[:1], tmp_path).files[0])
    answer = text[text.index("<main>") : text.index("<nav>")]
    assert "first scene" in answer and "13.04" in answer and "µm/N" in answer
    for part in (
        "Stabilization diagram of",
        "Uncertainty budget",
        "sensitivity",
        "Spectrogram of body1",
        "analysis report",
        "Scene file",
    ):
        assert part in text
    assert "Sine, 10 Hz, 1 N, 2 s" in answer and "daq record sweep.yaml -o" in text


def test_highest_peak_is_reported_without_modes(recordings: list[Path]) -> None:
    [responses] = analysis.frf(recordings[0])
    highest = highest_peak([(curve, resonance_peaks(curve)) for curve in responses.curves()])
    assert highest is not None
    # First natural frequency 13.04 Hz; the points are 1 Hz apart.
    assert highest[1].frequency == pytest.approx(13.0, abs=0.1)


def test_peak_of_report_equals_peak_of_frf(recordings: list[Path]) -> None:
    [responses] = analysis.frf(recordings[0])
    # Without the first mode, whose half-power width has too few points for an upper bound of its peak.
    curve = responses.curves()[0].band(20.0, 60.0)
    value = abs(curve.value)
    # The tolerances of several reference channels have the largest effect at the resonance.
    curve = curve.with_limits({SENSITIVITY: np.where(value > 0.5 * value.max(), 5.0, 0.1) * value})
    highest = highest_peak([(curve, resonance_peaks(curve))])
    assert highest is not None
    [text] = [line for line in describe_frfs([curve]) if "the peak between the points" in line]
    assert highest[1].height_text(curve.shown_in[1], "µm/N") in text


def test_frf_prints_asymmetric_interval_of_peak(recordings: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    curve = analysis.frf(recordings[0])[0].curves()[0].band(20.0, 60.0)
    [(resonance, _), *_] = frf_findings.resonance_peaks(curve)
    # The highest measured point is a lower limit of the peak.
    found = Peak(2.11e-2, 3.4e-3, 33.6, 33.3, 33.9, lower_limit=2.09e-2, interpolation_expanded=1e-4)
    monkeypatch.setattr(frf_findings, "resonance_peaks", lambda _: [(resonance, found)])
    assert any("at 33.6 Hz, is 21100 (20900 to 24500) µm/N" in line for line in describe_frfs([curve]))


def test_summary_without_modes_states_the_response(recordings: list[Path]) -> None:
    with Measurements(recordings[:1]) as measurements:
        [measurement] = measurements.results
        [sweep] = measurement.sweeps
        [sentence] = summarize([replace(measurement, sweeps=(replace(sweep, modes=None),))], [])
    assert "compliance" in sentence and "largest contribution" in sentence


def test_peak_without_determined_height_has_no_value(recordings: list[Path]) -> None:
    [responses] = analysis.frf(recordings[0])
    curve = responses.curves()[0]
    with Measurements(recordings[:1]) as measurements:
        [measurement] = measurements.results
        [sweep] = measurement.sweeps
        peak = Peak(1e-3, 2e-3, 13.0, 12.9, 13.1)
        [sentence] = summarize([replace(measurement, sweeps=(replace(sweep, highest=(curve, peak)),))], [])
    assert "highest compliance: not determined (" in sentence and "µm/N" not in sentence


def test_modes_have_equal_digits_in_all_outputs(recordings: list[Path], tmp_path: Path) -> None:
    with Measurements(recordings[:1]) as measurements:
        [measurement] = measurements.results
        modes = measurement.sweeps[0].modes
        assert modes is not None
        headline = " ".join(summarize([measurement], []))
    rows = csv.DictReader(modes_table(tmp_path / "modes.csv", [modes]).read_text("utf-8").splitlines())
    lines = describe_modes(modes)[2:]
    for k, (row, line) in enumerate(zip(rows, lines, strict=True)):
        bounds = expand(np.array([modes.frequency_std[k], 100.0 * modes.damping_std[k]]))
        values = float(row["frequency_Hz"]), 100.0 * float(row["damping_ratio"])
        texts = [format_interval(*pair) for pair in zip(values, bounds.tolist(), strict=True)]
        assert all(text in headline and text in line for text in texts)


@pytest.mark.thorough
def test_answer_states_detection_limits_of_impacts() -> None:
    recording = Path(__file__).parents[3] / "recordings" / "demo-sweep-three-dampers.mcap"
    with Measurements([recording]) as measurements:
        [measurement] = measurements.results
        [sentence] = [text for text in summarize([measurement], []) if "damper impacts" in text]
        [dampers] = measurement.dampers
        limits = describe_motions(dampers.bodies)[-1].removesuffix(" are not detected.").partition("below ")[2]
    assert f"below {limits} are not detectable" in sentence and "mm/s (body1)" in limits


@pytest.mark.thorough
def test_share_names_impacts_below_detection_limit() -> None:
    recording = Path(__file__).parents[3] / "recordings" / "demo-sweep-three-dampers.mcap"
    with Measurements([recording]) as measurements:
        [measurement] = measurements.results
        [sentence] = [text for text in summarize([measurement], []) if "damper impacts" in text]
        [dampers] = measurement.dampers
    place = re.search(r"\(at ([\d.]+) Hz, where the impacts are below the detection limit\)", sentence)
    assert place is not None
    at_place = [each for body in dampers.bodies for each in body if f"{each.frequency:.4g}" == place[1]]
    assert len(at_place) == 3 and not any(each.floor or each.ceiling for each in at_place)


@pytest.mark.thorough
def test_undetermined_energy_is_an_upper_limit() -> None:
    recording = Path(__file__).parents[3] / "recordings" / "demo-sweep-three-dampers.mcap"
    with Measurements([recording]) as measurements:
        [measurement] = measurements.results
        [chart] = damper_charts(measurement)
        energy = measurement.dampers[0].energy
    assert energy is not None
    points, _, limits = chart.panels[-1].curves
    is_limit = energy.dampers <= energy.expanded
    assert limits.draw == "limits" and np.asarray(limits.x).tolist() == sorted(energy.frequency[is_limit].tolist())
    assert 0 < np.count_nonzero(is_limit) == np.count_nonzero(np.isnan(np.asarray(points.y)))


def test_report_lists_the_printed_motions() -> None:
    body = [DamperMotion(f, "body2", 1.0, 0.0, False, 1.6e-3, False) for f in (30.0, 31.0)]
    html = motions(SimpleNamespace(dampers=[SimpleNamespace(label="a", table=lambda: motion_table([body]))]))
    cells = re.findall("<td[^>]*>(.*?)</td>", html.replace("\u00a0", " "))
    assert cells == ["body2", "Type I", "30 to 31 Hz"] == re.split(" {2,}", describe_motions([body])[1])


@pytest.fixture
def level_recordings(tmp_path):
    """Return two recordings of sweeps at four force levels."""
    frequencies = np.unique(np.append(np.linspace(9.0, 60.0, 60), [12.9, 13.0366, 13.1, 34.7773, 49.6628]))
    return [
        synthetic.stepped_sine(
            tmp_path / f"{name}.mcap", frequencies, level=[1.0, 2.0, 3.0, 4.0], noise=1e-7, name=name
        )
        for name in ("bare", "damped")
    ]


def test_every_level_of_force_is_named(level_recordings, tmp_path):
    output = write_report(level_recordings, tmp_path / "a.html")
    page = text_of(output.files[0])
    for level in ("1 N up", "2 N up", "3 N up", "4 N up"):
        assert f"bare, 1 N up → damped, {level}" in page
        assert level in output.lines[0]
    assert page.count('data-label="level">1 N</td>') == 6 and "Uncertainty budget of bare, 1 N up" in page


def test_headline_of_levels_agrees_with_their_table(level_recordings, tmp_path):
    output = write_report(level_recordings[:1], tmp_path / "a.html")
    heading, *lines = output.lines[0].split("\n")
    assert "4 levels (95 % intervals)" in heading and [line[:7] for line in lines] == ["mode at"] * 3
    rows = re.findall(
        r'data-label="level">(.*?)</td><td class="number" data-label="natural frequency.*?">(.*?)</td>',
        text_of(output.files[0]).replace("\u00a0", " "),
    )
    assert [level for level, _ in rows] == ["1 N", "2 N", "3 N", "4 N"] * 3
    for mode, line in enumerate(lines):
        ends = re.findall(r"\(([\d.]+ ± [\d.]+)\) Hz at (\d N)", line)
        assert len(ends) >= 2 and {(level, value) for value, level in ends} <= set(rows[4 * mode : 4 * mode + 4])


def test_remarks_on_levels_name_their_mode() -> None:
    points = [LevelPoint(level, 0.0, {}, note) for level, note in (("1 N", ""), ("2 N", "late"), ("3 N", "late"))]
    text = level_headline(SimpleNamespace(label="bare"), {"mode at 13 Hz": points, "mode at 35 Hz": points[:2]})
    assert text.split("\n")[-2:] == ["mode at 13 Hz, 2 N, 3 N: late", "mode at 35 Hz, 2 N: late"]


def test_flank_of_strong_mode_is_not_weak_peak(tmp_path: Path) -> None:
    # Body 2 adds a weak mode at 17.13 Hz; halfway to the strong mode at 15.86 Hz, the response of body 1 is higher.
    structure = {"masses": [1.0, 0.001], "springs": [1e4, 11.5], "damping": {"modal": [0.02, 0.01]}}
    test = {"kind": "stepped_sine", "from": 12, "to": 24, "points": 61, "force": ["1 N", "2 N"]}
    channels = [{"name": "a1", "at": "body 1"}, {"name": "f", "at": "shaker"}]
    scene = {"structure": structure, "shaker": {"kind": "force", "body": 1}, "test": test, "channels": channels}
    path = daq.record(rig.loads(yaml.safe_dump({"name": "weak mode", **scene}), where="weak"), tmp_path / "a.mcap")
    page = text_of(write_report([path], tmp_path / "a.html").files[0])
    assert re.findall(r'data-label="excitation frequency.*?">(.*?)</td>', page) == ["15.8", "15.8", "17.2", "17.2"]


def test_highest_maximum_is_no_flank() -> None:
    """The peak of a nonlinear response lies between two modes that describe it, and is the peak of neither mode."""
    frequency = np.linspace(44.0, 52.0, 41)
    peak, flank = 1.0 / (0.1 + abs(frequency - 47.6)), 100.0 / (frequency - 42.0) ** 2
    curve = SimpleNamespace(frequency=frequency, value=peak + flank)
    assert _highest_maximum(curve, (43.0, 51.0)) == pytest.approx(47.6)
    assert _highest_maximum(curve, (48.0, 51.0)) is None


def test_levels_of_one_recording_have_own_colors(level_recordings) -> None:
    with Measurements(level_recordings[:1]) as measurements:
        chart, *others = response_charts(measurements.results, "bare")
    curves = {curve.label: curve.style.color for curve in chart.panels[0].curves}
    assert [*curves] == ["1 N", "2 N", "3 N", "4 N"] and len({*curves.values()}) == 4
    # One chart for each channel; only the first explains its symbols.
    assert ["95 %" in " ".join(each.notes) for each in (chart, *others)] == [True, False, False]
    # Each chart names the kind of test, because it is also read alone.
    assert all(each.title.endswith("; sine, 1 N") for each in (chart, *others))


def test_page_of_many_channels_draws_few(recordings: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.commands.report_page.measurements._MAX_DRAWN", 2)
    with Measurements(recordings[:1]) as measurements:
        [measurement] = measurements.results
        count, drawn = len(measurement.rec.channels), measurement.drawn
        [chart] = response_charts([measurement], measurement.label)
        histories = time_histories(measurement.rec, drawn)
    highest = {pair[0].response for pair in measurement.sweeps[0].peaks if pair is not None}
    assert len(drawn) == 2 < count and highest & {*drawn}
    assert {curve.label for curve in chart.panels[0].curves} <= {*drawn} and "Drawn: " in " ".join(chart.notes)
    assert list(histories.names) == drawn and f"2 of {count} channels" in histories.title


def test_many_forces_leave_places_for_responses() -> None:
    channels = {f"hit{k}": SimpleNamespace(quantity="force") for k in range(16)}
    channels |= {"tip": SimpleNamespace(quantity="acceleration")}
    rec, sweep = SimpleNamespace(channels=channels), SimpleNamespace(peaks=[(SimpleNamespace(response="tip"), None)])
    drawn = Measurement(Path(), "", rec, (sweep,)).drawn  # type: ignore[arg-type]
    assert len(drawn) == 16 and "tip" in drawn


def test_channels_of_one_recording_are_compared(recordings: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    with Measurements(recordings) as measurements:
        one, other = measurements.results
    drawn = property(lambda self: ["body1"] if self is one else ["body2"])
    monkeypatch.setattr(Measurement, "drawn", drawn)
    charts = response_charts([one, other], one.label)
    assert [{curve.label for curve in chart.panels[0].curves} for chart in charts] == 2 * [{one.label, other.label}]


def test_curve_that_folds_back_is_drawn_as_points() -> None:
    frequency, value = np.array([10.0, 11.0, 12.0, 11.5, 11.2, 12.5]), np.linspace(1.0, 2.0, 6) + 0j
    chart = response_chart([Response.curve(frequency, value, "body1")], ["body1"])
    assert {curve.draw for panel in chart.panels for curve in panel.curves} == {"dots"}


def test_legend_of_histories_has_the_order_of_channels(recordings: list[Path]) -> None:
    with daq.open(recordings[0]) as rec:
        assert list(time_histories(rec, [*rec.channels]).names) == list(rec.channels)


def test_report_of_hammer_test_is_a_single_file(recordings: list[Path], tmp_path: Path) -> None:
    page = tmp_path / "figs" / "report.html"
    result = write_report(recordings[1:], page)
    assert result.files == (page,)
    assert [each.name for each in page.parent.iterdir()] == ["report.html"]
    text = page.read_text("utf-8")
    assert ">Frequency responses</h2>" in text and ">Free decays</h2>" in text
    assert "below 1 g" in result.lines[0]


def test_missing_result_is_a_warning(tmp_path: Path) -> None:
    path = synthetic.stepped_sine(tmp_path / "few.mcap", [20.0, 21.0, 22.0], name="few")
    result = write_report([path], tmp_path)
    assert any("not available" in warning for warning in result.warnings)


def test_foot_of_paper_names_any_file(tmp_path: Path) -> None:
    path = synthetic.stepped_sine(tmp_path / 'a"<b>.mcap', [20.0, 21.0, 22.0], name="few")
    page = text_of(write_report([path], tmp_path).files[0])
    assert '@bottom-left { content: "a\\22 \\3c b\\3e \\2e mcap' in page


def test_report_of_shock_shows_its_pulse(tmp_path: Path) -> None:
    path = daq.record(rig.load("shaker-table-shock"), tmp_path / "shock.mcap")
    result = write_report([path], tmp_path)
    page = text_of(result.files[0])
    view = re.search(r'"name":"time","unit":"ms","log":false,"range":null,"view":\[(.*?),(.*?)\]', page)
    assert view is not None and -500.0 < float(view[1]) < 0.0 < float(view[2]) < 500.0
    spectrum = analysis.srs(path, "unit")
    peak = int(np.argmax(spectrum.maximax))
    assert f"unit: {spectrum.maximax[peak]:.3g} m/s² at {spectrum.frequency[peak]:.3g} Hz" in result.lines[0]
    # A section without content is omitted: a shock has no frequency responses.
    assert ">Mode shapes<" not in page and result.warnings == ()


@pytest.mark.parametrize(
    ("curve", "logarithmic", "data"),
    [
        (Curve("a", [1.0, 2.0], [0.0, 3.0]), True, '"y":[null,3.0]'),
        (Curve("a", EvenlySpaced(0.0, 0.5, 3), [1.0, 2.0, 3.0]), False, '"x":{"start":0.0,"step":0.5,"size":3}'),
        (Curve("</script><b>", [1.0], [1.0]), False, '"label":"\\u003c/script>\\u003cb>"'),
    ],
)
def test_chart_data_suit_axis_and_page(curve: Curve, logarithmic: bool, data: str) -> None:
    panel = Panel("size", "m", [curve], logarithmic=logarithmic)
    html = ChartWriter().write(Chart("“Fig. 8, two dampers”", "alternative", [panel], notes=["Below."]))
    assert data in html and "<b>“Fig. 8, two dampers”</b>" in html and '<p class="key">Below.</p>' in html


def test_strips_have_digits_of_abscissa() -> None:
    panel = Panel("size", "m", [Curve("curve", [10.0, 11.0], [1.0, 2.0])], strips=[Strip((1 / 3, 10 / 3), "red")])
    assert '"ends":[0.33333333,3.3333333]' in ChartWriter().write(Chart("caption", "alternative", [panel]))


def test_answer_names_each_sweep(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    scene = rig.load("bare-structure", {"test.points": 30, "test.from": "45 Hz", "test.force": ["1 N", "2 N"]})
    daq.record(scene, path)
    [answer] = write_report([path], tmp_path).lines
    assert "2 levels" in answer and "Hz at 1 N" in answer and "Hz at 2 N" in answer


def test_phase_has_a_gap_where_it_wraps() -> None:
    f = np.linspace(1.0, 10.0, 10)
    curve = Response.curve(f, np.exp(1j * np.radians(np.linspace(60.0, -300.0, 10) + 1.0)), "body1")
    phase = response_chart([curve], ["body1"]).panels[1]
    assert phase.label == "phase" and np.isnan(phase.curves[0].y).sum() == 1
    assert np.isfinite(phase.curves[0].x).all() and np.nanmax(abs(np.diff(phase.curves[0].y))) < 41.0


def test_points_and_curve_have_the_same_phase() -> None:
    # A range beyond the end of the axis with an undetermined line inside.
    f = np.linspace(10.0, 40.0, 121)
    value = np.exp(-1j * np.radians(np.where(abs(f - 25.0) < 1.0, 338.0, 320.0)))
    error = np.where(abs(f - 25.0) < 0.1, 2.0, 0.01)
    frf = Response.curve(f, value, "body1", error=error, degrees_of_freedom=np.full(f.size, 9.0))
    through, points = response_chart([frf], ["body1"]).panels[1].curves
    common = np.isin(points.x, through.x)
    place = np.searchsorted(through.x, np.asarray(points.x)[common])
    assert common.sum() > 100
    assert np.nanmax(abs(np.asarray(points.y)[common] - np.asarray(through.y)[place])) < 1.0


def test_responses_of_other_channels_are_not_compared(recordings: list[Path], tmp_path: Path) -> None:
    infos = [replace(info, at="body 2" if info.at == "body 3" else info.at) for info in synthetic.channels()]
    infos = [replace(info, name="other") if info.name == "body2" else info for info in infos]
    other = synthetic.stepped_sine(tmp_path / "other.mcap", FREQUENCIES, noise=1e-6, infos=infos)
    result = write_report([recordings[0], other], tmp_path)
    assert any("other.mcap: Comparison: not available." in warning for warning in result.warnings)


def test_modes_of_equal_scenes_are_named_once(tmp_path: Path) -> None:
    paths = [synthetic.stepped_sine(tmp_path / f"{name}.mcap", FREQUENCIES, noise=1e-6) for name in ("one", "other")]
    text = text_of(write_report(paths, tmp_path).files[0])
    table = text[text.index("Resonances, with 95 % intervals") :]
    assert re.findall(r'class="group"[^>]*>([^<]*)<', table)[:2] == ["one", "other"]


def test_change_has_the_digits_of_its_interval() -> None:
    peaks = (Peak(1e-4, 1e-7, 13.0, 12.99, 13.01), Peak(0.5e-4, 0.5e-7, 13.0, 12.99, 13.01))
    assert describe_changes([PeakChange("body1", 13.0, 0.01, *peaks)], ("µm/N", 1e6))[1].split()[2:6] == [
        "-6.02", "-6.03", "to", "-6.01",
    ]  # fmt: skip


def test_undetermined_values_have_no_band() -> None:
    f = np.linspace(10.0, 20.0, 21)
    bound = np.where(f < 15.0, 2e-6, 1e-8)
    curve = Response.curve(f, np.full(f.size, 1e-6 + 0j), "body1", limits={"sensors": bound})
    magnitude, *_, relative = response_chart([curve], ["body1"]).panels
    assert np.array_equal(np.isnan(np.asarray(magnitude.curves[0].high)), f < 15.0)
    assert np.array_equal(np.isnan(np.asarray(magnitude.curves[0].y)), f < 15.0)
    assert [strip.ends for strip in magnitude.strips] == [(10.0, 14.75)]
    assert relative.limits is not None and relative.limits[1] == 100.0 == np.max(np.asarray(relative.curves[0].y))


def test_headline_has_the_changes_of_the_table() -> None:
    before, after, unbounded = (
        Peak(*numbers, 13.0, 12.9, 13.1) for numbers in ((5e-3, 1e-5), (1e-3, 1e-5), (1e-3, inf))
    )
    changes = [
        SweepChange("a", "b", "b", PeakChange(f"body{number}", mode, 0.01, before, damped), {70.0: "70.00 Hz"})
        for number, (mode, damped) in enumerate([(13.0, unbounded), (35.0, after), (50.0, after)], 1)
    ]
    [text] = summarize([], changes)
    html = (
        re.sub(r" (class|data-label)=\"[^\"]*\"", "", changes_table(changes)).replace("\u00a0", " ").replace("−", "-")
    )
    rows = [re.findall("<td>(.*?)</td>", row) for row in html.split("<tr>") if "<td>body" in row]
    lines = dict(re.findall(r"^([\d.]+ Hz)[^:]*: (.*)$", text, re.MULTILINE))
    for _, mode, change, limits, before, after, *_ in rows:
        line = lines[f"{mode} Hz"]
        assert f"{before} → {after} µm/N" in line
        assert all(number.lstrip("-+") in line for number in [change.strip("–"), *re.findall(r"[-+][\d.]+", limits)])
    # In the order of the table, with the mode that is not compared.
    assert [*lines] == ["13.00 Hz", "35.00 Hz", "50.00 Hz", "70.00 Hz"]
    assert lines["13.00 Hz"].startswith("reduction at most") and "not compared, because" in lines["70.00 Hz"]
    assert lines["35.00 Hz"].startswith("reduction 14.0 dB (13.9 to 14.1)")


def test_page_has_force_and_mac_and_note(recordings: list[Path], tmp_path: Path) -> None:
    text = write_report(recordings[:1], tmp_path, note="J. Doe <1>").files[0].read_text("utf-8")
    assert "J. Doe &lt;1&gt;" in text and "Modal assurance criterion" in text and "required force" in text


def test_peak_labels_have_the_frequencies_of_the_table(page: Path) -> None:
    text = text_of(page)
    marks = "".join(re.findall(r'"marks":(\[\[.*?\]\])', text))
    labels = set(re.findall(r'"([\d.]+) Hz"', marks))
    table = text.partition("Resonances, with 95 % intervals")[2].partition("</table>")[0]
    frequencies = [float(frequency) for frequency in re.findall(r">([\d.]+) ±", table)]
    rounded = {f"{frequency:.{decimals}f}" for frequency in frequencies for decimals in (0, 1, 2)}
    assert labels and labels <= rounded


@pytest.mark.parametrize(
    ("frequency", "std", "label"),
    [(47.91, 0.2, "47.9 Hz"), (13.03651, 5e-5, "13.04 Hz"), (0.2812, 1e-5, "0.281 Hz"), (1652.0, 30.0, "1650 Hz")],
)
def test_labels_have_the_digits_of_intervals(frequency: float, std: float, label: str) -> None:
    assert UncertainMode(frequency, std, 0.01, 0.001, "").frequency_label() == label


def test_modes_have_different_labels() -> None:
    modes: Any = SimpleNamespace(frequency=[12.96, 13.04, 30.0], frequency_std=[0.05] * 3)
    assert [Modes.frequency_label(modes, k) for k in range(3)] == ["12.96 Hz", "13.04 Hz", "30.0 Hz"]


def test_peak_of_the_table_is_drawn(recordings: list[Path]) -> None:
    with Measurements(recordings[:1]) as measurements:
        [measurement] = measurements.results
        [chart] = response_charts([measurement], measurement.label)
    symbols = [curve for curve in chart.panels[0].curves if curve.draw in PEAK_SYMBOLS]
    drawn = {value for curve in symbols for value in np.asarray(curve.y).tolist()}
    for found in measurement.sweeps[0].peaks:
        assert found is not None
        curve, peak = found
        assert not peak.is_determined or any(
            value == pytest.approx(curve.shown_in[1] * peak.value, rel=1e-3) for value in drawn
        )


def test_unsettled_points_and_open_peaks_are_marked() -> None:
    f = np.linspace(10.0, 20.0, 11)
    curve = replace(Response.curve(f, np.full(f.size, 1e-6 + 0j), "body1"), unsteady=f == 12.0)
    chart = response_chart(
        [curve], ["body1"], peaks=[[PeakMark("arrows", 15.0, 2e-6, Peak(2e-6, inf, 15.0, 14.0, 16.0))]]
    )
    symbols = {curve.draw: np.asarray(curve.x).tolist() for curve in chart.panels[0].curves}
    assert symbols["crosses"] == [12.0] and symbols["arrows"] == [15.0] and "circles" not in symbols
    assert "Crosses" in " ".join(chart.notes) and "Arrows" in " ".join(chart.notes)


def test_force_outside_its_tolerance_is_stated(recordings: list[Path]) -> None:
    with Measurements(recordings[:1]) as measurements:
        [measurement] = measurements.results
        [sweep] = measurement.sweeps
        amplitude = np.ones(sweep.frfs[0].frequency.size)
        amplitude[3] = 1.02
        frfs = [replace(frf, amplitude=amplitude) for frf in sweep.frfs]
        scene = rig.load("fig8-no-damper", {"test.force": "1 N"})
        rec = SimpleNamespace(scene=scene)
        changed = replace(measurement, sweeps=(replace(sweep, frfs=frfs),), rec=rec)  # type: ignore[arg-type]
        [chart] = force_charts([changed], "")
    assert f"{frfs[0].label}: {frfs[0].frequency[3]:g} Hz, by up to 2 %" in chart.notes[0]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("fig8-no-damper", "stepped sine, 8 to 60 Hz, 2.6 N, 150 points upward"),
        ("fig10b-no-damper", "impulse, 200 N, 3 impacts of 4 ms"),
        ("shaker-table-shock", "shock, half sine of 49 m/s² and 11 ms at table, 3 shocks"),
        (
            "shaker-table-random",
            "random, 5 to 200 Hz, 7.3 m/s² rms, unit limited to 1.92 (m/s²)²/Hz from 8 to 40 Hz, 120 s",
        ),
        (
            "shaker-table-sine",
            "sine sweep, 5 to 60 Hz, 0.981 to 2.94 m/s², upward at 0.896 oct/min, unit limited to 14.7 m/s² from "
            "5 to 60 Hz, 240 s",
        ),
    ],
)
def test_test_is_described_in_words(name: str, text: str) -> None:
    assert sentence_of(rig.load(name)) == text


def test_hammer_is_drawn_at_its_body() -> None:
    drawing = rig_drawing(rig.load("fig10b-no-damper"))
    assert "hammer, 200 N" in drawing and "Other channels" not in drawing


@pytest.mark.parametrize(("scene", "color"), [("fig10b-no-damper", HAMMER), ("fig8-no-damper", TABLE)])
def test_force_is_drawn_along_the_motion(scene: str, color: str) -> None:
    # The bodies move vertically: the line of the force, or the coil spring, is below their arm.
    [path] = re.findall(rf'<path stroke="{color}"[^>]* d="([^"]*)"', rig_drawing(rig.load(scene)))
    x = [float(value) for value in re.findall(r"[ML]([\d.]+) ", path)]
    assert x[0] == x[-1] and max(x) - min(x) < 20


def test_table_has_the_color_of_its_channel() -> None:
    drawing = rig_drawing(rig.load("shaker-table-random"))
    assert f'height="14" rx="3" stroke="{TABLE}"' in drawing


def test_bodies_of_a_mode_shape_do_not_meet() -> None:
    shapes = BodyShapes(("a", "b"), np.array([[1.0], [-1.0]], dtype=complex), np.zeros((2, 1)))
    drawing = mode_drawing(shapes, ["body 1", "body 2"], 0, "13 Hz")
    tops = [float(top) for top in re.findall(r'<rect x="24" y="([\d.]+)"[^>]*stroke-dasharray', drawing)]
    swing = max(float(value) for value in re.findall(r"--swing:([\d.]+)px", drawing))
    assert abs(tops[0] - tops[1]) - 26 > 2 * swing


def test_drawing_names_bodies_and_sensors() -> None:
    drawing = rig_drawing(rig.load("fig8-three-dampers"))
    assert "6.6 kN/m" in drawing and "body 3" in drawing and ">body3<" in drawing


@in_browser
@pytest.mark.thorough
def test_browser_draws_every_chart(page: Path, tmp_path: Path) -> None:
    document = browse(page, tmp_path, "--dump-dom")
    charts = document.count('data-source="')
    assert charts > 5 and len(re.findall(r'data-drawn="[1-9]', document)) == charts


@pytest.mark.thorough
def test_page_is_two_megabytes_at_most(tmp_path: Path) -> None:
    recordings = sorted((Path(__file__).parents[3] / "recordings").glob("demo-*.mcap"))
    [page] = write_report(recordings, tmp_path).files
    assert len(recordings) == 4 and page.stat().st_size < 2e6


def test_contents_link_to_every_section(page: Path) -> None:
    text = page.read_text("utf-8")
    links, sections = re.findall('href="#([^"]*)"', text), re.findall('<h2 id="([^"]*)"', text)
    assert links == sections and len(sections) > 5


@in_browser
@pytest.mark.thorough
def test_readout_names_curves_and_units(page: Path, tmp_path: Path) -> None:
    document = browse(page, tmp_path, "--dump-dom")
    readout = document[document.index('<table class="readout idle">') :].partition("</table>")[0]
    assert "hit scene" in readout and "|compliance| / (µm/N)" in readout and "frequency: –" in readout


def title_of(panel: Panel, script: str, folder: Path) -> str:
    """Return the title of a page with one panel, which a script sets while the panel is drawn, or after it."""
    templates, scripts = files("analysis.commands.report_page") / "browser", ("uPlot.iife.min.js", "charts.js")
    page = folder / "page.html"
    page.write_text(
        "<!DOCTYPE html><meta charset='utf-8'><title></title><body style='width: 600px'>"
        + ChartWriter().write(Chart("caption", "alternative", [panel]))
        + f"<script>{script}</script>"
        + "".join(f"<script>{(templates / name).read_text('utf-8')}</script>" for name in scripts),
        "utf-8",
    )
    [title] = re.findall("<title>(.*)</title>", browse(page, folder, "--dump-dom"), re.DOTALL)
    return str(title)


@in_browser
@pytest.mark.thorough
def test_names_in_tables_are_no_formulas(tmp_path: Path) -> None:
    title = title_of(
        Panel("=1+1", "", [Curve("curve", [1.0], [2.0])]),
        "HTMLAnchorElement.prototype.click = function () { document.title += decodeURIComponent(this.href); };"
        "addEventListener('load', () => document.querySelectorAll('button').forEach((button) => button.click()));",
        tmp_path,
    )
    assert '"\'=1+1: curve"' in title


@in_browser
@pytest.mark.thorough
@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([11.5, 14.0], ["10", "12", "14", "16"]),
        ([22.0, 22.0], ["20", "22", "24"]),
        ([1.0, 500.0], ["1", "10", "100"]),
        ([1.5, 200.0], ["2", "5", "10", "20", "50", "100", "200"]),
    ],
)
def test_logarithmic_axis_has_labels(values: list[float], expected: list[str], tmp_path: Path) -> None:
    panel = Panel("bound", "%", [Curve("curve", [1.0, 2.0], values)], logarithmic=True)
    # The title of the page collects the texts that are drawn.
    title = title_of(
        panel,
        "const fill = CanvasRenderingContext2D.prototype.fillText;"
        "CanvasRenderingContext2D.prototype.fillText = function (text, ...rest) {"
        " document.title += `|${text}`; fill.call(this, text, ...rest); };",
        tmp_path,
    )
    labels = title.partition("|bound / %|")[2].split("|")
    assert [label for label in labels if label] == expected


@in_browser
@pytest.mark.thorough
def test_page_prints_to_pdf(page: Path, tmp_path: Path) -> None:
    browse(page, tmp_path, f"--print-to-pdf={tmp_path / 'page.pdf'}")
    pdf = (tmp_path / "page.pdf").read_bytes()
    assert pdf.startswith(b"%PDF") and pdf.count(b"/Type /Page\n") >= 4


def test_decay_is_marked_at_the_stated_time(recordings: list[Path]) -> None:
    with Measurements(recordings[1:]) as measurements:
        decay = measurements.results[0].decay
        chart = decay_charts(measurements.results, "")[0]
    assert decay is not None
    through, points, _, ring = chart.panels[0].curves
    assert points.draw == "points" and points.x is through.x is decay.peak_time
    assert (np.asarray(ring.x).tolist(), np.asarray(ring.y).tolist()) == ([decay.quiet_from], [decay.gravity])


def test_undetermined_damping_is_an_upper_limit(recordings: list[Path]) -> None:
    with Measurements(recordings[1:]) as measurements:
        [measurement] = measurements.results
    assert measurement.decay is not None
    mode = next(each for each in measurement.decay.modes if each.damping.size > 2)
    uncertain = mode.damping_std.copy()
    uncertain[0] = mode.damping[0]
    decay = replace(measurement.decay, modes=(replace(mode, damping_std=uncertain),))
    points, _, limits = decay_charts([replace(measurement, decay=decay)], "")[1].panels[0].curves
    assert (limits.draw, np.asarray(limits.x).tolist()) == ("limits", [mode.amplitude[0]])
    assert np.isfinite(np.asarray(points.y)).tolist() == sorted(np.asarray(points.x) < mode.amplitude[0], reverse=True)


def test_modes_stand_below_those_of_the_baseline(recordings: list[Path], tmp_path: Path) -> None:
    other = synthetic.stepped_sine(tmp_path / "upper.mcap", FREQUENCIES[FREQUENCIES > 20.0], noise=1e-6, name="upper")
    page = text_of(write_report([recordings[0], other], tmp_path / "modes.html").files[0])
    _, drawings = re.findall(r'<div class="shapes">(.*?)</div>', page, re.DOTALL)
    first, *others = re.findall(r'<p class="absent">(.*?)</p>|<figcaption>', drawings)
    assert first.endswith("Hz: not determined") and others == [""] * len(others) != []


def test_stabilization_diagram_has_every_pole(recordings: list[Path]) -> None:
    with Measurements(recordings[:1]) as measurements:
        modes = measurements.results[0].sweeps[0].modes
        [chart] = stabilization_charts(measurements.results)
    assert modes is not None
    # Poles of several orders with the same frequency: points of a series would be lost.
    symbols = [curve for curve in chart.panels[0].curves if curve.draw in ("dots", "crosses", "circles")]
    drawn = sorted(pair for curve in symbols for pair in zip(np.asarray(curve.x), np.asarray(curve.y), strict=True))
    assert drawn == sorted((pole.frequency, pole.order) for pole in modes.chart)


def test_stabilization_diagrams_have_one_frequency_axis(recordings: list[Path], tmp_path: Path) -> None:
    narrow = synthetic.stepped_sine(tmp_path / "narrow.mcap", FREQUENCIES[2:], noise=1e-6, name="narrow")
    with Measurements([recordings[0], narrow]) as measurements:
        assert [chart.x_limits for chart in stabilization_charts(measurements.results)] == [(8.0, 60.0)] * 2


def test_local_model_carries_a_peak_between_lines() -> None:
    f = np.linspace(10.0, 16.0, 1201)[::50]
    curve = Response.curve(f, 1.0 / (13.04**2 - f**2 + 0.13j * f), "body1")
    found = resonance_peak(curve, 11.0, 15.0)
    assert found is not None
    at, height = local_model(curve, found)
    assert height.max() == pytest.approx(found.value, rel=1e-3) and at[height.argmax()] == pytest.approx(13.04, abs=0.1)


def test_page_draws_the_interpolated_curve_of_figures() -> None:
    f = np.linspace(8.0, 20.0, 1441)
    exact = Response.curve(f, 1.0 / (13.04**2 - f**2 + 0.13j * f), "body1")
    lines = np.arange(7, f.size, 2)
    magnitude, *_ = response_chart([exact.at(lines)], ["body1"]).panels
    x, y = (np.asarray(column) for column in (magnitude.curves[0].x, magnitude.curves[0].y))
    assert x.size > lines.size
    drawn = np.interp(f, x, y)[7:-7]
    assert drawn == pytest.approx(1e6 * abs(exact.value[7:-7]), rel=2e-3)


def test_phase_axis_has_the_fewest_wraps() -> None:
    f = np.linspace(10.0, 20.0, 41)
    value = np.exp(1j * np.radians(25.0 + 15.0 * (-1.0) ** np.arange(f.size)))
    phase = response_chart([Response.curve(f, value, "body1")], ["body1"]).panels[1]
    points = next(curve for curve in phase.curves if curve.draw == "points")
    assert phase.limits == (-255.0, 135.0) and np.isfinite(points.y).all()


def test_extrapolated_peak_may_be_higher() -> None:
    f = np.linspace(10.0, 16.0, 1201)
    curve = Response.curve(f, 1.0 / (13.04**2 - f**2 + 0.13j * f), "body1")
    coarse = curve.at(np.arange(25, f.size, 50))
    for frf, is_extrapolated in ((curve, False), (coarse, True)):
        found = resonance_peaks(frf)
        peaks = [peak_marks(frf, found)]
        texts = [found[0][1].height_text(1.0), " ".join(response_chart([frf], ["body1"], peaks=peaks).notes)]
        assert ["extrapolated" in texts[0], "may be higher" in texts[1]] == [is_extrapolated, is_extrapolated]


def test_phase_of_tones_has_gaps_of_magnitude() -> None:
    f = np.linspace(10.0, 20.0, 41)
    value = 1.0 / (15.1**2 - f**2 + 0.3j * f)
    limits = {"sensors": np.where(abs(f - 12.0) < 0.6, 2.0, 0.01) * abs(value)}
    magnitude, phase, *_ = response_chart([Response.curve(f, value, "body1", limits=limits)], ["body1"]).panels
    points = [next(curve for curve in panel.curves if curve.draw == "points") for panel in (magnitude, phase)]
    assert np.isnan(points[0].y).any() and np.array_equal(*(np.isnan(np.asarray(each.y)) for each in points))


def test_mode_shape_rests_at_its_positive_maximum() -> None:
    style = (files("analysis.commands.report_page") / "browser" / "page.css").read_text("utf-8")
    assert "\n.moving { transform: translateY(calc(-1 * var(--swing))); }" in style
    assert re.findall(r"([^\n{]*)\{ animation: swing", style) == [" .shapes figure:hover .moving "]


def test_mode_that_is_not_identified_is_named(recordings: list[Path]) -> None:
    with Measurements(recordings[:1]) as measurements:
        [reference] = measurements.results
        [sweep] = reference.sweeps
        assert sweep.modes is not None
        names = ("frequency", "frequency_std", "damping", "damping_std")
        modes = replace(sweep.modes, **{name: getattr(sweep.modes, name)[1:] for name in names})
        other = replace(reference, sweeps=(replace(sweep, modes=modes, found=sweep.found[1:]),))
    missing = f"mode of {sweep.modes.frequency[0]:.2f}\u00a0Hz</td>"
    assert missing not in resonances([reference], reference) and missing in resonances([reference, other], reference)


def test_intervals_without_calibration_are_stated(recordings: list[Path], tmp_path: Path) -> None:
    text = write_report(recordings[:1], tmp_path).files[0].read_text("utf-8")
    answer = text[text.index("<main>") : text.index("<nav>")]
    assert "The intervals do not include errors of calibration" in answer
    assert ">not included<" in text and "U = k u, k = 2.00" in text.replace("\u00a0", " ")


def test_first_box_states_faulty_impacts_and_steady_state(recordings: list[Path]) -> None:
    with Measurements(recordings) as measurements:
        sweep, hits = measurements.results
        unsteady = np.arange(FREQUENCIES.size) == 4
        frfs = [replace(frf, unsteady=unsteady) for frf in sweep.sweeps[0].frfs]
        sweep = replace(sweep, sweeps=(replace(sweep.sweeps[0], frfs=frfs),))
        [first, *_] = [marker for marker in hits.rec.markers if marker.kind == "hit"]
        overload = Marker("overload", first.first_sample + 5, first.first_sample + 9, {"channel": "body1"})
        markers = [*hits.rec.markers, overload]
        rec = SimpleNamespace(
            markers=markers, overloads=[overload], gaps=[], scene=hits.rec.scene, channels=hits.rec.channels
        )
        texts = limitations([sweep, replace(hits, rec=rec)])  # type: ignore[arg-type]
    assert "no steady state at 12 Hz" in texts[0] and "impact 1 clipped (body1), clipped samples omitted" in texts[1]


def test_first_box_states_intervals_that_assume_linearity(
    recordings: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Measurements(recordings) as measurements:
        monkeypatch.setattr(type(measurements.results[0].rec.scene), "is_linear", False)
        texts = limitations(measurements.results)
    # Separate tones of a stepped sine need no linearity.
    assert ["the intervals assume linearity" in text for text in texts[:2]] == [False, True]


def test_damping_between_lines_is_called_extrapolated() -> None:
    modes, f = SimpleNamespace(), np.array([10.0, 19.5, 20.0, 30.0])
    modes.frequency, modes.damping, modes.damping_std = np.array([20.05, 25.0]), np.array([0.05, 0.005]), np.zeros(2)
    curve = Response.curve(f, np.ones(4, dtype=complex), "body1")
    assert extrapolates_damping(modes, [curve]).tolist() == [False, True]  # type: ignore[arg-type]


def test_heights_before_and_after_have_equal_digits() -> None:
    peaks = Peak(1451.553e-6, 0.93e-6, 34.8, 34.7, 34.9), Peak(331.8e-6, 10e-6, 34.5, 34.4, 34.6)
    assert PeakChange("body1", 34.78, 0.01, *peaks).height_texts(1e6) == ("1452", "332")


def test_undetermined_peak_is_a_lower_bound() -> None:
    uncertain = Peak(521e-6, 854e-6, 12.4, 10.4, 13.9, lower_limit=448e-6)
    change = PeakChange("body1", 13.04, 0.01, Peak(2136e-6, 66e-6, 13.04, 13.0, 13.1), uncertain)
    assert change.height_texts(1e6) == ("2136", "≥ 448")
    [row] = change_table([change], ("µm/N", 1e6)).rows
    assert row[2] == row[-1] == "–" and row[3].startswith("-13.")


def test_change_of_undetermined_peak_is_an_interval() -> None:
    bare, damped = Peak(1e-3, 2e-5, 10.0, 9.9, 10.1), Peak(4e-4, 2.4e-4, 10.0, 9.9, 10.1)
    assert re.fullmatch(r"reduction of \S+ to \S+ dB", change_text(PeakChange("body1", 10.0, 0.01, bare, damped)))


def test_peak_below_its_uncertainty_is_not_determined() -> None:
    bare, damped = Peak(1e-3, 2e-5, 10.0, 9.9, 10.1), Peak(4e-4, 5e-4, 10.0, 9.9, 10.1)
    assert PeakChange("body1", 10.0, 0.01, bare, damped).height_texts(1e6)[1] == "not determined"


def test_different_shapes_are_marked() -> None:
    before, after = (
        SimpleNamespace(
            label=name,
            responses=["body1", "body2"],
            frequency=np.array([10.0, 20.0]),
            shapes=shapes,
            frequency_label=str,
        )
        for name, shapes in (("a", np.eye(2)), ("b", np.array([[1.0, 0.5], [0.0, 1.0]])))
    )
    table = mac_table(before, after)  # type: ignore[arg-type]
    assert table.count("differ") == 1 and "0.800, differ" in table


def test_page_has_no_folder(page: Path, recordings: list[Path]) -> None:
    assert str(recordings[0].parent) not in page.read_text("utf-8")


def test_levels_of_equal_scenes_state_dissipated_energy(tmp_path: Path) -> None:
    band = {"test.from": "46 Hz", "test.to": "53 Hz", "test.points": 12}
    scene = rig.load("fig8-one-damper", {**band, "test.force": ["50 mN", "2.6 N"], "test.settle.tolerance": "2 %"})
    path = daq.record(scene, tmp_path / "a.mcap")
    shutil.copy(path, tmp_path / "b.mcap")
    page = text_of(write_report([path, tmp_path / "b.mcap"], tmp_path / "a.html").files[0])
    shares = re.findall(r'data-label="energy dissipated by dampers.*?">(.*?)</td>', page)
    assert len(shares) == 4 and all(shares) and shares[:2] == shares[2:]
