import numpy as np
import pytest

from daq.signal_chain.decimation_filter import PASS, STOP, Decimation
from tests.daq.dsp.analytic_motion import Path, at_rest, chain_of, cut, motion_of, scene_of

RATE = 1000.0
FILTERED = "{rate: 1 kHz, filter: delta_sigma}"


def amplitude(read, frequency, rate):
    """Complex amplitude of a tone in the settled part of a reading."""
    k = np.arange(read.size)[read.size // 3 :]
    window = np.blackman(k.size)
    turns = np.exp(-2j * np.pi * frequency / rate * k)
    return 2 * np.sum(read[k] * window * turns) / window.sum()


def test_pass_band_is_flat_and_delayed():
    chain, rate = chain_of(scene_of("", converter=FILTERED), oversampling=8)
    info = chain.channels[0]
    assert info.delay == 38 / RATE
    for share in (0.02, 0.2, 0.4, PASS):
        chain, _ = chain_of(scene_of("", converter=FILTERED), oversampling=8)
        path = Path(tones=((1.0, share * RATE, 0.0),))
        result = amplitude(chain.measure(motion_of([path], rate, 8 * 3000))[0], share * RATE, RATE)
        assert abs(result) == pytest.approx(1.0, abs=3e-5)
        delay_error = np.angle(result * np.exp(2j * np.pi * share * 38)) / (2 * np.pi * share)
        assert delay_error == pytest.approx(0.0, abs=1e-3 / share * 0.01)
        assert result == pytest.approx(complex(info.response(share * RATE)), abs=1e-5)


@pytest.mark.parametrize("share", [STOP, 0.62, 0.97, 1.2, 1.9, 2.45, 3.3])
def test_out_of_band_tone_is_suppressed(share):
    chain, rate = chain_of(scene_of("", converter=FILTERED), oversampling=16)
    read = chain.measure(motion_of([Path(tones=((1.0, share * RATE, 0.7),))], rate, 16 * 1500))[0]
    assert np.abs(read[300:]).max() < 1e-5


def test_struck_sensor_samples_are_the_filter_integral():
    rate, resonance, q = 51200.0, 30e3, 30.0
    sensor = f", accelerometer: {{resonance: {resonance}, q: {q}}}"
    chain, _ = chain_of(scene_of(sensor, converter=f"{{rate: {rate}, filter: delta_sigma}}"))
    struck, jump = 20.3217 / rate, 0.13
    read = chain.measure(motion_of([Path(impacts=((struck, jump),))], rate, 110))[0]
    low_pass = Decimation.standard(rate)
    # The sensor's ringing in closed form, weighed with the filter by a fine midpoint rule.
    w = 2 * np.pi * resonance
    decay, damped = w / (2 * q), w * np.sqrt(1 - 1 / (4 * q * q))
    t = (np.arange(40_000) + 0.5) * (100.0 / rate) / 40_000
    ringing = jump * w * w / damped * np.exp(-decay * t) * np.sin(damped * t)
    expected = [
        np.sum(ringing * low_pass.impulse_response(k - (struck + t) * rate - 38.0)) * rate * (t[1] - t[0])
        for k in range(110)
    ]
    # The filter is scaled so that its sum is 1, and cut into pieces that follow it within 3e-7.
    assert read == pytest.approx(np.array(expected), abs=2e-5 * np.abs(expected).max())


def test_filtered_impulse_sums_to_velocity():
    chain, _ = chain_of(scene_of("", converter=FILTERED))
    for instant in (10.0, 20.0001, 29.5):
        chain, _ = chain_of(scene_of("", converter=FILTERED))
        read = chain.measure(motion_of([Path(impacts=((instant / RATE, 0.5),))], RATE, 130))[0]
        assert read.sum() / RATE == pytest.approx(0.5, rel=1e-5)


def test_removed_delay_renumbers_samples():
    path = [Path(tones=((1.0, 41.0, 0.3),), impacts=((0.0517, 0.2),))]
    motion = motion_of(path, RATE, 200)
    late, _ = chain_of(scene_of("", converter=FILTERED))
    on_time, _ = chain_of(scene_of("", converter="{rate: 1 kHz, filter: delta_sigma, remove_delay: true}"))
    assert on_time.latency == 38
    assert on_time.channels[0].delay == 0.0
    blocks = [on_time.measure(cut(motion, k, k + 20)) for k in range(0, 200, 20)]
    assert [block.shape[1] for block in blocks[:3]] == [0, 2, 20]
    assert np.array_equal(np.concatenate(blocks, axis=1), late.measure(motion)[:, 38:])


def test_filtered_white_noise_keeps_its_density():
    sensor = ", accelerometer: {noise: 0.01}"
    chain, rate = chain_of(scene_of(sensor, converter="{rate: 1 kHz, filter: delta_sigma, coupling: AC}"))
    read = chain.measure(at_rest(1, rate, 200_000))[0, 100:]
    power = np.abs(np.fft.rfft(read[:199_680].reshape(-1, 256) * np.hanning(256))) ** 2
    density = np.sqrt(2 * power.mean(axis=0) / (rate * np.sum(np.hanning(256) ** 2)))
    assert density[3:114] == pytest.approx(np.full(111, 0.01), rel=0.12)
    assert np.sqrt(np.mean(density[3:114] ** 2)) == pytest.approx(0.01, rel=0.01)
