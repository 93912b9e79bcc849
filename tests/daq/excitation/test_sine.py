"""Sine tests on the virtual bench: a single tone, stepped and swept, and the estimates of a tone's amplitude."""

from typing import Any

import numpy as np
import pytest

import rig
from daq.core.excitation.lock_in import lock_in, min_samples, whole_periods
from daq.core.excitation.profiles.sweep_control import estimate_amplitudes, observation_samples
from daq.core.excitation.station import Station
from rig.core.base.errors import SceneError
from rig.core.system.structural_model import receptance
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

RATE = 5120  # sample rate of the scenes, Hz
FORCE = 2.6  # level of the tests, N
FORCE_ERROR = 0.006  # tolerance of the control, 0.5 %, and error of the estimate
# Hz: off resonance, at the resonances of the structure alone and with the shaker's spring, and at antiresonances.
FREQUENCIES = [10.0, 13.037, 13.811, 25.0, 28.6, 34.777, 43.6, 49.663, 57.9]


def compliance(bench_run: BenchRun) -> tuple[np.ndarray, np.ndarray]:
    """Return measured and exact compliance of all bodies, m/N (bodies, frequencies)."""
    columns = []
    frequencies = np.array([fields["frequency"] for _, _, fields in bench_run.marks_of("measure")])
    for first, stop, fields in bench_run.marks_of("measure"):
        frequency = fields["frequency"]
        amplitudes = bench_run.amplitudes(first, stop, frequency)
        force = amplitudes @ bench_run.force_weights(frequency)
        columns.append([amplitudes[row] * bench_run.displacement_factor(row, frequency) / force for row in range(3)])
    return np.array(columns).T, receptance(bench_run.bench.scene, frequencies)


def test_stepped_compliance_is_exact() -> None:
    bench_run = run(scene_with({"kind": "stepped_sine", "frequencies": FREQUENCIES, "force": "2.6 N"}))
    measured, exact = compliance(bench_run)
    error = measured / exact - 1.0
    assert len(bench_run.marks_of("measure")) == len(FREQUENCIES)
    assert np.abs(error).max() < 0.002
    assert np.abs(np.angle(1.0 + error, deg=True)).max() < 0.1  # degrees
    for first, stop, fields in bench_run.marks_of("measure"):
        assert fields["settled"] is True
        assert abs(bench_run.spring_force(first, stop, fields["frequency"])) == pytest.approx(FORCE, rel=FORCE_ERROR)
        assert fields["force"] == pytest.approx(FORCE, rel=FORCE_ERROR)
        assert stop - first == round(20 * RATE / fields["frequency"])  # 20 periods by default
    assert not bench_run.warnings


def test_stepped_drive_is_continuous() -> None:
    bench_run = run(scene_with({"kind": "stepped_sine", "frequencies": [20.0, 21.0, 40.0], "force": "2.6 N"}))
    drive = bench_run.drive[0]
    largest = np.abs(drive).max()
    # The second difference of a 40 Hz tone is (2 pi f / rate)^2 times its amplitude; a jump has a larger one.
    assert np.abs(np.diff(drive, 2)).max() < 1.3 * (2 * np.pi * 40.0 / RATE) ** 2 * largest
    assert drive[0] == 0.0
    assert abs(drive[-1]) < 1e-4 * largest


def test_electrodynamic_shaker_holds_force() -> None:
    scene = rig.load("fig8-no-damper")
    test = {"kind": "stepped_sine", "frequencies": [12.0, 20.0, 34.777], "force": "2.6 N"}
    bench_run = run(scene.replace(test=test))
    measured, exact = compliance(bench_run)
    assert np.abs(measured[0] / exact[0] - 1.0).max() < 0.005
    for first, stop, fields in bench_run.marks_of("measure"):
        assert abs(bench_run.spring_force(first, stop, fields["frequency"])) == pytest.approx(FORCE, rel=FORCE_ERROR)


def test_three_dampers_hold_force_at_resonance() -> None:
    scene = rig.load("fig8-three-dampers")
    test = {"kind": "stepped_sine", "from": "47 Hz", "to": "52 Hz", "points": 6, "force": "2.6 N"}
    bench_run = run(scene.replace(test=test))
    forces = [fields["force"] for _, _, fields in bench_run.marks_of("measure") if fields["settled"]]
    assert len(forces) >= 5
    assert forces == pytest.approx([FORCE] * len(forces), rel=0.02)


def test_levels_and_directions_run_in_order() -> None:
    test = {
        "kind": "stepped_sine", "frequencies": [25.0, 26.0], "force": ["1 N", "2 N"], "direction": "both",
        "measure": {"periods": 5},
    }  # fmt: skip
    bench_run = run(scene_with(test))
    steps = [(f["level"], f["direction"], f["frequency"]) for _, _, f in bench_run.marks_of("measure")]
    steps_of_a_level = [("up", 25.0), ("up", 26.0), ("down", 26.0), ("down", 25.0)]
    assert steps == [(1.0, *step) for step in steps_of_a_level] + [(2.0, *step) for step in steps_of_a_level]
    # Progress after each of 8 steps.
    assert [fraction for fraction, _ in bench_run.reports] == [k / 8 for k in range(9)]


