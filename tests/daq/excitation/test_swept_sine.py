"""Force control during a sweep, measured by an independent lock-in on the channels."""

from typing import Any

import numpy as np
import pytest

import rig
from daq.core.excitation.controlled import spring_force
from daq.core.excitation.profiles.pretest import pretest
from daq.core.excitation.station import Station
from daq.core.excitation.tones.nearest_mode import NearestMode
from rig.core.base.arrays import Array
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

ONE_BODY = """
structure: {masses: [1 kg], springs: [20 kN/m], damping: {modal: 0.5 %}}
shaker: {kind: electrodynamic, body: 1, spring: 6 kN/m}
test: {kind: swept_sine, from: 26 Hz, to: 22 Hz, duration: 10 s, force: 2 N}
channels: [{name: body1, at: body 1}, {name: table, at: table}]
"""
# The readings of both sensors are about one count of a converter with a range of 10 V.
INSENSITIVE = """
structure: {masses: [1 kg], springs: [100 kN/m], damping: {modal: 1 %}}
shaker: {kind: table, body: 1, spring: 20 kN/m}
test: {kind: swept_sine, from: 20 Hz, to: 100 Hz, duration: 1 s, force: 0.4 N}
channels:
- {name: body1, at: body 1, accelerometer: {sensitivity: 0.01 mV/g}}
- {name: table, at: table, accelerometer: {sensitivity: 0.01 mV/g}}
"""


