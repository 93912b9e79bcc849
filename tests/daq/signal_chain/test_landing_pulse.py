"""A finite-duration impact is a pulse of finite height in an accelerometer at any sample rate."""

from __future__ import annotations

import numpy as np
import pytest

import rig
from daq.virtual_bench.bench import Bench
from rig.system.assembly import assemble
from tests.rig.landing_force import peak_force

BODY = 0.8
DURATION = 2e-3
SENSITIVITY = 10e-3 / 9.80665


def landing(rate: float, limit: float) -> tuple[Bench, np.ndarray, np.ndarray, float, float]:
    """A body that is hit by a hammer, and its damper, which lands on it 2 to 4 ms later; no other forces act.

    Returns the bench, samples and overload of the accelerometer from the touch on, its time after the last sample
    before it, and the peak of the body's acceleration by the closed form.
    """
    scene = rig.loads(
        f"""
        structure: {{masses: [{BODY} kg], springs: [0 N/m]}}
        gravity: 0 m/s^2
        dampers: [{{body: 1, mass: 60 g, clearance: 0.5 mm, contact: {{duration: 2 ms}}, restitution: 0.8}}]
        test: {{kind: impulse, body: 1, peak: 400 N, width: 0.5 ms, repeats: 1}}
        channels: [{{name: a, at: body 1, accelerometer: {{sensitivity: 10 mV/g, resonance: 30 kHz}}}}]
        converter: {{rate: {rate}, range: {limit}}}
        """
    )
    bench = Bench(scene)
    time = np.arange(round(0.02 * rate)) / rate
    hit = np.where(time <= 0.5e-3, 400.0 * np.sin(np.pi * time / 0.5e-3), 0.0)
    block = bench.acquire(hit[None])
    events = block.motion.events
    touch = events[(events["kind"] == "touch") & (events["time"] > 1e-3)][0]
    system = assemble(scene)
    force = peak_force(
        system.wall_stiffness[0, 1], system.wall_damping[0, 1], float(system.reduced_mass[0]), float(touch["speed"])
    )
    first = int(touch["time"] * rate)
    last = int((touch["time"] + DURATION) * rate) + 2
    return (
        bench,
        block.samples[0, first:last],
        block.overload[0, first:last],
        touch["time"] * rate - first,
        force / BODY,
    )


@pytest.mark.parametrize("rate", [20480.0, 51200.0])
def test_landing_pulse_is_closed_form(rate: float) -> None:
    bench, samples, _, offset, peak = landing(rate, 10.0)
    pulse = np.abs(bench.physical(samples[None])[0])
    assert pulse.max() == pytest.approx(peak, rel=0.02)
    # The force begins with a step and falls straight to zero, where the sensor's pulse ends.
    end = np.flatnonzero(pulse > 0.05 * peak)[-1]
    fall = pulse[end - 1] - pulse[end]
    lasts = (end + pulse[end] / fall - offset) / rate
    assert lasts == pytest.approx(DURATION, rel=0.02)


@pytest.mark.parametrize(("share", "clips"), [(0.9, True), (1.1, False)])
def test_near_full_scale_landing_saturates_alike(share: float, clips: bool) -> None:
    peak = landing(51200.0, 10.0)[-1]
    for rate in (5120.0, 20480.0, 51200.0):
        assert landing(rate, share * peak * SENSITIVITY)[2].any() == clips