def test_unsettled_point_is_marked() -> None:
    test = {
        "kind": "stepped_sine", "frequencies": [13.037], "force": "2.6 N", "settle": {"longest": "2 s"},
    }  # fmt: skip
    bench_run = run(scene_with(test))
    assert bench_run.marks_of("measure")[0][2]["settled"] is False
    assert "1 of 1 dwells" in bench_run.warnings[0] and "(13.04 Hz up at 2.6 N)" in bench_run.warnings[0]


def test_amplifier_limit_is_reported() -> None:
    scene = rig.load("fig8-no-damper")
    shaker = scene.shaker.model_dump() | {"amplifier": {"limit": "0.5 V"}}
    test = {
        "kind": "stepped_sine", "frequencies": [20.0], "force": "2.6 N", "settle": {"longest": "6 s"},
        "measure": {"periods": 4},
    }  # fmt: skip
    bench_run = run(scene.replace(shaker=shaker, test=test))
    assert np.abs(bench_run.drive).max() <= 0.5 * (1 + 1e-12)
    assert bench_run.marks_of("measure")[0][2]["settled"] is False
    assert "the drive is at the limit of the amplifier, 0.5 V (20 Hz up at 2.6 N)" in bench_run.warnings[0]


def test_force_shaker_is_driven_by_force() -> None:
    test = {"kind": "stepped_sine", "frequencies": [20.0, 40.0], "force": "2.6 N"}
    bench_run = run(scene_with(test, shaker={"kind": "force", "body": 1}))
    for first, stop, fields in bench_run.marks_of("measure"):
        row = [channel.quantity for channel in bench_run.bench.channels].index("force")
        amplitudes = bench_run.amplitudes(first, stop, fields["frequency"])
        force = amplitudes[row] / bench_run.bench.channels[row].response(fields["frequency"])
        assert abs(force) == pytest.approx(FORCE, rel=1e-3)
        exact = receptance(bench_run.bench.scene, np.array([fields["frequency"]]))[0, 0]
        motion = amplitudes[0] * bench_run.displacement_factor(0, fields["frequency"])
        assert abs(motion / force / exact - 1.0) < 0.002


def test_open_loop_drive_moves_table() -> None:
    test = {"kind": "stepped_sine", "frequencies": [20.0], "drive": "0.2 mm"}
    bench_run = run(scene_with(test))
    first, stop, fields = bench_run.marks_of("measure")[0]
    assert fields["drive"] == 0.2e-3
    assert np.abs(bench_run.drive[0, first:stop]).max() == pytest.approx(0.2e-3, rel=1e-3)


def test_missing_table_channel_is_reported() -> None:
    test = {"kind": "stepped_sine", "frequencies": [20.0], "force": "2.6 N"}
    with pytest.raises(SceneError, match="requires a motion channel at the table"):
        run(scene_with(test, channels=[{"name": "body1", "at": "body 1"}]))


def test_block_size_does_not_change_stepped_sine() -> None:
    test = {"kind": "stepped_sine", "frequencies": [49.6], "force": "2.6 N", "measure": {"periods": 5}}
    scene = rig.load("fig8-three-dampers").replace(test=test)
    undivided_run, divided_run = run(scene), run(scene, max_block=101)
    np.testing.assert_array_equal(undivided_run.drive, divided_run.drive)
    np.testing.assert_array_equal(undivided_run.readings, divided_run.readings)
    assert undivided_run.marks == divided_run.marks


def test_open_loop_tone_starts_with_sine() -> None:
    test = {"kind": "sine", "frequency": "218.8 rad/s", "force": "2.6 N", "duration": "0.5 s", "start": "empty"}
    bench_run = run(scene_with(test, shaker={"kind": "force", "body": 1}))
    time = np.arange(RATE // 2) / RATE
    np.testing.assert_allclose(bench_run.drive[0], FORCE * np.sin(218.8 * time), rtol=0, atol=1e-11)
    assert bench_run.marks_of("measure")[0][2]["settled"] is False


def test_controlled_tone_has_its_duration() -> None:
    bench_run = run(scene_with({"kind": "sine", "frequency": 25.0, "force": "2.6 N", "duration": "1 s"}))
    first, stop, fields = bench_run.marks_of("measure")[0]
    assert stop - first == RATE
    assert fields["settled"] is True
    assert abs(bench_run.spring_force(first, stop, 25.0)) == pytest.approx(FORCE, rel=FORCE_ERROR)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "sweep", [{"from": 15.0, "to": 23.0, "spacing": "log"}, {"from": 32.0, "to": 23.0, "spacing": "linear"}]
)
def test_frequency_and_force_follow_sweep(sweep: dict[str, Any]) -> None:
    bench_run = run(scene_with({"kind": "swept_sine", "force": "2.6 N", "duration": "10 s", **sweep}))
    first, stop, fields = bench_run.marks_of("measure")[0]
    assert stop - first == 10 * RATE
    assert (fields["from"], fields["to"], fields["duration"]) == (sweep["from"], sweep["to"], 10.0)
    for fraction in (0.1, 0.5, 0.9):
        middle = first + round(fraction * (stop - first))
        logarithmic = sweep["from"] * (sweep["to"] / sweep["from"]) ** fraction
        linear = sweep["from"] + (sweep["to"] - sweep["from"]) * fraction
        window = slice(middle - 512, middle + 512)
        zero_crossings = np.flatnonzero(np.diff(np.signbit(bench_run.drive[0, window]).astype(int)))
        frequency = RATE * (len(zero_crossings) - 1) / (zero_crossings[-1] - zero_crossings[0]) / 2
        assert frequency == pytest.approx(logarithmic if sweep["spacing"] == "log" else linear, rel=0.02)
        force = abs(bench_run.spring_force(middle - 256, middle + 256, frequency))
        assert force == pytest.approx(2.6, rel=0.1)
    assert np.abs(np.diff(bench_run.drive[0], 2)).max() < 0.01 * np.abs(bench_run.drive).max()


