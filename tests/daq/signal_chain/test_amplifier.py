"""Integrating amplifiers of a channel: gain, corner frequency, low cut-off, saturation and noise."""

import numpy as np
import pytest

from tests.daq.dsp.analytic_motion import PointMotion, at_rest, chain_of, motion_of, scene_of


def test_gain_scales_the_integral():
    path = PointMotion(tones=((7.0, 20.0, 0.4),), impacts=((0.0312, 0.1),))
    sensitivity, gain = 2.0, 30.0
    for order, quantity, row in ((1, "velocity", 1), (2, "displacement", 0)):
        channel_keys = f", accelerometer: {{sensitivity: {sensitivity}}}, integrator: {{order: {order}, gain: {gain}}}"
        chain, rate = chain_of(scene_of(channel_keys))
        info = chain.channels[0]
        assert (info.quantity, info.sensitivity) == (quantity, pytest.approx(sensitivity * gain, rel=1e-14))
        motion = motion_of([path], rate, 500)
        truth = path.at(np.arange(500) / rate)[row]
        # The integrator starts from zero; the velocity does too, but the displacement does not.
        truth = truth - (truth[0] if quantity == "displacement" else 0.0)
        assert chain.measure(motion)[0] / (sensitivity * gain) == pytest.approx(truth, abs=1e-13)


def test_gain_at_zero_frequency_follows_from_corner():
    channel_keys = ", accelerometer: {bias: 0.5 V}, integrator: {order: 1, corner: 3 Hz, gain: 10}"
    chain, rate = chain_of(scene_of(channel_keys))
    volts = chain.measure(at_rest(1, rate, 5120))[0]
    # The transfer function gain / (s + 2 pi corner) at s = 0.
    assert volts[-1] == pytest.approx(0.5 * 10 / (2 * np.pi * 3.0), rel=1e-6)


@pytest.mark.parametrize("time_constant", [0.05, None])
def test_integrated_bias_has_closed_form(time_constant):
    settling = "" if time_constant is None else f", bias_settling: {time_constant} s"
    chain, rate = chain_of(
        scene_of(f", accelerometer: {{bias: 0.5 V{settling}}}, integrator: {{order: 1, corner: 3 Hz, gain: 10}}")
    )
    volts = chain.measure(at_rest(1, rate, 2000))[0]
    time, decay = np.arange(2000) / rate, 2 * np.pi * 3.0
    step_response = (1.0 - np.exp(-decay * time)) / decay
    if time_constant is not None:
        step_response -= (np.exp(-time / time_constant) - np.exp(-decay * time)) / (decay - 1.0 / time_constant)
    expected = 0.5 * 10 * step_response
    assert volts == pytest.approx(expected, abs=1e-10 * expected.max())


def test_low_cutoff_removes_bias():
    channel_keys = ", accelerometer: {bias: 0.5 V}, integrator: {order: 2, corner: 5 Hz, low_cutoff: 5 Hz, gain: 10}"
    chain, rate = chain_of(scene_of(channel_keys))
    volts = chain.measure(at_rest(1, rate, 10240))[0]
    assert np.abs(volts[:2000]).max() > 1e-3
    assert np.abs(volts[-100:]).max() < 1e-12
    assert abs(chain.channels[0].response(0.0)) == 0.0


@pytest.mark.parametrize("order", [1, 2])
def test_saturated_integrator_has_no_wind_up(order):
    channel_keys = f", integrator: {{order: {order}, gain: 400, saturation: 2 V}}"
    chain, rate = chain_of(scene_of(channel_keys))
    # A constant acceleration for a quarter of a second, then the opposite acceleration.
    acceleration = np.where(np.arange(2560) < 1280, 100.0, -100.0)
    acceleration[0] = 0.0
    motion = at_rest(1, rate, 2560)
    motion.acceleration[0] = acceleration
    motion.velocity[0] = np.cumsum(acceleration) / rate
    motion.displacement[0] = np.cumsum(motion.velocity[0] - 0.5 * acceleration / rate) / rate
    volts = chain.measure(motion)[0]
    assert volts.max() == 2.0
    assert volts.min() == -2.0
    # With two stages, the first (gain 20) falls from 2 V to 0 V in 1 ms; only then the second decreases.
    end_of_saturation = 1280 + np.flatnonzero(volts[1280:] < 2.0)[0]
    assert end_of_saturation / rate - 0.25 == pytest.approx(0.0 if order == 1 else 1e-3, abs=3e-4)


def test_double_integrated_noise_grows():
    rate, density = 16.0, 1e-3
    final_values = []
    for seed in range(40):
        scene = scene_of(
            f", accelerometer: {{noise: {density}}}, integrator: {{order: 2}}",
            converter=f"{{rate: {rate} Hz}}",
            other_settings=f"seed: {seed}",
        )
        chain, _ = chain_of(scene)
        samples = chain.measure(at_rest(1, rate, round(3600 * rate)))[0]
        assert np.isfinite(samples).all()
        final_values.append(samples[-1])
    # After the time T, the variance is (one-sided density^2 / 2) T^3 / 3.
    assert np.std(final_values) == pytest.approx(density * np.sqrt(3600.0**3 / 6.0), rel=0.25)
