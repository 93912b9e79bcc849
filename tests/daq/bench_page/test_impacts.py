"""Hammer hits are detected in the force and checked for faults at the end of their windows."""

import numpy as np
import pytest

from daq.extras.bench_page.impacts import ImpactDetector

RATE = 1000.0  # Hz
MIN_PEAK = 20.0  # smallest accepted peak, N
WINDOW_S = 0.4  # length of the window of a hit, s


def force_of(*pulses: tuple[float, float], seconds: float = 1.0) -> np.ndarray:
    """Return a force (1 channel, samples) of half sines of 5 ms, each given by time in s and peak in N."""
    time = np.arange(seconds * RATE) / RATE
    force = np.zeros(time.size)
    for start, peak in pulses:
        in_pulse = (time >= start) & (time < start + 5e-3)
        force[in_pulse] += peak * np.sin(np.pi * (time[in_pulse] - start) / 5e-3)
    return force[None]


def detect_hits(readings, overload=None, block=100):
    """Return the hits that are detected in blocks of `block` samples; without `overload`, no sample is overloaded."""
    detector = ImpactDetector(0, RATE, MIN_PEAK, WINDOW_S)
    overload = np.zeros(readings.shape, bool) if overload is None else overload
    for first in range(0, readings.shape[1], block):
        detector.add(first, readings[:, first : first + block], overload[:, first : first + block])
    return detector.impacts


@pytest.mark.parametrize(
    ("pulses", "faults"),
    [
        ([(0.2, 50.0)], []),
        ([(0.2, 12.0)], ["too weak"]),
        ([(0.2, 50.0), (0.23, 15.0)], ["double impact"]),
        ([(0.2, 15.0), (0.23, 15.0)], ["double impact", "too weak"]),
    ],
)
def test_faults_of_a_hit_are_named(pulses, faults):
    (hit,) = detect_hits(force_of(*pulses))
    assert hit.faults == faults
    assert hit.accepted == (not faults)
    assert hit.peak == pytest.approx(pulses[0][1], rel=0.05)


def test_hit_with_overloaded_sample_is_clipped():
    overload = np.zeros((1, 1000), bool)
    # A sample in the window of the hit at sample 200.
    overload[0, 205] = True
    assert detect_hits(force_of((0.2, 50.0)), overload)[0].faults == ["clipped"]


@pytest.mark.parametrize("block", [7, 100, 1000])
def test_hits_do_not_depend_on_blocks(block):
    hits = detect_hits(force_of((0.1, 50.0), (0.6, 40.0), seconds=1.2), block=block)
    assert [hit.number for hit in hits] == [1, 2]
    # The force of the half sines exceeds 30 N 2 ms after their start.
    assert [hit.first + int(np.argmax(hit.force > 30.0)) for hit in hits] == [102, 602]
    assert all(hit.readings.shape == (1, round(WINDOW_S * RATE)) for hit in hits)


def test_hit_with_missing_samples_is_ignored():
    detector, readings = ImpactDetector(0, RATE, MIN_PEAK, WINDOW_S), force_of((0.2, 50.0))
    no_overload = np.zeros((1, 300), bool)
    # Samples 300 to 499 are missing. The trigger is at sample 201; the window extends from 10 samples before it to 590.
    detector.add(0, readings[:, :300], no_overload)
    detector.add(500, readings[:, 500:800], no_overload)
    assert detector.impacts == []
