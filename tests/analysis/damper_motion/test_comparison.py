"""Interpolated resonance peaks with their error bounds, and their changes between two recordings."""

import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import analysis
import daq
import rig
from analysis.commands.cli import app
from analysis.commands.presentation.comparison import compare_peaks, describe_changes
from analysis.commands.presentation.frf_findings import describe_frfs
from analysis.core.damper_motion.comparison import (
    Peak,
    PeakChange,
    coarse_step_warnings,
    peak,
    peak_changes,
    resonance_peak,
    uncompared_highest_peaks,
)
from rig.core.results.response import Response
from rig.core.results.uncertainty import SENSITIVITY, UncertaintyBudget
from tests.analysis.responses import synthetic

ONE_BODY = """
structure: {masses: [1 kg], springs: [12.8 kN/m], damping: {modal: 0.5 %}}
shaker: {kind: force, body: 1}
channels: [{name: a, at: body 1, accelerometer: {}}, {name: force, at: shaker}]
converter: {rate: 1024 Hz}
"""


def measured_curve(frequency: np.ndarray, value: np.ndarray, error: float = 0.0) -> Response:
    """Return a curve with an error of this relative size at each point, which the curve also states as its bound."""
    magnitude, ones = abs(value), np.ones(frequency.size)
    deviation = error * magnitude * np.exp(2j * np.pi * np.arange(frequency.size) * 0.38)
    return Response.curve(
        frequency, value + deviation, "body1", degrees_of_freedom=100.0 * ones, limits={"test": error * magnitude}
    )


def two_modes(f: np.ndarray, natural: float, ratio: float) -> np.ndarray:
    """Return a receptance with modes at the natural frequency and an octave above, m/N."""
    return sum(1e-4 / (1.0 - (f / f0) ** 2 + 2j * ratio * f / f0) for f0 in (natural, 2.0 * natural))  # type: ignore[return-value]


@settings(max_examples=40)
@given(
    natural=st.floats(10.0, 100.0),
    ratio=st.floats(0.002, 0.04),
    offset=st.floats(0.0, 1.0),
    points_per_bandwidth=st.floats(1.5, 6.0),
    error=st.sampled_from([0.0, 1e-3, 2e-2]),
)
def test_measured_peak_lies_within_bounds(natural, ratio, offset, points_per_bandwidth, error) -> None:
    step = 2.0 * ratio * natural / points_per_bandwidth
    f = natural + step * (np.arange(-4, 4) + offset)
    estimate = peak(measured_curve(f, two_modes(f, natural, ratio), error), f[0], f[-1])
    dense = np.linspace(natural - step, natural + step, 4001)
    exact = abs(two_modes(dense, natural, ratio))
    assert estimate is not None
    assert abs(estimate.value - exact.max()) <= estimate.expanded + 1e-5 * exact.max()
    assert estimate.lowest_frequency - step / 200 <= dense[np.argmax(exact)] <= estimate.highest_frequency + step / 200
    # With coarse points, interpolation of a wide peak is less certain.
    assert error > 0 or ratio > 0.02 or estimate.expanded < 0.02 * exact.max()


def test_jump_near_peak_removes_upper_bound() -> None:
    f = np.linspace(9.0, 11.0, 41)
    value = np.where(f < 10.2, 1.0, 0.005) / (1.0 - (f / 10.6) ** 2 + 0.002j)
    estimate = peak(measured_curve(f, value), 9.0, 11.0)
    assert estimate is not None and math.isinf(estimate.expanded) and estimate.frequency == pytest.approx(10.15)
    change = PeakChange("body1", 10.0, 0.01, Peak(1e-3, 0.0, 10.0, 10.0, 10.0), estimate)
    assert math.isinf(change.decibel[2])
    _, row = describe_changes([change], ("µm/N", 1e6))
    # The highest measured point is 12.0 m/N, without dampers 1e-3 m/N: at least 81.6 dB.
    assert "above +81.6" in row and re.search(r"1000 +≥ 1\d{7}", row)


def test_omitted_points_near_peak_remove_upper_bound() -> None:
    f = np.linspace(9.0, 11.0, 41)
    curve = measured_curve(f, 1.0 / (1.0 - (f / 10.03) ** 2 + 0.02j))
    included = abs(f - 10.1) > 0.12
    estimate = peak(replace(curve.at(included), omitted=f[~included]), 9.0, 11.0)
    assert estimate is not None and math.isinf(estimate.expanded) and estimate.value < abs(curve.value).max()


