"""Sine tests: one tone, stepped, swept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rig
from daq.excitation.lock_in import lock_in, whole_periods
from daq.excitation.sweep_control import estimate_amplitudes, observation_samples
from rig.errors import SceneError
from rig.system.structural_model import receptance
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

# Off resonance, at the three resonances of the structure and of rig and structure, and in antiresonances.
FREQUENCIES = [10.0, 13.037, 13.811, 25.0, 28.6, 34.777, 43.6, 49.663, 57.9]


def compliance(bench_run: BenchRun) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies, measured compliance and exact compliance of all bodies."""
    columns = []
    frequencies = np.array([fields["frequency"] for _, _, fields in bench_run.marked("measure")])
    for first, stop, fields in bench_run.marked("measure"):
        frequency = fields["frequency"]
        amplitudes = bench_run.amplitudes(first, stop, frequency)
        force = amplitudes @ bench_run.weights(frequency)
        columns.append([amplitudes[row] * bench_run.to_displacement(row, frequency) / force for row in range(3)])
    return np.array(columns).T, receptance(bench_run.bench.scene, frequencies)


def test_stepped_compliance_is_exact() -> None:
    completed = run(scene_with({"kind": "stepped_sine", "frequencies": FREQUENCIES, "force": "2.6 N"}))
    measured, exact = compliance(completed)
    error = measured / exact - 1.0
    assert len(completed.marked("measure")) == len(FREQUENCIES)
    assert np.abs(error).max() < 0.002
    assert np.abs(np.angle(1.0 + error, deg=True)).max() < 0.1
    for first, stop, fields in completed.marked("measure"):
        assert fields["settled"] is True
        assert abs(completed.spring_force(first, stop, fields["frequency"])) == pytest.approx(2.6, rel=0.006)
        assert fields["force"] == pytest.approx(2.6, rel=0.006)
        assert stop - first == round(20 * 5120.0 / fields["frequency"])
    assert not completed.warnings


def test_stepped_drive_never_jumps() -> None:
    completed = run(scene_with({"kind": "stepped_sine", "frequencies": [20.0, 21.0, 40.0], "force": "2.6 N"}))
    drive = completed.drive[0]
    largest = np.abs(drive).max()
    # The second difference of a 40 Hz tone is (2 pi f / rate)^2 of its amplitude; a jump would exceed it.
    assert np.abs(np.diff(drive, 2)).max() < 1.3 * (2 * np.pi * 40.0 / 5120.0) ** 2 * largest
    assert drive[0] == 0.0
    assert abs(drive[-1]) < 1e-4 * largest


def test_electrodynamic_shaker_holds_force() -> None:
    scene = rig.load("fig8-no-damper")
    test = {"kind": "stepped_sine", "frequencies": [12.0, 20.0, 34.777], "force": "2.6 N"}
    completed = run(scene.replace(test=test))
    measured, exact = compliance(completed)
    assert np.abs(measured[0] / exact[0] - 1.0).max() < 0.005
    for first, stop, fields in completed.marked("measure"):
        assert abs(completed.spring_force(first, stop, fields["frequency"])) == pytest.approx(2.6, rel=0.006)


def test_three_dampers_hold_force_at_resonance() -> None:
    scene = rig.load("fig8-three-dampers")
    test = {"kind": "stepped_sine", "from": "47 Hz", "to": "52 Hz", "points": 6, "force": "2.6 N"}
    completed = run(scene.replace(test=test))
    forces = [fields["force"] for _, _, fields in completed.marked("measure") if fields["settled"]]
    assert len(forces) >= 5
    assert forces == pytest.approx([2.6] * len(forces), rel=0.02)


def test_levels_and_directions_run_in_order() -> None:
    test = {
        "kind": "stepped_sine", "frequencies": [25.0, 26.0], "force": ["1 N", "2 N"], "direction": "both",
        "measure": {"periods": 5},
    }  # fmt: skip
    completed = run(scene_with(test))
    reported = [(f["level"], f["direction"], f["frequency"]) for _, _, f in completed.marked("measure")]
    steps_of_a_level = [("up", 25.0), ("up", 26.0), ("down", 26.0), ("down", 25.0)]
    assert reported == [(1.0, *step) for step in steps_of_a_level] + [(2.0, *step) for step in steps_of_a_level]
    assert [fraction for fraction, _ in completed.reports] == [k / 8 for k in range(9)]


