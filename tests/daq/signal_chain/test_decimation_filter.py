"""The decimation filter of a delta-sigma converter: passband, stopband, impulses, noise and delay.

Frequencies are relative to the sample rate.
"""

import numpy as np
import pytest

from daq.core.signal_chain.decimation_filter import DELAY_SAMPLES, PASSBAND_EDGE, STOPBAND_EDGE, DecimationFilter
from tests.daq.dsp.analytic_motion import PointMotion, at_rest, chain_of, cut, motion_of, scene_of

RATE = 1000.0  # Hz
FILTERED = "{rate: 1 kHz, filter: delta_sigma}"


def amplitude(samples, frequency, rate):
    """Return the complex amplitude of a tone after the first third of the samples."""
    k = np.arange(samples.size)[samples.size // 3 :]
    window = np.blackman(k.size)
    demodulation = np.exp(-2j * np.pi * frequency / rate * k)
    return 2 * np.sum(samples[k] * window * demodulation) / window.sum()


def test_passband_is_flat_and_delayed():
    chain, rate = chain_of(scene_of("", converter=FILTERED), oversampling=8)
    info = chain.channels[0]
    assert info.delay == DELAY_SAMPLES / RATE
    for relative_frequency in (0.02, 0.2, 0.4, PASSBAND_EDGE):
        chain, _ = chain_of(scene_of("", converter=FILTERED), oversampling=8)
        path = PointMotion(tones=((1.0, relative_frequency * RATE, 0.0),))
        result = amplitude(chain.measure(motion_of([path], rate, 8 * 3000))[0], relative_frequency * RATE, RATE)
        assert abs(result) == pytest.approx(1.0, abs=3e-5)
        angular_frequency = 2 * np.pi * relative_frequency
        delay_error = np.angle(result * np.exp(1j * angular_frequency * DELAY_SAMPLES)) / angular_frequency
        assert delay_error == pytest.approx(0.0, abs=1e-5 / relative_frequency)  # samples
        assert result == pytest.approx(complex(info.response(relative_frequency * RATE)), abs=1e-5)


@pytest.mark.parametrize("relative_frequency", [STOPBAND_EDGE, 0.62, 0.97, 1.2, 1.9, 2.45, 3.3])
def test_out_of_band_tone_is_suppressed(relative_frequency):
    chain, rate = chain_of(scene_of("", converter=FILTERED), oversampling=16)
    path = PointMotion(tones=((1.0, relative_frequency * RATE, 0.7),))
    samples = chain.measure(motion_of([path], rate, 16 * 1500))[0]
    assert np.abs(samples[300:]).max() < 1e-5


def test_impact_response_is_convolved_with_filter():
    rate, resonance, q = 51200.0, 30e3, 30.0
    sensor = f", accelerometer: {{resonance: {resonance}, q: {q}}}"
    chain, _ = chain_of(scene_of(sensor, converter=f"{{rate: {rate}, filter: delta_sigma}}"))
    instant, jump = 20.3217 / rate, 0.13
    samples = chain.measure(motion_of([PointMotion(impacts=((instant, jump),))], rate, 110))[0]
    low_pass = DecimationFilter.standard(rate)
    # The decaying vibration of the sensor is known in closed form. A fine midpoint rule convolves it with the filter.
    omega = 2 * np.pi * resonance
    decay, damped_omega = omega / (2 * q), omega * np.sqrt(1 - 1 / (4 * q * q))
    t = (np.arange(40_000) + 0.5) * (100.0 / rate) / 40_000
    vibration = jump * omega**2 / damped_omega * np.exp(-decay * t) * np.sin(damped_omega * t)
    expected = [
        np.sum(vibration * low_pass.impulse_response(k - (instant + t) * rate - DELAY_SAMPLES)) * rate * (t[1] - t[0])
        for k in range(110)
    ]
    # The filter's taps are scaled to a sum of 1 and approximate its kernel within 3e-7.
    assert samples == pytest.approx(np.array(expected), abs=2e-5 * np.abs(expected).max())


def test_filtered_impulse_sums_to_velocity():
    chain, _ = chain_of(scene_of("", converter=FILTERED))
    for instant in (10.0, 20.0001, 29.5):
        chain, _ = chain_of(scene_of("", converter=FILTERED))
        samples = chain.measure(motion_of([PointMotion(impacts=((instant / RATE, 0.5),))], RATE, 130))[0]
        assert samples.sum() / RATE == pytest.approx(0.5, rel=1e-5)


def test_removed_delay_omits_first_samples():
    path = [PointMotion(tones=((1.0, 41.0, 0.3),), impacts=((0.0517, 0.2),))]
    motion = motion_of(path, RATE, 200)
    with_delay, _ = chain_of(scene_of("", converter=FILTERED))
    without_delay, _ = chain_of(scene_of("", converter="{rate: 1 kHz, filter: delta_sigma, remove_delay: true}"))
    assert without_delay.latency == DELAY_SAMPLES
    assert without_delay.channels[0].delay == 0.0
    blocks = [without_delay.measure(cut(motion, k, k + 20)) for k in range(0, 200, 20)]
    # Of the first two blocks of 20 samples, the first 38 samples are omitted.
    assert [block.shape[1] for block in blocks[:3]] == [0, 2, 20]
    assert np.array_equal(np.concatenate(blocks, axis=1), with_delay.measure(motion)[:, DELAY_SAMPLES:])


def test_filtered_white_noise_keeps_its_density():
    sensor = ", accelerometer: {noise: 0.01}"
    chain, rate = chain_of(scene_of(sensor, converter="{rate: 1 kHz, filter: delta_sigma, coupling: AC}"))
    samples = chain.measure(at_rest(1, rate, 200_000))[0, 100:]
    # Welch's method without overlap, with a Hann window of 256 samples.
    power = np.abs(np.fft.rfft(samples[:199_680].reshape(-1, 256) * np.hanning(256))) ** 2
    density = np.sqrt(2 * power.mean(axis=0) / (rate * np.sum(np.hanning(256) ** 2)))
    in_passband = density[3:114]  # above the AC coupling
    assert in_passband == pytest.approx(np.full(111, 0.01), rel=0.12)
    assert np.sqrt(np.mean(in_passband**2)) == pytest.approx(0.01, rel=0.01)