def amplitude_dependent_receptance(f: np.ndarray) -> np.ndarray:
    """Return a receptance whose damping depends on the amplitude and is lowest at the peak, by iteration."""
    stiffness, damping = 1.0 - (f / 18.6) ** 2, np.full(f.size, 0.1)
    for _ in range(200):
        amplitude = 1.0 / np.hypot(stiffness, damping)
        damping = 0.5 * (damping + 0.022 + 0.022 / (1.0 + (amplitude / 25.0) ** 2))
    return 1.0 / (stiffness + 1j * damping)


@cache
def height_of_narrow_peak() -> float:
    return float(abs(amplitude_dependent_receptance(np.linspace(18.2, 19.0, 4001))).max())


@pytest.mark.parametrize("step", [0.05, 0.1, 0.2, 1.0 / 3.0, 0.4])
@pytest.mark.parametrize("offset", np.linspace(0.0, 1.0, 9).tolist())
def test_narrow_peak_lies_within_bound(step, offset) -> None:
    f = 18.6 + step * (np.arange(-5, 5) + offset)
    estimate = peak(measured_curve(f, amplitude_dependent_receptance(f)), f[0], f[-1])
    exact = height_of_narrow_peak()
    assert estimate is not None and estimate.low <= exact <= estimate.value + estimate.expanded
    assert estimate.low >= abs(amplitude_dependent_receptance(f)).max()
    assert step > 0.05 or estimate.expanded < 0.02 * exact


def test_warning_of_coarse_points_gives_required_step() -> None:
    resolved, coarse = (Peak(1e-3, 1e-4, 18.5, 18.4, 18.6, 0.0, ratio * 1e-3, 0.33) for ratio in (0.005, 0.09))
    [warning] = coarse_step_warnings([(19.0, "a3", resolved), (19.0, "a4", coarse), (44.0, "a4", resolved)])
    assert warning.startswith("a4, near 18.50 Hz: the points are 0.33 Hz apart")
    assert "by up to 9 %" in warning and warning.endswith("Measure every 0.1 Hz there.")
    coarse_points = np.linspace(17.0, 20.0, 3)
    estimate = peak(measured_curve(coarse_points, amplitude_dependent_receptance(coarse_points)), 17.0, 20.0)
    assert estimate is not None and math.isinf(estimate.expanded)


def test_unbounded_errors_do_not_overflow() -> None:
    f = np.linspace(9.0, 11.0, 41)
    curve = measured_curve(f, 1e3 * two_modes(f, 10.0, 0.01), 1e-3)
    with np.errstate(over="raise"):
        estimate = peak(curve.with_limits({"aliasing": np.full(f.size, np.inf)}), 9.0, 11.0)
    assert estimate is not None and estimate.expanded > 1e50 * estimate.value


def test_tolerances_of_a_peak_are_combined_as_variances() -> None:
    one, two = (Peak(1.0, 0.0, 10.0, 9.9, 10.1, lower_limit=1.0, tolerances=(0.05,) * count) for count in (1, 2))
    # No error exceeds its limit; two rectangular distributions have k = 2.
    assert (one.expanded, two.expanded) == pytest.approx((0.05, 2.0 * math.sqrt(2.0 / 3.0) * 0.05))
    assert two.low == pytest.approx(1.0 - two.expanded)
    scattered = Peak(1.0, 0.06, 10.0, 9.9, 10.1, tolerances=(0.05, 0.05))
    assert scattered.expanded == pytest.approx(math.hypot(0.06, two.expanded))


def test_changes_are_printed_with_their_limits() -> None:
    peaks = [Peak(1e-3, 1e-5, 10.0, 9.9, 10.1), Peak(2e-4, 1e-5, 9.5, 9.4, 9.8), Peak(1e-3, 2e-5, 10.05, 9.9, 10.2)]
    changes = [PeakChange("b1", 10.0, 0.01, peaks[0], damped) for damped in peaks[1:]]
    # Columns: change in dB with its limits, heights in µm/N, shift in Hz with its limits.
    _, lowered, unchanged = (re.split(r"  +", line) for line in describe_changes(changes, ("µm/N", 1e6)))
    assert lowered[2:6] == ["-14.0", "-14.4 to -13.5", "1000", "200"]
    assert lowered[6:8] == ["-0.50", "-0.64 to -0.18"]
    assert unchanged[2:4] == ["+0.0", "-0.2 to +0.2"]


