from itertools import pairwise

import numpy as np
import pytest

import rig
from daq.signal_chain.oversampling import oversampling
from daq.virtual_bench.bench import Bench
from rig.simulation.plant import Plant

SKEWED = "{rate: 1 kHz, filter: delta_sigma, skew: [0 s, 0.7 ms]}"


def oscillator(frequency, converter, channels=1):
    """An undamped body that is released 1 µm from rest."""
    listed = "".join(f"\n  - {{name: c{n}, at: body 1}}" for n in range(channels))
    stiffness = (2 * np.pi * frequency) ** 2
    return rig.loads(
        f"structure: {{masses: [1 kg], springs: [{stiffness} N/m], damping: {{modal: 0 %}}}}\n"
        f"test: {{kind: free, displacement: [1 um], duration: 1 s}}\nconverter: {converter}\nchannels:{listed}\n"
    )


def read(scene, blocks):
    bench = Bench(scene)
    drive = np.zeros((len(bench.inputs), sum(blocks)))
    edges = np.cumsum([0, *blocks])
    parts = [bench.acquire(drive[:, a:b]) for a, b in pairwise(edges)]
    return np.concatenate([part.samples for part in parts], axis=1)


def tone(samples, frequency, rate):
    """Complex amplitude of a tone in the settled part of a reading."""
    k = np.arange(200, samples.size)
    turn = 2 * np.pi * frequency / rate * k
    basis = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    cosine, sine = np.linalg.lstsq(basis, samples[200:], rcond=None)[0]
    return complex(cosine, -sine)


@pytest.mark.parametrize("rate", [1000.0, 5120.0, 51200.0])
@pytest.mark.parametrize("share", [0.5466, 0.56, 0.8, 1.0, 1.3, 3.4, 9.7])
def test_alias_of_fast_rig_is_filtered(rate, share):
    frequency = share * rate
    scene = oscillator(frequency, f"{{rate: {rate} Hz, filter: delta_sigma}}")
    peak = 1e-6 * (2 * np.pi * frequency) ** 2
    assert np.abs(read(scene, [1500])[0, 200:]).max() < 1e-5 * peak


@pytest.mark.parametrize("rate", [2500.0, 5120.0, 51200.0])
@pytest.mark.parametrize("share", [0.05, 0.2, 0.4, 0.4535])
def test_ringing_in_pass_band_reads_flat(rate, share):
    frequency = share * rate
    scene = oscillator(frequency, f"{{rate: {rate} Hz, filter: delta_sigma}}")
    result = tone(read(scene, [3000])[0], frequency, rate)
    peak = 1e-6 * (2 * np.pi * frequency) ** 2
    assert 20 * np.log10(abs(result) / peak) == pytest.approx(0.0, abs=1e-3)


def test_long_skew_behind_filter_is_exact():
    frequency, rate = 130.0, 1000.0
    scene = oscillator(frequency, SKEWED, channels=2)
    early, late = read(scene, [3000])
    infos = Bench(scene).channels
    lag = np.angle(tone(late, frequency, rate) / tone(early, frequency, rate)) / (2 * np.pi * frequency)
    # The first channel is sampled first: in the sample at the last one's tick it is the older.
    assert infos[0].delay - infos[1].delay == pytest.approx(0.7e-3)
    assert lag * rate == pytest.approx((infos[0].delay - infos[1].delay) * rate, abs=1e-3)


def test_oversampled_blocks_change_no_bit():
    scene = rig.load("fig8-three-dampers").replace(
        channels=[
            {"name": name, "at": at, "accelerometer": {"resonance": "20 kHz", "noise": "20 ug/sqrt(Hz)"}}
            for name, at in (("first", "body 1"), ("second", "table"))
        ],
        converter={"rate": "2 kHz", "filter": "delta_sigma", "skew": "200 us", "jitter": "1 us"},
    )
    drive = 2.0 * np.sin(2 * np.pi * 34.0 / 2000.0 * np.arange(1200))[None]

    def run(sizes):
        bench = Bench(scene)
        edges = np.cumsum([0, *sizes])
        return [bench.acquire(drive[:, a:b]) for a, b in pairwise(edges)]

    (whole,) = run([1200])
    parts = run([0, 1, 7, 128, 1, 0, 500, 563])
    assert len(whole.motion.break_sample) > 20
    assert np.array_equal(np.concatenate([part.samples for part in parts], axis=1), whole.samples)
    for name in ("displacement", "gap", "break_offset", "break_sample"):
        joined = np.concatenate([getattr(part.motion, name) for part in parts], axis=-1)
        assert np.array_equal(joined, getattr(whole.motion, name))
    firsts = [part.first for part in parts]
    assert firsts == [0, 0, 1, 8, 136, 137, 137, 637]


def test_oversampled_motion_is_that_at_samples():
    scene = rig.load("fig8-three-dampers").replace(converter={"rate": "2 kHz", "filter": "delta_sigma"})
    drive = 2.0 * np.sin(2 * np.pi * 34.0 / 2000.0 * np.arange(1200))[None]
    result = Bench(scene).acquire(drive).motion
    expected = Plant(scene, 2000.0).advance(drive)
    assert result.displacement == pytest.approx(expected.displacement, abs=1e-12)
    assert np.array_equal(result.contact, expected.contact)
    instants = [(motion.break_sample - 1) / 2000.0 + motion.break_offset for motion in (result, expected)]
    assert instants[0] == pytest.approx(instants[1], abs=1e-10)
    assert np.all((result.break_offset > 0.0) & (result.break_offset <= 1 / 2000.0 + 1e-15))


@pytest.mark.parametrize(("rate", "expected"), [(77.0, 52), (400.0, 10), (5120.0, 2)])
def test_fast_table_follows_drive_corners(rate, expected):
    scene = rig.loads(f"""
structure: {{masses: [20 kg], springs: [300 kN/m], damping: {{modal: 2 %}}}}
shaker: {{kind: table, body: 1, spring: 100 kN/m, bandwidth: 400 Hz}}
test: {{kind: sine, frequency: 5 Hz, force: 8 N, duration: 1 s}}
converter: {{rate: {rate}, filter: delta_sigma}}
""")
    assert oversampling(scene) == expected