def test_lock_in_ignores_offset_and_drift() -> None:
    time = np.arange(1000) / RATE
    samples = (0.3 * np.cos(2 * np.pi * 17.3 * time - 1.1) + 5.0 - 40.0 * time)[None]
    assert lock_in(samples, [17.3], RATE)[0, 0] == pytest.approx(0.3 * np.exp(-1.1j), abs=1e-12)


@pytest.mark.parametrize("frequency", [8.0, 13.037, 49.663, 333.3])
def test_window_is_nearly_whole_periods(frequency: float) -> None:
    samples = whole_periods(frequency, RATE, 0.1)
    periods = samples * frequency / RATE
    assert periods >= 2 - 1e-3 and samples >= 0.1 * RATE - 1
    assert abs(periods - round(periods)) < 0.035  # rounding to whole samples at the highest frequency


@pytest.mark.parametrize("second", [24.0, 33.3, 40.0, 111.0])
def test_lock_in_separates_simultaneous_tones(second: float) -> None:
    rate, frequencies, phases = 2000.0, [20.0, second], np.array([0.4, 2.0])
    time = np.arange(min_samples(frequencies, rate)) / rate
    tones = np.cos(2 * np.pi * np.outer(frequencies, time) + phases[:, None])
    samples = tones[0] + 0.3 * tones[1] + 0.2 * np.cos(2 * np.pi * 80.0 * time) + 3.0 + time
    assert lock_in(samples[None], frequencies, rate, phases)[0] == pytest.approx(np.array([1.0, 0.3]), abs=1e-9)


def test_level_of_force_is_not_a_drive() -> None:
    scene = scene_with({"kind": "sine", "frequency": 20.0, "force": FORCE})
    station = Station(scene, (), (), RATE, mark=lambda *arguments, **fields: None)
    with pytest.raises(AssertionError, match="not a drive"):
        _ = station.drive_level


def test_lock_in_rejects_harmonics_and_drift() -> None:
    rate, frequency = 8192.0, 22.67
    n_samples = whole_periods(frequency, rate, 0.1)
    amplitudes = []
    for first in range(0, 400, 37):
        time = (first + np.arange(n_samples)) / rate
        phase = 2.0 * np.pi * frequency * time
        samples = np.cos(phase) + 0.7 * np.cos(3.0 * phase + 1.0) + 0.2 * np.sin(5.0 * phase) + 3.0 * time**2
        amplitudes.append(complex(lock_in(samples[None], [frequency], rate, phase[:1])[0, 0]))
    np.testing.assert_allclose(amplitudes, 1.0, atol=1e-3)


@pytest.mark.parametrize("samples_per_period", [2.02, 2.1, 2.3, 2.5, 3.0])
def test_amplitudes_near_nyquist_are_estimated(samples_per_period: float) -> None:
    rate, amplitude = 28.0, 0.3 * np.exp(-1.1j)
    frequency = rate / samples_per_period
    phase = 2 * np.pi / samples_per_period * np.arange(100)
    tone = np.real(amplitude * np.exp(1j * phase)) + 5.0 - 0.1 * np.arange(100)
    noisy_tone = tone + 1e-3 * np.random.default_rng(2).standard_normal(100)
    lock_in_window = slice(whole_periods(frequency, rate, 0.1))
    fit_window = slice(observation_samples(frequency, rate))
    for samples, tolerance in ((tone[None], 1e-9), (noisy_tone[None], 3e-3)):
        expected = pytest.approx(amplitude, abs=tolerance)
        assert lock_in(samples[:, lock_in_window], [frequency], rate)[0, 0] == expected
        assert estimate_amplitudes(samples[:, fit_window], phase[fit_window], rate)[0][0] == expected


def test_too_short_measurement_is_extended() -> None:
    step = {"kind": "stepped_sine", "frequencies": [40.0], "force": 2.6, "measure": {"periods": 1}}
    first, stop, fields = run(scene_with(step, converter={"rate": 92.0})).marks_of("measure")[0]
    # The minimum window has 8 samples; one period of 40 Hz has 2.3.
    assert stop - first == 8
    assert fields["force"] == pytest.approx(FORCE, rel=0.01)