def test_small_certain_change_keeps_its_sign() -> None:
    # With one decimal, the interval would begin at zero.
    low, high = (Peak(height, 1.3e-5, 10.0, 9.9, 10.1) for height in (1e-3, 1.02e-3))
    (_, line) = describe_changes([PeakChange("b1", 10.0, 0.01, low, high)], ("µm/N", 1e6))
    assert re.split(r"  +", line)[2:4] == ["+0.17", "+0.01 to +0.33"]


def test_tolerances_cancelling_on_one_flank_widen_peak() -> None:
    natural, stiffness, tolerance = 13.0, 1.3e3, 0.11
    f = np.geomspace(8.0, 20.0, 40)

    def measured(f: np.ndarray, table: float, body: float) -> np.ndarray:
        """Return the receptance of the driven body under a coil spring, with gain errors of both sensors."""
        value = two_modes(f, natural, 0.01)
        return (1.0 + body) * value / ((1.0 + table) + stiffness * value * (table - body))

    curve = measured_curve(f, two_modes(f, natural, 0.01))
    # First-order error of the response due to both tolerances, which nearly vanishes where its value is -1/stiffness.
    curve = curve.with_limits({SENSITIVITY: 2.0 * tolerance * abs(curve.value * (1.0 + stiffness * curve.value))})
    estimate = resonance_peak(curve, 0.85 * natural, 1.15 * natural)
    assert estimate is not None
    dense = np.linspace(0.5 * natural, 1.5 * natural, 20001)
    heights = [
        abs(measured(dense, *errors)).max() for errors in tolerance * np.random.default_rng(1).uniform(-1, 1, (400, 2))
    ]
    exact = abs(two_modes(dense, natural, 0.01)).max()
    assert np.mean(abs(np.array(heights) - exact) < estimate.expanded) > 0.95
    assert estimate.expanded < 0.5 * exact


def test_small_peak_on_flank_is_compared() -> None:
    f = np.linspace(30.0, 86.0, 400)

    def curve(ratio: float) -> Response:
        small_mode = 2e-5 / (1.0 - (f / 79.0) ** 2 + 2j * ratio * f / 79.0)
        return measured_curve(f, 2e-3 / (1.0 - (f / 40.0) ** 2 + 2j * 0.01 * f / 40.0) - small_mode)

    modes = replace(analysis.identify([curve(0.01)]), frequency=np.array([79.0]), damping=np.array([0.01]))
    [raised] = peak_changes(modes, [curve(0.01)], [curve(0.004)])
    [lost] = peak_changes(modes, [curve(0.01)], [curve(0.5)])
    assert raised.baseline.frequency == pytest.approx(79.0, abs=1.0) and not raised.baseline.at_end
    assert raised.decibel[1] > 0.0
    assert lost.decibel[1:] == (-math.inf, math.inf)
    assert "no peak is left between" in describe_changes([lost], ("µm/N", 1e6))[-1]
    assert peak_changes(modes, [curve(0.5)], [curve(0.01)]) == []


def test_peak_among_omitted_frequencies_is_not_compared() -> None:
    f = np.linspace(5.0, 30.0, 251)
    curve = measured_curve(f, two_modes(f, 10.0, 0.02), 1e-3)
    gap = (f > 9.0) & (f < 12.0)
    changes = peak_changes(analysis.identify([curve]), [curve], [replace(curve.at(~gap), omitted=f[gap])])
    assert [change.mode for change in changes] == pytest.approx([20.0], rel=1e-3)


@pytest.mark.usefixtures("undrawn_figures")
def test_reason_names_recording_with_omitted_frequencies(tmp_path) -> None:
    sweep = {"kind": "swept_sine", "from": "8 Hz", "to": "40 Hz", "duration": "20 s", "force": "1 N"}
    scene = rig.loads(ONE_BODY, where="a test").replace(test=sweep)
    # The reading exceeds the range of 10 V near the resonance, 18 Hz.
    daq.record(scene, tmp_path / "complete.mcap")
    daq.record(scene.replace(converter={"rate": "1024 Hz", "range": "10 V"}), tmp_path / "overloaded.mcap")
    comparison = compare_peaks([tmp_path / "complete.mcap", tmp_path / "overloaded.mcap"])
    assert comparison.lines[-1].endswith(
        "Hz: not compared: frequencies near this mode were omitted in overloaded.mcap (see the warnings)"
    )


