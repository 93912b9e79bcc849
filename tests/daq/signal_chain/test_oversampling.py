"""Motion at a multiple of the sample rate, before the filter of a converter: aliases, skew, blocks, and its rate."""

import numpy as np
import pytest

import rig
from daq.core.signal_chain.oversampling import choose_oversampling
from daq.core.virtual_bench.bench import Bench
from rig.core.simulation.plant import Plant

# The second channel is sampled 0.7 ms after the first.
SKEWED = "{rate: 1 kHz, filter: delta_sigma, skew: [0 s, 0.7 ms]}"


def oscillator_scene(frequency, converter, channels=1):
    """Return a scene with an undamped body that is released at a displacement of 1 µm."""
    channel_lines = "".join(f"\n  - {{name: c{n}, at: body 1}}" for n in range(channels))
    stiffness = (2 * np.pi * frequency) ** 2
    return rig.loads(
        f"structure: {{masses: [1 kg], springs: [{stiffness} N/m], damping: {{modal: 0 %}}}}\n"
        f"test: {{kind: free, displacement: [1 um], duration: 1 s}}\nconverter: {converter}\nchannels:{channel_lines}\n"
    )


def acquire(scene, count):
    """Return the samples of all channels (channels, `count`)."""
    bench = Bench(scene)
    return bench.acquire(np.zeros((len(bench.inputs), count))).samples


def amplitude_of(samples, frequency, rate):
    """Return the complex amplitude of a tone after the first 200 samples."""
    k = np.arange(200, samples.size)
    phase = 2 * np.pi * frequency / rate * k
    basis = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    cosine, sine = np.linalg.lstsq(basis, samples[200:], rcond=None)[0]
    return complex(cosine, -sine)


@pytest.mark.parametrize("rate", [1000.0, 5120.0, 51200.0])
@pytest.mark.parametrize("relative_frequency", [0.5466, 0.56, 0.8, 1.0, 1.3, 3.4, 9.7])
def test_vibration_above_nyquist_is_suppressed(rate, relative_frequency):
    frequency = relative_frequency * rate
    scene = oscillator_scene(frequency, f"{{rate: {rate} Hz, filter: delta_sigma}}")
    peak = 1e-6 * (2 * np.pi * frequency) ** 2
    assert np.abs(acquire(scene, 1500)[0, 200:]).max() < 1e-5 * peak


@pytest.mark.parametrize("rate", [2500.0, 5120.0, 51200.0])
@pytest.mark.parametrize("relative_frequency", [0.05, 0.2, 0.4, 0.4535])
def test_vibration_in_pass_band_is_unchanged(rate, relative_frequency):
    frequency = relative_frequency * rate
    scene = oscillator_scene(frequency, f"{{rate: {rate} Hz, filter: delta_sigma}}")
    result = amplitude_of(acquire(scene, 3000)[0], frequency, rate)
    peak = 1e-6 * (2 * np.pi * frequency) ** 2
    assert 20 * np.log10(abs(result) / peak) == pytest.approx(0.0, abs=1e-3)


def test_long_skew_with_filter_is_exact():
    frequency, rate = 130.0, 1000.0
    scene = oscillator_scene(frequency, SKEWED, channels=2)
    first, second = acquire(scene, 3000)
    infos = Bench(scene).channels
    phase = np.angle(amplitude_of(second, frequency, rate) / amplitude_of(first, frequency, rate))
    lag = phase / (2 * np.pi * frequency)
    # The first channel is sampled 0.7 ms earlier, so that its samples are older.
    assert infos[0].delay - infos[1].delay == pytest.approx(0.7e-3)
    assert lag * rate == pytest.approx((infos[0].delay - infos[1].delay) * rate, abs=1e-3)


def test_oversampled_motion_equals_motion_at_samples():
    scene = rig.load("fig8-three-dampers").replace(converter={"rate": "2 kHz", "filter": "delta_sigma"})
    drive = 2.0 * np.sin(2 * np.pi * 34.0 / 2000.0 * np.arange(1200))[None]
    result = Bench(scene).acquire(drive).motion
    expected = Plant(scene, 2000.0).advance(drive)
    assert result.displacement == pytest.approx(expected.displacement, abs=1e-12)
    assert np.array_equal(result.contact, expected.contact)
    instants = [
        (motion.discontinuity_sample - 1) / 2000.0 + motion.discontinuity_offset for motion in (result, expected)
    ]
    assert instants[0] == pytest.approx(instants[1], abs=1e-10)
    assert np.all((result.discontinuity_offset > 0.0) & (result.discontinuity_offset <= 1 / 2000.0 + 1e-15))


@pytest.mark.parametrize(("rate", "expected"), [(77.0, 52), (400.0, 10), (5120.0, 2)])
def test_oversampling_resolves_bandwidth_of_table(rate, expected):
    # The oversampled rate is at least ten times the bandwidth of 400 Hz; at 5120 Hz, ten times 1 kHz.
    scene = rig.loads(f"""
structure: {{masses: [20 kg], springs: [300 kN/m], damping: {{modal: 2 %}}}}
shaker: {{kind: table, body: 1, spring: 100 kN/m, bandwidth: 400 Hz}}
test: {{kind: sine, frequency: 5 Hz, force: 8 N, duration: 1 s}}
converter: {{rate: {rate}, filter: delta_sigma}}
""")
    assert choose_oversampling(scene) == expected
