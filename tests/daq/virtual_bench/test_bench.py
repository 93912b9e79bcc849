"""The virtual bench converts drive into samples: blocks, counts, overloads and the sample clock."""

from itertools import pairwise

import numpy as np
import pytest

import rig
from daq.core.virtual_bench.bench import Bench
from rig.core.base.errors import RunError


def modulated_tone(samples: int, level: float, rate: float = 5120.0) -> np.ndarray:
    """Return the drive of one input, a frequency-modulated tone at 34.8 Hz, shape (1, samples)."""
    time = np.arange(samples) / rate
    return level * np.sin(2 * np.pi * 34.8 * time + 3 * np.sin(2 * np.pi * 2 * time))[None]


SENSOR = {"resonance": "20 kHz", "noise": "20 ug/sqrt(Hz)"}
SCENES = {name: rig.load(name) for name in ("fig8-three-dampers", "fig9", "bare-structure", "reference-C")}
SCENES["oversampled"] = SCENES["fig8-three-dampers"].replace(
    channels=[{"name": at.replace(" ", ""), "at": at, "accelerometer": SENSOR} for at in ("body 1", "table")],
    converter={"rate": "2 kHz", "filter": "delta_sigma", "skew": "200 us", "jitter": "1 us"},
)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_block_size_changes_no_sample(scene: rig.Scene) -> None:
    level = {"V": 3.0, "m": 2e-3, "N": 10.0}[Bench(scene).drive_units[0]]  # by unit of the drive
    drive = modulated_tone(600, level)
    whole = Bench(scene).acquire(drive)
    for edges in ([*range(601)], [*range(0, 600, 7), 600], [0, 0, 1, 8, 136, 137, 137, 600]):
        bench = Bench(scene)
        blocks = [bench.acquire(drive[:, first:stop]) for first, stop in pairwise(edges)]
        assert [block.first for block in blocks] == edges[:-1]
        np.testing.assert_array_equal(np.concatenate([block.samples for block in blocks], axis=1), whole.samples)
        np.testing.assert_array_equal(np.concatenate([block.overload for block in blocks], axis=1), whole.overload)
        for name in ("displacement", "gap", "discontinuity_offset", "discontinuity_sample"):
            joined = np.concatenate([getattr(block.motion, name) for block in blocks], axis=-1)
            np.testing.assert_array_equal(joined, getattr(whole.motion, name))


def test_counts_read_as_physical_units() -> None:
    bench = Bench(rig.load("fig8-no-damper"))
    block = bench.acquire(modulated_tone(2000, 1.0))
    assert block.samples.dtype == np.int32
    readings = bench.to_units(block.samples)
    body = [channel.at for channel in bench.channels].index("body 1")
    truth = block.motion.displacement[0]
    assert bench.channels[body].unit == "m"
    # The corner of the integrator, 1 Hz, hardly changes the amplitude.
    assert np.abs(readings[body]).max() == pytest.approx(np.abs(truth).max(), rel=0.05)


def test_summed_acceleration_is_velocity() -> None:
    scene = rig.load("fig8-three-dampers").replace(channels=None, converter={"rate": "5120 Hz"})
    bench = Bench(scene)
    block = bench.acquire(modulated_tone(5120, 3.0))
    assert len(block.motion.events) > 10  # impacts of the dampers
    velocity = np.cumsum(bench.to_units(block.samples)[:3], axis=1) / bench.rate
    np.testing.assert_allclose(velocity, block.motion.velocity[:3], rtol=0, atol=1e-9)


def test_overload_flags_are_at_full_scale() -> None:
    scene = rig.load("fig8-no-damper")
    scene = scene.replace(converter={"rate": "5120 Hz", "bits": 16, "range": "5 mV"})
    block = Bench(scene).acquire(modulated_tone(3000, 5.0))
    at_full_scale = (block.samples == 2**15 - 1) | (block.samples == -(2**15))
    assert block.overload.any()
    assert np.all(at_full_scale[block.overload])


@pytest.mark.parametrize("shape", [(2, 10), (0, 10), (10,)])
def test_wrong_drive_shape_is_reported(shape: tuple[int, ...]) -> None:
    with pytest.raises(RunError, match=r"expected shape \(1, samples\)"):
        Bench(rig.load("bare-structure")).acquire(np.zeros(shape))


def test_nonfinite_drive_is_rejected() -> None:
    with pytest.raises(RunError, match="expected finite"):
        Bench(rig.load("bare-structure")).acquire(np.full((1, 4), np.nan))


def test_clock_error_changes_only_the_true_rate() -> None:
    scene = rig.load("bare-structure").replace(converter={"rate": "5 kHz", "clock_error": "1 %"})
    bench = Bench(scene)
    assert bench.rate == 5000.0
    motion = bench.acquire(np.full((1, 101), 1e-3)).motion
    exact = Bench(rig.load("bare-structure").replace(converter={"rate": "5050 Hz"}))
    np.testing.assert_array_equal(motion.displacement, exact.acquire(np.full((1, 101), 1e-3)).motion.displacement)