def test_unsettled_point_is_marked() -> None:
    test = {
        "kind": "stepped_sine", "frequencies": [13.037], "force": "2.6 N", "settle": {"longest": "2 s"},
    }  # fmt: skip
    completed = run(scene_with(test))
    assert completed.marked("measure")[0][2]["settled"] is False
    assert "1 of 1 steps" in completed.warnings[0] and "(13.04 Hz up at 2.6 N)" in completed.warnings[0]


def test_amplifier_limit_is_reported() -> None:
    scene = rig.load("fig8-no-damper")
    shaker = scene.shaker.model_dump() | {"amplifier": {"limit": "0.5 V"}}
    test = {
        "kind": "stepped_sine", "frequencies": [20.0], "force": "2.6 N", "settle": {"longest": "6 s"},
        "measure": {"periods": 4},
    }  # fmt: skip
    completed = run(scene.replace(shaker=shaker, test=test))
    assert np.abs(completed.drive).max() <= 0.5 * (1 + 1e-12)
    assert completed.marked("measure")[0][2]["settled"] is False


def test_force_shaker_is_driven_by_force() -> None:
    test = {"kind": "stepped_sine", "frequencies": [20.0, 40.0], "force": "2.6 N"}
    completed = run(scene_with(test, shaker={"kind": "force", "body": 1}))
    for first, stop, fields in completed.marked("measure"):
        row = [channel.quantity for channel in completed.bench.channels].index("force")
        amplitudes = completed.amplitudes(first, stop, fields["frequency"])
        force = amplitudes[row] / completed.bench.channels[row].response(fields["frequency"])
        assert abs(force) == pytest.approx(2.6, rel=1e-3)
        exact = receptance(completed.bench.scene, np.array([fields["frequency"]]))[0, 0]
        motion = amplitudes[0] * completed.to_displacement(0, fields["frequency"])
        assert abs(motion / force / exact - 1.0) < 0.002


def test_open_loop_drive_moves_table() -> None:
    test = {"kind": "stepped_sine", "frequencies": [20.0], "drive": "0.2 mm"}
    completed = run(scene_with(test))
    first, stop, fields = completed.marked("measure")[0]
    assert fields["drive"] == 0.2e-3
    assert np.abs(completed.drive[0, first:stop]).max() == pytest.approx(0.2e-3, rel=1e-3)


def test_missing_table_channel_is_reported() -> None:
    test = {"kind": "stepped_sine", "frequencies": [20.0], "force": "2.6 N"}
    with pytest.raises(SceneError, match="needs a channel at the table"):
        run(scene_with(test, channels=[{"name": "body1", "at": "body 1"}]))


def test_split_does_not_change_stepped_sine() -> None:
    test = {"kind": "stepped_sine", "frequencies": [49.6], "force": "2.6 N", "measure": {"periods": 5}}
    scene = rig.load("fig8-three-dampers").replace(test=test)
    unsplit, split = run(scene), run(scene, split=101)
    np.testing.assert_array_equal(unsplit.drive, split.drive)
    np.testing.assert_array_equal(unsplit.readings, split.readings)
    assert unsplit.marks == split.marks


def test_open_loop_tone_starts_with_sine() -> None:
    test = {"kind": "sine", "frequency": "218.8 rad/s", "force": "2.6 N", "duration": "0.5 s", "start": "empty"}
    completed = run(scene_with(test, shaker={"kind": "force", "body": 1}))
    time = np.arange(2560) / 5120.0
    np.testing.assert_allclose(completed.drive[0], 2.6 * np.sin(218.8 * time), rtol=0, atol=1e-11)
    assert completed.marked("measure")[0][2]["settled"] is False


