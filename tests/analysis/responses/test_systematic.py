"""Systematic errors of a response against the largest error that each effect can cause."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import rig
from analysis.responses.systematic import (
    ReadingShares,
    clock_part,
    counts_of,
    doubtful_reference_part,
    in_counts,
    noise_gain,
    reference_noise_part,
    reproducible_rounding,
    rounding_part,
    sensitivity_part,
    shared_noise_part,
    tolerance,
    tone_gain,
)
from daq.signal_chain.channel import ChannelInfo

RATE = 5120.0
SCENE = "{structure: {masses: [1 kg], springs: [4 kN/m]}, shaker: {kind: force, body: 1}, converter: {%s}}"


def channel(name="a1", at="body 1", **sheet):
    return ChannelInfo(name, at, "acceleration", sensitivity=0.5, rate=RATE, **sheet)


def recording(*channels, converter="rate: 5120 Hz"):
    """The attributes of a recording that the error contributions use."""
    scene = rig.loads(SCENE % converter, where="a test")
    return SimpleNamespace(channels={info.name: info for info in channels}, scene=scene)


def only(part):
    [value] = part.values()
    return value


def toleranced(*shares):
    return [
        channel(name, sensor={"accelerometer.sensitivity_tolerance": str(share)})
        for name, share in zip("abc", shares, strict=False)
    ]


def test_data_sheet_tolerances_are_summed():
    sheet = {
        "accelerometer.sensitivity_tolerance": "-0.05",
        "accelerometer.temperature_drift": "0.002 1/K",
        "accelerometer.temperature_change": "-10 K",
        "accelerometer.transverse": "0.04",
        "accelerometer.lateral": "0.5",
    }
    assert tolerance(channel(sensor=sheet)) == pytest.approx(0.05 + 0.002 * 10 + 0.04 * 0.5)
    assert tolerance(channel()) == 0.0


def two_shares(value, upper, lower, frequency=None, motion="acceleration", names="ab"):
    return ReadingShares(names, frequency, motion, value, upper, lower)


def of_quotient(frequency, value, motion="acceleration", names="ab"):
    """Return the contributions of the two channels of a quotient."""
    share = np.array([[1.0], [0.0]])
    return two_shares(value, value * share, share[::-1] + 0 * value, frequency, motion, names)


@pytest.mark.parametrize("shares", [(0.05, 0.1, 0.02), (0.0, 0.2, 0.0), (0.1, 0.0, 0.3)])
def test_sensor_tolerances_bound_quotient(shares):
    random = np.random.default_rng(3)
    reads = random.standard_normal((3, 40)) + 1j * random.standard_normal((3, 40))
    above, below = np.array([1.0, 0.5, 0.0]), np.array([0.0, 0.3, 1.5])
    reference = below @ reads
    value = (above @ reads) / reference
    upper, lower = (weights[:, None] * reads / reference for weights in (above, below))
    rec = recording(*toleranced(*shares))
    bound = only(sensitivity_part(rec, two_shares(value, upper, lower, names="abc")))
    worst = np.zeros(40)
    for corner in product(*((-share, share) for share in shares)):
        true = reads / (1.0 + np.array(corner))[:, None]
        worst = np.maximum(worst, abs((above @ true) / (below @ true) - value))
    assert (worst <= bound * (1 + 1e-12)).all()


def test_single_sensor_tolerance_is_exact():
    value = np.array([2.0 - 1.0j])
    first, second = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
    rec = recording(*toleranced(0.2, 0.0))

    def bound(upper, lower):
        return only(sensitivity_part(rec, two_shares(value, value * upper, lower)))

    assert bound(first, second) == pytest.approx(abs(value / 0.8 - value))
    # If the reference may read 20 % too much, the quotient may be 20 % larger; at 100 % it is unbounded.
    assert bound(second, first) == pytest.approx(abs(value) * 0.2)
    assert bound(second, 4.0 * first - 3.0 * second) == pytest.approx(abs(value) * 2.0)
    assert bound(second, 6.0 * first - 5.0 * second) == np.inf
    assert sensitivity_part(recording(channel("a"), channel("b")), two_shares(value, first, second)) == {}


def test_h1_bias_reaches_its_bound():
    truth, noise = 2.0 - 1.0j, np.array([0.0, 0.1, 1.0, 9.0])
    h1, coherence = truth / (1.0 + noise), 1.0 / (1.0 + noise)
    assert reference_noise_part(h1, coherence) == pytest.approx(abs(truth - h1))


def test_smaller_reference_increases_the_error():
    doubt = np.array([0.0, 0.1, 0.5, 0.99, 1.0, 1.5])
    first = np.full(6, 0.3)
    total = np.hypot(first, only(doubtful_reference_part(first, doubt)))
    assert total[:4] == pytest.approx(first[:4] / (1.0 - doubt[:4]))
    assert (total[4:] == np.inf).all()
    # If the response is unbounded, an exact reference adds no error.
    assert only(doubtful_reference_part(np.array([np.inf]), np.array([0.0]))) == 0.0


def test_gaussian_rounding_gain_is_bounded():
    for sigma in (0.3, 0.4, 0.5, 0.7, 1.0):
        # E[x round(x)] / sigma^2 is the sum of the density at the thresholds (Stein). It deviates most if a threshold
        # or the middle between two is at the mean.
        error = max(
            abs(np.sum(norm.pdf(np.arange(-20, 21) + shift, scale=sigma)) - 1.0) for shift in (0.0, 0.5)
        )
        bound = noise_gain(np.array([sigma**2 + 1 / 12]))[0]
        assert 0.95 * bound < error < 1.05 * bound
    assert noise_gain(np.array([0.2499**2 + 1 / 12, 0.0, np.inf])).tolist() == [np.inf, np.inf, 0.0]


def test_tone_rounding_gain_is_bounded():
    angle = (np.arange(4000) + 0.5) * np.pi / 4000
    for size in (1.0, 2.0, 5.0, 20.0):
        worst = 0.0
        for amplitude, offset in product(np.linspace(0.97, 1.03, 13) * size, np.linspace(0.0, 0.5, 6)):
            read = np.rint(amplitude * np.cos(angle) + offset)
            worst = max(worst, abs(2.0 * np.mean(read * np.cos(angle)) / amplitude - 1.0))
        bound = tone_gain(np.array([size**2 / 2 + 1 / 12]))[0]
        assert 0.85 * bound < worst < bound
    assert tone_gain(np.array([0.49**2 / 2 + 1 / 12, 0.0, np.inf])).tolist() == [np.inf, np.inf, 0.0]


def test_rounding_of_all_channels_is_summed():
    counting, volts = channel("a", volts_per_count=1e-3), channel("b")
    rec = recording(counting, volts)
    assert counts_of(rec, "ab").tolist() == [2e-3, 0.0]
    assert in_counts(rec, "ab", np.array([[4e-6, 16e-6], [1.0, 1.0]])).tolist() == [[1.0, 4.0], [np.inf] * 2]
    value = np.array([2.0 + 0j])
    upper, lower = np.array([[2.0], [0.0]]), np.array([[0.0], [1.0]])
    part = only(rounding_part(np.array([[0.1], [0.02]]), two_shares(value, upper, lower)))
    assert part == pytest.approx([2.0 * (0.1 + 0.02)])
    assert rounding_part(np.zeros((2, 1)), two_shares(value, upper, lower)) == {}
    # A zero reading has an unbounded error, even if its contribution is zero.
    assert only(rounding_part(np.array([[np.inf], [0.0]]), two_shares(value, 0 * upper, 0 * lower))) == np.inf


@pytest.mark.parametrize(("motion", "order"), [("acceleration", 0), ("velocity", 1), ("displacement", 2)])
def test_clock_error_shifts_and_scales_curve(motion, order):
    frequency = np.array([30.0, 10.0, 20.0, 40.0])
    value = (3.0 - 4.0j) * frequency
    force = ChannelInfo("f", "shaker", "force", sensitivity=0.5, rate=RATE)

    def part(points, converter="rate: 5120 Hz, clock_error: -50 ppm"):
        rec = recording(channel(), force, converter=converter)
        return clock_part(rec, of_quotient(frequency[:points], value[:points], motion, ["a1", "f"]))

    assert only(part(4)) == pytest.approx(abs(value) * 50e-6 * (1 + order))
    # Two lines may lie on the flank of a peak, so the limit is larger than their difference suggests.
    assert (only(part(2)) > 2.0 * only(part(4))[:2]).all()
    assert part(4, "rate: 5120 Hz") == {}


def test_steeper_chord_determines_the_slope():
    frequency, value = np.array([10.0, 12.0, 12.0, 13.0]), np.array([1.0, 5.0, 4.0j, 8.0])
    force = ChannelInfo("b", "shaker", "force", sensitivity=0.5, rate=RATE)
    rec = recording(channel("a"), force, converter="rate: 5120 Hz, clock_error: 50 ppm")

    def slope(points):
        f = frequency[:points]
        return only(clock_part(rec, of_quotient(f, value[:points]))) / (50e-6 * f)

    last = abs(8.0 - 4.0j)
    # Two points at one frequency have no slope between them.
    assert slope(4) == pytest.approx([2.0, 2.0, last, last])
    assert slope(3) == pytest.approx([2.0, 2.0, 0.0])
    assert slope(2) == pytest.approx([2.0, 10.0 * 5.0 / 12.0])


@pytest.mark.parametrize("ppm", [50, 1000])
def test_clock_part_contains_shifted_peak(ppm):
    half_width = 0.005
    frequency = 10.0 + half_width * np.arange(-6.0, 7.0)

    def curve(f):
        return 1.0 / (half_width + 1j * (f - 10.0)) + 3.0

    rec = recording(channel("a"), channel("b"), converter=f"rate: 5120 Hz, clock_error: {ppm} ppm")
    value = curve(frequency)
    reported = only(clock_part(rec, of_quotient(frequency, value, "displacement")))[1:-1]
    ends = [abs(curve(frequency * (1.0 + sign * ppm * 1e-6)) - value)[1:-1] for sign in (1.0, -1.0)]
    ratio = reported / np.maximum(*ends)
    # On the flanks the steeper chord exceeds the slope.
    assert 1.0 - 1e-6 < ratio.min() < ratio.max() < 1.6


def test_clock_error_cancels_in_quotient():
    value = np.full(4, 0.3 - 0.4j)
    rec = recording(channel("a"), channel("b"), converter="rate: 5120 Hz, clock_error: 50 ppm")
    shares = of_quotient(np.arange(1.0, 5.0), value, "displacement")
    assert only(clock_part(rec, shares)).max() < 1e-18


def test_shared_noise_biases_h1_as_stated():
    random = np.random.default_rng(4)
    truth = random.standard_normal(30) + 1j * random.standard_normal(30)
    noise = np.abs(random.standard_normal((1, 30)))
    up, low, power = 1.0 + 0j, -0.4 + 0.1j, 2.0
    cross, total = truth * power + up * np.conj(low) * noise[0], power + abs(low) ** 2 * noise[0]
    h1 = cross / total
    lower = np.full((1, 30), low)
    assert shared_noise_part(noise, up - h1[None] * low, lower, total) == pytest.approx(abs(h1 - truth))
    assert (shared_noise_part(noise, up - h1[None] * low, lower, 0.1 * noise[0]) == np.inf).all()


def test_noise_reduces_reproducible_rounding():
    counts = np.linspace(-8.0, 8.0, 20_001)
    for spread in (0.05, 0.2, 0.5, 1.0):
        weights = np.exp(-0.5 * (counts / spread) ** 2)
        reproducible = np.sum(weights * np.cos(2.0 * np.pi * counts)) / weights.sum()
        assert reproducible_rounding(np.array(spread**2 + 1.0 / 12.0)) == pytest.approx(
            reproducible, rel=1e-3, abs=1e-12
        )
    assert reproducible_rounding(np.array([0.0, 1.0 / 12.0])).tolist() == [1.0, 1.0]
