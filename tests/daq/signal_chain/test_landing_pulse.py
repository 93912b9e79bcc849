"""The acceleration pulse of a damper's impact of finite duration: its closed form, and clipping at any sample rate."""

import numpy as np
import pytest

import rig
from daq.core.virtual_bench.bench import Bench
from rig.core.system.assembly import assemble
from tests.rig.landing_force import peak_force

BODY_MASS = 0.8  # kg
DURATION = 2e-3  # s
SENSITIVITY = 10e-3 / 9.80665  # V per m/s^2


def simulate_impact(rate: float, input_range: float) -> tuple[Bench, np.ndarray, np.ndarray, float, float]:
    """Simulate a body that a hammer hits; its damper touches the body 2 to 4 ms later. No other forces act.

    `rate` is in Hz, `input_range` of the converter in V.

    Returns
    -------
    bench
    samples, overload
        Of the accelerometer during the contact.
    offset
        Time from the first of these samples to the beginning of the contact, in samples.
    peak
        Peak acceleration of the body in closed form, m/s^2.
    """
    scene = rig.loads(
        f"""
        structure: {{masses: [{BODY_MASS} kg], springs: [0 N/m]}}
        gravity: 0 m/s^2
        dampers: [{{body: 1, mass: 60 g, clearance: 0.5 mm, contact: {{duration: 2 ms}}, restitution: 0.8}}]
        test: {{kind: impulse, body: 1, peak: 400 N, width: 0.5 ms, repeats: 1}}
        channels: [{{name: a, at: body 1, accelerometer: {{sensitivity: 10 mV/g, resonance: 30 kHz}}}}]
        converter: {{rate: {rate}, range: {input_range}}}
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
    stop = int((touch["time"] + DURATION) * rate) + 2
    return (
        bench,
        block.samples[0, first:stop],
        block.overload[0, first:stop],
        touch["time"] * rate - first,
        force / BODY_MASS,
    )


@pytest.mark.parametrize("rate", [20480.0, 51200.0])
def test_impact_pulse_has_closed_form(rate: float) -> None:
    bench, samples, _, offset, peak = simulate_impact(rate, 10.0)
    pulse = np.abs(bench.to_units(samples[None])[0])
    assert pulse.max() == pytest.approx(peak, rel=0.02)
    # The force begins with a step and finally decreases linearly to zero; extrapolate its last two samples.
    last = np.flatnonzero(pulse > 0.05 * peak)[-1]
    decrease = pulse[last - 1] - pulse[last]
    duration = (last + pulse[last] / decrease - offset) / rate
    assert duration == pytest.approx(DURATION, rel=0.02)


@pytest.mark.parametrize(("relative_range", "clips"), [(0.9, True), (1.1, False)])
def test_clipping_does_not_depend_on_rate(relative_range: float, clips: bool) -> None:
    peak = simulate_impact(51200.0, 10.0)[-1]
    for rate in (5120.0, 20480.0, 51200.0):
        assert simulate_impact(rate, relative_range * peak * SENSITIVITY)[2].any() == clips