def test_controlled_tone_has_its_duration() -> None:
    completed = run(scene_with({"kind": "sine", "frequency": 25.0, "force": "2.6 N", "duration": "1 s"}))
    first, stop, fields = completed.marked("measure")[0]
    assert stop - first == 5120
    assert fields["settled"] is True
    assert abs(completed.spring_force(first, stop, 25.0)) == pytest.approx(2.6, rel=0.006)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "sweep", [{"from": 15.0, "to": 32.0, "spacing": "log"}, {"from": 32.0, "to": 15.0, "spacing": "linear"}]
)
def test_frequency_and_force_follow_sweep(sweep: dict[str, Any]) -> None:
    completed = run(scene_with({"kind": "swept_sine", "force": "2.6 N", "duration": "20 s", **sweep}))
    first, stop, fields = completed.marked("measure")[0]
    assert stop - first == 20 * 5120
    assert (fields["from"], fields["to"], fields["duration"]) == (sweep["from"], sweep["to"], 20.0)
    for part in (0.1, 0.5, 0.9):
        middle = first + round(part * (stop - first))
        begin = sweep["from"] * (sweep["to"] / sweep["from"]) ** part
        expected = begin if sweep["spacing"] == "log" else sweep["from"] + (sweep["to"] - sweep["from"]) * part
        window = slice(middle - 512, middle + 512)
        crossings = np.flatnonzero(np.diff(np.signbit(completed.drive[0, window]).astype(int)))
        counted = 5120.0 * (len(crossings) - 1) / (crossings[-1] - crossings[0]) / 2
        assert counted == pytest.approx(expected, rel=0.02)
        force = abs(completed.spring_force(middle - 256, middle + 256, counted))
        assert force == pytest.approx(2.6, rel=0.1)
    assert np.abs(np.diff(completed.drive[0], 2)).max() < 0.01 * np.abs(completed.drive).max()


def test_lock_in_ignores_offset_and_drift() -> None:
    time = np.arange(1000) / 5120.0
    samples = (0.3 * np.cos(2 * np.pi * 17.3 * time - 1.1) + 5.0 - 40.0 * time)[None]
    assert lock_in(samples, 17.3, 5120.0)[0] == pytest.approx(0.3 * np.exp(-1.1j), abs=1e-12)


@pytest.mark.parametrize("frequency", [8.0, 13.037, 49.663, 333.3])
def test_window_is_nearly_whole_periods(frequency: float) -> None:
    samples = whole_periods(frequency, 5120.0, 0.1)
    periods = samples * frequency / 5120.0
    assert periods >= 2 - 1e-3 and samples >= 0.1 * 5120 - 1
    assert abs(periods - round(periods)) < 0.035


def test_short_window_survives_impacts_and_drift() -> None:
    rate, frequency = 8192.0, 22.67
    window = whole_periods(frequency, rate, 0.1)
    reported = []
    for begin in range(0, 400, 37):
        time = (begin + np.arange(window)) / rate
        turn = 2.0 * np.pi * frequency * time
        samples = np.cos(turn) + 0.7 * np.cos(3.0 * turn + 1.0) + 0.2 * np.sin(5.0 * turn) + 3.0 * time**2
        reported.append(complex(lock_in(samples[None], frequency, rate, float(turn[0]))[0]))
    np.testing.assert_allclose(reported, 1.0, atol=1e-3)


@pytest.mark.parametrize("ratio", [2.02, 2.1, 2.3, 2.5, 3.0])
def test_windows_near_nyquist_are_readable(ratio: float) -> None:
    rate, target = 28.0, 0.3 * np.exp(-1.1j)
    frequency = rate / ratio
    turn = 2 * np.pi / ratio * np.arange(100)
    tone = np.real(target * np.exp(1j * turn)) + 5.0 - 0.1 * np.arange(100)
    noisy = tone + 1e-3 * np.random.default_rng(2).standard_normal(100)
    locked, look = whole_periods(frequency, rate, 0.1), observation_samples(frequency, rate)
    for samples, error in ((tone[None], 1e-9), (noisy[None], 3e-3)):
        assert lock_in(samples[:, :locked], frequency, rate)[0] == pytest.approx(target, abs=error)
        assert estimate_amplitudes(samples[:, :look], turn[:look], rate)[0][0] == pytest.approx(target, abs=error)


def test_unreadable_period_is_measured_longer() -> None:
    step = {"kind": "stepped_sine", "frequencies": [40.0], "force": 2.6, "measure": {"periods": 1}}
    first, stop, fields = run(scene_with(step, converter={"rate": 92.0})).marked("measure")[0]
    assert stop - first == 8
    assert fields["force"] == pytest.approx(2.6, rel=0.01)
