"""Force control during a sweep, measured by an independent lock-in on the channels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import rig
from daq.excitation.nearest_mode import NearestMode
from daq.excitation.pretest import pretest
from daq.excitation.station import Station
from rig.arrays import Array
from tests.daq.measurement.bench_run import BenchRun, run, scene_with

ONE_BODY = """
structure: {masses: [1 kg], springs: [20 kN/m], damping: {modal: 0.5 %}}
shaker: {kind: electrodynamic, body: 1, spring: 6 kN/m}
test: {kind: swept_sine, from: 26 Hz, to: 18 Hz, duration: 20 s, force: 2 N}
channels: [{name: body1, at: body 1}, {name: table, at: table}]
"""
BELOW_COUNT = """
structure: {masses: [1 kg], springs: [100 kN/m], damping: {modal: 1 %}}
shaker: {kind: table, body: 1, spring: 20 kN/m}
test: {kind: swept_sine, from: 20 Hz, to: 100 Hz, duration: 1 s, force: 0.4 N}
channels:
- {name: body1, at: body 1, accelerometer: {sensitivity: 0.01 mV/g}}
- {name: table, at: table, accelerometer: {sensitivity: 0.01 mV/g}}
"""


def force_over_level(bench_run: BenchRun) -> Array:
    """Force over level all along a logarithmic sweep, in windows of four periods under Hann's."""
    first, stop, fields = bench_run.marked("measure")[0]
    rate, stretch = bench_run.bench.rate, np.log(fields["to"] / fields["from"])
    part = np.arange(stop - first) / (stop - first)
    frequency = fields["from"] * np.exp(stretch * part)
    turns = fields["duration"] * fields["from"] * np.expm1(stretch * part) / stretch
    ratios, start = [], 0
    while (size := round(4 * rate / frequency[start])) < part.size - start:
        window = slice(start, start + size)
        taper = np.hanning(size) * np.exp(-2j * np.pi * turns[window])
        samples = bench_run.readings[:, first + start : first + start + size]
        samples = samples - samples.mean(axis=1, keepdims=True)
        amplitudes = 2 * (samples @ taper) / np.hanning(size).sum()
        ratios.append(abs(amplitudes @ bench_run.weights(frequency[start + size // 2])) / fields["level"])
        start += size // 2
    return np.array(ratios)


def sweep(first: float, last: float, duration: float, force: float) -> dict[str, Any]:
    return {"kind": "swept_sine", "from": first, "to": last, "duration": duration, "force": force}


@pytest.mark.thorough
@pytest.mark.parametrize("scene", ["bare-structure", "fig8-no-damper", "fig8-three-dampers"])
@pytest.mark.parametrize("band", [(11.0, 17.0), (17.0, 11.0)])
def test_force_is_controlled_at_sharp_resonance(scene: str, band: tuple[float, float]) -> None:
    completed = run(rig.load(scene).replace(test=sweep(*band, duration=30.0, force=2.6)))
    ratios = force_over_level(completed)
    assert ratios.size > 100
    assert np.abs(ratios - 1.0).max() < 0.12
    assert np.mean(np.abs(ratios - 1.0) > 0.05) < 0.1


def test_falling_sweep_holds_force() -> None:
    assert np.abs(force_over_level(run(rig.loads(ONE_BODY))) - 1.0).max() < 0.1


@pytest.mark.thorough
def test_current_mode_holds_force_at_own_resonance() -> None:
    scene = rig.load("fig8-no-damper")
    shaker = scene.shaker.model_dump() | {"amplifier": {"mode": "current", "gain": "1 A/V"}}
    completed = run(scene.replace(shaker=shaker, test=sweep(38.0, 50.0, duration=15.0, force=2.6)))
    assert np.abs(force_over_level(completed) - 1.0).max() < 0.1


def test_weak_amplifier_marks_the_stretch() -> None:
    scene = rig.load("fig8-no-damper")
    shaker = scene.shaker.model_dump() | {"amplifier": {"limit": "2 V"}}
    completed = run(scene.replace(shaker=shaker, test=sweep(11.0, 14.0, duration=15.0, force=2.6)))
    first, stop, _ = completed.marked("measure")[0]
    marked = completed.marked("level")
    assert marked and all(first <= begin < end <= stop for begin, end, _ in marked)
    assert min(fields["worst"] for _, _, fields in marked) < 0.8
    assert completed.marked("measure")[0][2]["lowest"] < 0.8
    assert np.abs(completed.drive).max() <= 2.0 * (1 + 1e-12)
    assert len(completed.warnings) == 1 and "from its level of 2.6 N by more than 10%" in completed.warnings[0]


def test_table_law_is_its_displacement() -> None:
    scene = scene_with(sweep(10.0, 40.0, duration=20.0, force=2.6))
    laws = []

    def only_pretest(station: Station) -> Any:
        laws.append((yield from pretest(station, 10.0, 40.0, 2.6)))

    run(scene, excite=only_pretest)
    for frequency in (10.0, 20.0, 40.0):
        s = 2j * np.pi * frequency
        per_force, per_motion = laws[0].at(s)
        # The servo of the table is critically damped with its corner at 400 Hz.
        servo = (1 + s / (2 * np.pi * 400.0)) ** 2
        assert per_motion == pytest.approx(servo, rel=3e-3)
        assert per_force * scene.shaker.spring == pytest.approx(per_motion, rel=1e-3)


def test_next_mode_is_known_in_time() -> None:
    mode, pole, gain, rest = NearestMode(), (-0.005 + 1j) * 2 * np.pi * 13.0, -9e-4j, 3e-5
    envelope, step = 0j, 0.04
    frequencies = np.arange(10.0, 12.0, 0.37 * step)
    for look, frequency in enumerate(frequencies):
        decay = pole - 2j * np.pi * frequency
        envelope = np.exp(decay * step) * envelope + gain * np.expm1(decay * step) / decay * 2.6
        turn = 2 * np.pi * (frequency + 0.37 * step / 2)
        mode.add((look + 1) * step, turn, envelope + rest * 2.6, 2.6 + 0j, memory=0.8)
    assert mode.pole.imag / (2 * np.pi) == pytest.approx(13.0, rel=0.02)
    assert mode.gain == pytest.approx(gain, rel=0.1)


@pytest.mark.parametrize(("volts", "reported"), [(10.0, "read nothing of the pretest"), (0.2, "less than one count")])
def test_readings_below_a_count_end_sweep(volts: float, reported: str) -> None:
    scene = rig.loads(BELOW_COUNT).replace(converter={"rate": 2048.0, "bits": 16, "range": volts})
    completed = run(scene)
    first, stop, _ = completed.marked("measure")[0]
    assert stop - first == 2048
    assert np.isfinite(completed.drive).all()
    assert reported in completed.warnings[-1]