def test_shared_sensors_cancel_in_changes() -> None:
    f = np.linspace(9.0, 11.0, 81)
    bare, damped = (
        curve.with_limits({SENSITIVITY: 0.15 * abs(curve.value)})
        for curve in (measured_curve(f, two_modes(f, 10.0, ratio)) for ratio in (0.01, 0.02))
    )
    modes = analysis.identify([bare])
    [different_sensors], [same_sensors] = (peak_changes(modes, [bare], [damped], shared) for shared in ((), ("body1",)))
    assert (
        same_sensors.baseline == different_sensors.baseline
        and same_sensors.baseline.expanded > 0.15 * same_sensors.baseline.value
    )
    assert different_sensors.decibel[2] - different_sensors.decibel[1] > 3.5
    # A common factor does not move a peak.
    assert different_sensors.shift == same_sensors.shift
    dense = np.linspace(9.0, 11.0, 80001)
    true_change = 20.0 * math.log10(abs(two_modes(dense, 10.0, 0.02)).max() / abs(two_modes(dense, 10.0, 0.01)).max())
    assert same_sensors.decibel[1] <= true_change <= same_sensors.decibel[2]
    assert same_sensors.decibel[2] - same_sensors.decibel[1] < 0.1


def test_intervals_of_changes_cover_drawn_sensor_errors() -> None:
    random = np.random.default_rng(3)
    f, dense = np.linspace(9.2, 10.7, 31), np.linspace(9.8, 10.2, 40001)
    exact = [abs(two_modes(dense, 10.0, ratio)) for ratio in (0.01, 0.02)]
    tops = [curve.argmax() for curve in exact]
    true_change = 20.0 * math.log10(exact[1][tops[1]] / exact[0][tops[0]])
    true_shift = float(dense[tops[1]] - dense[tops[0]])
    scatter, sensor, force_sensor = 1e-2, 0.02, 0.01

    def measured(ratio: float) -> Response:
        error, force_error = random.uniform(-1.0, 1.0, 2) * (sensor, force_sensor)
        value = two_modes(f, 10.0, ratio)
        error_of_mean = scatter * abs(value)
        noise = error_of_mean * (random.standard_normal(f.size) + 1j * random.standard_normal(f.size))
        reading = (value + noise) * (1.0 + error) / (1.0 + force_error)
        tolerance = (1.0 + force_sensor) / (1.0 - sensor) - 1.0
        budget = UncertaintyBudget.of(
            error_of_mean, np.full(f.size, 100.0), {SENSITIVITY: tolerance * abs(reading)}, scale=force_sensor
        )
        return Response.curve(f, reading, "body1", uncertainty=budget)

    changes = []
    for _ in range(200):
        bare, damped = (peak(measured(ratio), 9.2, 10.7) for ratio in (0.01, 0.02))
        assert bare is not None and damped is not None
        changes.append(PeakChange("body1", 10.0, 0.01, bare, damped))
    heights_inside = [change.decibel[1] <= true_change <= change.decibel[2] for change in changes]
    shifts_inside = [change.shift[1] <= true_shift <= change.shift[2] for change in changes]
    assert 0.9 <= np.mean(heights_inside) <= 0.99
    assert 0.9 <= np.mean(shifts_inside) <= 0.99


@pytest.mark.usefixtures("undrawn_figures")
def test_same_structure_shows_no_change(tmp_path) -> None:
    frequencies = np.unique(np.append(np.linspace(8.0, 60.0, 105), [13.0366, 34.7773, 49.6628]))
    path = synthetic.stepped_sine(tmp_path / "a.mcap", frequencies)
    with daq.open(path) as rec:
        [curves] = analysis.frequency_responses(rec)
    changes = peak_changes(analysis.identify(curves), curves, curves)
    assert len(changes) == 9  # three responses, three modes
    for change in changes:
        value, low, high = change.decibel
        assert low <= value == 0.0 <= high and change.shift[0] == 0.0
        assert change.equivalent_damping == pytest.approx(0.005, rel=2e-3)
    coarse_path = synthetic.stepped_sine(tmp_path / "b.mcap", np.linspace(8.0, 60.0, 105))
    run = CliRunner().invoke(app, ["compare", str(coarse_path), str(path)])
    assert run.exit_code == 0 and len(re.findall(r"^  body\d ", run.output, re.MULTILINE)) == 9
    assert (tmp_path / "b+a-compare.csv").read_text(encoding="utf-8").count("\n") == 10  # with the header
    assert "warning: b.mcap: 13.04 Hz: fewer than two measured points" in run.stderr
    assert CliRunner().invoke(app, ["compare", str(path)]).exit_code != 0