def force_ratios(bench_run: BenchRun) -> Array:
    """Return force amplitude over level along a logarithmic sweep, in overlapping Hann windows of four periods."""
    first, stop, fields = bench_run.marks_of("measure")[0]
    rate, log_ratio = bench_run.bench.rate, np.log(fields["to"] / fields["from"])
    fraction = np.arange(stop - first) / (stop - first)
    frequency = fields["from"] * np.exp(log_ratio * fraction)
    phase = 2 * np.pi * fields["duration"] * fields["from"] * np.expm1(log_ratio * fraction) / log_ratio
    ratios, start = [], 0
    while (length := round(4 * rate / frequency[start])) < fraction.size - start:
        demodulation = np.hanning(length) * np.exp(-1j * phase[start : start + length])
        samples = bench_run.readings[:, first + start : first + start + length]
        samples = samples - samples.mean(axis=1, keepdims=True)
        amplitudes = 2 * (samples @ demodulation) / np.hanning(length).sum()
        force = amplitudes @ bench_run.force_weights(frequency[start + length // 2])
        ratios.append(abs(force) / fields["level"])
        start += length // 2
    return np.array(ratios)


def sweep(first: float, last: float, duration: float, force: float) -> dict[str, Any]:
    """Return a swept-sine test; frequencies in Hz, duration in s, force in N."""
    return {"kind": "swept_sine", "from": first, "to": last, "duration": duration, "force": force}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("scene", "band"),
    [
        ("bare-structure", (12.5, 15.5)),
        ("bare-structure", (15.5, 12.5)),
        ("fig8-no-damper", (12.5, 15.5)),
        ("fig8-three-dampers", (15.5, 12.5)),
    ],
)
def test_force_is_controlled_at_sharp_resonance(scene: str, band: tuple[float, float]) -> None:
    bench_run = run(rig.load(scene).replace(test=sweep(*band, duration=15.0, force=2.6)))
    ratios = force_ratios(bench_run)
    assert ratios.size > 90
    assert np.abs(ratios - 1.0).max() < 0.12
    assert np.mean(np.abs(ratios - 1.0) > 0.05) < 0.1


def test_downward_sweep_holds_force() -> None:
    assert np.abs(force_ratios(run(rig.loads(ONE_BODY))) - 1.0).max() < 0.1


@pytest.mark.thorough
def test_current_amplifier_holds_force_at_shaker_resonance() -> None:
    scene = rig.load("fig8-no-damper")
    shaker = scene.shaker.model_dump() | {"amplifier": {"mode": "current", "gain": "1 A/V"}}
    bench_run = run(scene.replace(shaker=shaker, test=sweep(42.0, 46.0, duration=5.0, force=2.6)))
    assert np.abs(force_ratios(bench_run) - 1.0).max() < 0.1


def test_force_below_level_is_marked() -> None:
    scene = rig.load("fig8-no-damper")
    shaker = scene.shaker.model_dump() | {"amplifier": {"limit": "2 V"}}
    bench_run = run(scene.replace(shaker=shaker, test=sweep(11.0, 14.0, duration=15.0, force=2.6)))
    first, stop, _ = bench_run.marks_of("measure")[0]
    level_marks = bench_run.marks_of("level")
    assert level_marks and all(first <= begin < end <= stop for begin, end, _ in level_marks)
    # At its limit of 2 V, the amplifier yields less than 80 % of the level at the resonance.
    assert min(fields["worst"] for _, _, fields in level_marks) < 0.8
    assert bench_run.marks_of("measure")[0][2]["lowest"] < 0.8
    assert np.abs(bench_run.drive).max() <= 2.0 * (1 + 1e-12)
    assert len(bench_run.warnings) == 1 and "from its level of 2.6 N by more than 10 %" in bench_run.warnings[0]


def test_pretest_estimates_response_of_table() -> None:
    scene = scene_with(sweep(10.0, 40.0, duration=20.0, force=2.6))
    shaker_laws = []

    def only_pretest(station: Station) -> Any:
        shaker_laws.append((yield from pretest(station, spring_force(station), 10.0, 40.0, 2.6)))

    run(scene, make_excitation=only_pretest)
    for frequency in (10.0, 20.0, 40.0):
        s = 2j * np.pi * frequency
        per_force, per_motion = shaker_laws[0].at(s)
        # The servo of the table is critically damped with its corner at 400 Hz.
        servo = (1 + s / (2 * np.pi * 400.0)) ** 2
        assert per_motion == pytest.approx(servo, rel=3e-3)
        assert per_force * scene.shaker.spring == pytest.approx(per_motion, rel=1e-3)


def test_mode_is_identified_before_its_resonance() -> None:
    # A sweep of 0.37 Hz/s from 10 to 12 Hz towards a mode at 13 Hz, observed every 0.04 s. The motion is that of the
    # exact solution for a constant force.
    mode, pole, gain, residual_term = NearestMode(), (-0.005 + 1j) * 2 * np.pi * 13.0, -9e-4j, 3e-5
    envelope, interval, sweep_rate, force = 0j, 0.04, 0.37, 2.6
    frequencies = np.arange(10.0, 12.0, sweep_rate * interval)
    for observation, frequency in enumerate(frequencies):
        relative_pole = pole - 2j * np.pi * frequency
        forced = gain * np.expm1(relative_pole * interval) / relative_pole * force
        envelope = np.exp(relative_pole * interval) * envelope + forced
        angular_frequency = 2 * np.pi * (frequency + sweep_rate * interval / 2)
        motion = envelope + residual_term * force
        mode.add((observation + 1) * interval, angular_frequency, motion, force + 0j, memory=0.8)
    assert mode.pole.imag / (2 * np.pi) == pytest.approx(13.0, rel=0.02)
    assert mode.gain == pytest.approx(gain, rel=0.1)


@pytest.mark.parametrize(
    ("volts", "warning"), [(10.0, "did not change in the pretest"), (0.2, "At times the signals are below one count")]
)
def test_readings_below_a_count_are_reported(volts: float, warning: str) -> None:
    scene = rig.loads(INSENSITIVE).replace(converter={"rate": 2048.0, "bits": 16, "range": volts})
    bench_run = run(scene)
    first, stop, _ = bench_run.marks_of("measure")[0]
    assert stop - first == 2048  # the complete sweep of 1 s
    assert np.isfinite(bench_run.drive).all()
    assert warning in bench_run.warnings[-1]
