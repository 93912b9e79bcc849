"""Errors of accelerometers: tolerance, drift, transverse sensitivity, bias, low cut-off, saturation and recovery."""

import numpy as np
import pytest

from daq.core.signal_chain.devices import accelerometer
from rig.core.scene.measurement_chain import Accelerometer
from tests.daq.dsp.analytic_motion import PointMotion, at_rest, chain_of, motion_of, scene_of


def read_constant(channel_keys, acceleration, count):
    """Return `count` readings of a constant acceleration, in the channel's unit."""
    chain, rate = chain_of(scene_of(channel_keys))
    motion = at_rest(1, rate, count)
    t = np.arange(count) / rate
    motion.acceleration[:], motion.velocity[:], motion.displacement[:] = (
        acceleration,
        acceleration * t,
        acceleration * t * t / 2,
    )
    return chain.measure(motion)[0] / chain.channels[0].sensitivity


def test_sensitivities_are_uniform_within_tolerance():
    settings = Accelerometer(sensitivity="100 mV/g", sensitivity_tolerance="10 %")
    stages = [accelerometer(settings, seed, "c") for seed in range(400)]
    deviation = np.array([stage.deviation for stage in stages])
    assert np.abs(deviation).max() < 0.1
    # Standard deviation of a uniform distribution of half-width 0.1.
    assert deviation.std() == pytest.approx(0.1 / np.sqrt(3.0), rel=0.1)
    assert {stage.nominal for stage in stages} == {settings.sensitivity}
    assert accelerometer(settings, 3, "c") == accelerometer(settings, 3, "c")


def test_tolerance_changes_readings_not_stated_response():
    channel_keys = ", accelerometer: {sensitivity: 100 mV/g, sensitivity_tolerance: 10 %}"
    readings = read_constant(channel_keys, 3.0, 5)
    deviation = accelerometer(Accelerometer(sensitivity_tolerance=0.1), 1, "c1").deviation
    assert deviation != 0.0
    assert readings[1:] == pytest.approx(np.full(4, 3.0 * (1 + deviation)), rel=1e-12)


def test_temperature_change_changes_sensitivity():
    channel_keys = ", accelerometer: {temperature_drift: 0.05 %/K, temperature_change: 20 K}"
    # The sensitivity increases by 0.05 %/K times 20 K, which is 1 %.
    assert read_constant(channel_keys, 2.0, 3)[-1] == pytest.approx(2.0 * 1.01, rel=1e-12)


def test_transverse_sensitivity_adds_lateral_motion():
    deviations = [
        accelerometer(Accelerometer(transverse="5 %", lateral="40 %"), seed, "c").deviation for seed in range(300)
    ]
    # Transverse sensitivity times lateral motion, in any direction; the default lateral motion is 10 %.
    assert np.max(deviations) == pytest.approx(0.05 * 0.4, rel=0.01)
    assert np.min(deviations) == pytest.approx(-0.05 * 0.4, rel=0.01)
    default = [accelerometer(Accelerometer(transverse="5 %"), seed, "c").deviation for seed in range(300)]
    assert np.max(default) == pytest.approx(0.05 * 0.1, rel=0.01)


def test_bias_is_constant_or_settles():
    chain, rate = chain_of(
        scene_of(", accelerometer: {bias: 2 V}", ", accelerometer: {bias: 2 V, bias_settling: 0.5 s}")
    )
    readings = chain.measure(at_rest(2, rate, 5120))
    assert (readings[0] == 2.0).all()
    assert readings[1] == pytest.approx(2.0 * (1 - np.exp(-np.arange(5120) / (0.5 * rate))), abs=1e-12)


def test_ac_coupled_bias_decays():
    converter = "{coupling: AC, ac_corner: 0.5 Hz}"
    chain, rate = chain_of(scene_of(", accelerometer: {bias: 11 V}", converter=converter))
    readings = chain.measure(at_rest(1, rate, 10240))[0]
    assert readings == pytest.approx(11.0 * np.exp(-np.pi * np.arange(10240) / rate), abs=0.01)
    assert abs(readings[-1]) < 0.03


def test_constant_acceleration_decays_below_low_cutoff():
    readings = read_constant(", accelerometer: {low_cutoff: 2 Hz}", 1.0, 5120)
    t = (np.arange(5120) - 0.5) / 5120.0  # middle of the interval that a sample averages
    assert readings[1:] == pytest.approx(np.exp(-2 * np.pi * 2.0 * t[1:]), abs=1e-6)


def test_saturated_reading_recovers_at_once_by_default():
    chain, rate = chain_of(scene_of(", accelerometer: {sensitivity: 2, saturation: 5}"))
    path = PointMotion(tones=((20.0, 50.0, 0.0),))
    readings = chain.measure(motion_of([path], rate, 1000))[0] / 2.0
    # Averages of the clipped tone over the sample intervals, by 1000 points each.
    instants = (np.arange(1, 1000)[:, None] - 1.0 + (np.arange(1000) + 0.5) / 1000) / rate
    expected = np.clip(20.0 * np.cos(2 * np.pi * 50.0 * instants), -5.0, 5.0).mean(axis=1)
    assert readings[1:] == pytest.approx(expected, abs=2e-4)
    assert np.abs(readings).max() == pytest.approx(5.0, abs=1e-5)


def test_slow_recovery_shifts_zero():
    channel_keys = ", accelerometer: {saturation: 5, overload_recovery: 20 ms}"
    chain, rate = chain_of(scene_of(channel_keys))
    motion = at_rest(1, rate, 1024)
    # 15 m/s^2 for 10 ms, three times the saturation.
    motion.acceleration[0, 1:52] = 15.0
    motion.velocity[0] = np.cumsum(motion.acceleration[0]) / rate
    motion.displacement[0] = np.cumsum(motion.velocity[0] - 0.5 * motion.acceleration[0] / rate) / rate
    readings = chain.measure(motion)[0]
    assert readings[10:50] == pytest.approx(np.full(40, 5.0), abs=1e-6)
    # After the overload the zero is shifted, and decays with the time constant of 20 ms.
    recovery = readings[60:]
    assert recovery[0] < -1.0
    decay_per_sample = np.full(recovery.size - 1, np.exp(-1 / (0.02 * rate)))
    assert recovery[1:] / recovery[:-1] == pytest.approx(decay_per_sample, rel=1e-9)


def test_integrator_integrates_the_saturated_signal():
    chain, rate = chain_of(scene_of(", accelerometer: {saturation: 5}, integrator: {order: 1}"))
    motion = at_rest(1, rate, 200)
    t = np.arange(200) / rate
    motion.acceleration[:], motion.velocity[:], motion.displacement[:] = 8.0, 8.0 * t, 4.0 * t * t
    readings = chain.measure(motion)[0]
    # The acceleration begins within the first interval.
    assert np.diff(readings)[3:] * rate == pytest.approx(np.full(196, 5.0), rel=1e-9)