def test_dominant_peak_without_mode_is_mentioned() -> None:
    f = np.linspace(5.0, 30.0, 251)
    curve = measured_curve(f, two_modes(f, 10.0, 0.02), 1e-3)
    modes = analysis.identify([curve])
    assert modes.frequency == pytest.approx([10.0, 20.0], rel=1e-3)
    assert uncompared_highest_peaks(modes, [curve]) == []
    second_mode = replace(modes, frequency=modes.frequency[1:])
    [message] = uncompared_highest_peaks(second_mode, [curve])
    assert message.startswith(
        "body1: the highest peak, at 10.00 Hz (1 times as high as the compared peaks), is not compared"
    )


@pytest.mark.parametrize(("at_peak", "is_known"), [(0.95, True), (1.05, False), (1.4, False)])
def test_peak_beyond_take_off_is_lower_bound(at_peak, is_known) -> None:
    f = 10.0 + 0.25 * (np.arange(-8, 8) + 0.4)
    value = two_modes(f, 10.0, 0.01)
    exact = abs(two_modes(np.linspace(9.9, 10.1, 2001), 10.0, 0.01)).max()
    estimate = peak(replace(measured_curve(f, value), loading=at_peak * abs(value) / exact), 9.0, 11.0)
    assert estimate is not None and math.isfinite(estimate.expanded) == is_known
    assert estimate.value == pytest.approx(exact if is_known else abs(value).max(), rel=1e-2)
    assert estimate.loading == pytest.approx(0.0 if is_known else at_peak, rel=2e-2)


def test_damper_in_flight_between_points_is_reported(tmp_path) -> None:
    tones = {"kind": "stepped_sine", "from": "16 Hz", "to": "20 Hz", "points": 13, "spacing": "linear"}
    dampers = [{"body": 1, "mass": "50 g", "clearance": "2 mm"}]
    scene = rig.loads(ONE_BODY, where="a test").replace(dampers=dampers)
    remarks, loading = [], []
    for force in ("0.09 N", "0.14 N"):
        path = daq.record(scene.replace(test={**tones, "force": force}), tmp_path / f"{force}.mcap")
        [response] = analysis.frequency_responses(path)
        remarks.append(" ".join(describe_frfs(response.curves())))
        loading.append(response.loading)
        acceleration = response.amplitude * abs(response["a"].to("acceleration").value) / scene.gravity
        np.testing.assert_allclose(loading[-1], acceleration, rtol=1e-9)
    assert max(loading[1]) < 1.0
    assert "the peak between the points" in remarks[0] and "times that at which" not in remarks[0]
    assert "the peak between the points" not in remarks[1] and "times that at which" in remarks[1]
    with pytest.raises(rig.SceneError, match="do not resolve the response"):
        response.interpolated(17.6)


@pytest.mark.parametrize("is_linear", [True, False])
def test_text_names_linear_points_only_if_linear(is_linear) -> None:
    f = 10.0 + 0.25 * (np.arange(-8, 8) + 0.4)
    value = two_modes(f, 10.0, 0.01)
    loading = abs(value) / abs(value).max() * (0.9 if is_linear else 1.1)
    text = " ".join(describe_frfs([replace(measured_curve(f, value, 1e-4), loading=loading)]))
    assert ("All points show linear motion" in text) == is_linear
    assert ("acts at some of these points" in text) != is_linear
    assert ("divide the level" in text) == is_linear


def test_missing_line_keeps_peak_beyond_take_off() -> None:
    f = 10.0 + 0.25 * (np.arange(-8, 8) + 0.4)
    value = two_modes(f, 10.0, 0.01)
    curve = replace(measured_curve(f, value, 1e-4), loading=0.9 * abs(value) / abs(value).max())
    f, value, loading = (np.insert(column, 8, gap) for column, gap in ((f, 10.02), (value, np.nan), (curve.loading, 0)))
    for incomplete in (curve, replace(measured_curve(f, value, 1e-4), loading=loading)):
        with pytest.raises(rig.SceneError, match="do not resolve the response"):
            incomplete.interpolated(10.0)


@pytest.mark.parametrize("count", [0, 1])
def test_few_lines_have_no_loading_between(count: int) -> None:
    lines = np.arange(10.0, 10.0 + count)
    curve = replace(measured_curve(lines, 1e-4 + 0j * lines), loading=0.5 + 0.0 * lines)
    assert curve.loading_beyond(np.array([10.0]), np.array([1.0])).tolist() == [0.0]
