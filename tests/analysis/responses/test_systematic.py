"""Bounds of systematic errors of a frequency response, against the largest error that each effect can cause."""

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
    in_counts,
    noise_gain,
    reference_noise_part,
    reproducible_rounding,
    rounding_part,
    sensitivity_part,
    shared_noise_part,
    tolerance,
    tone_gain,
    uncertain_reference_part,
)
from daq.signal_chain.channel import ChannelInfo

RATE = 5120.0
SCENE = "{structure: {masses: [1 kg], springs: [4 kN/m]}, shaker: {kind: force, body: 1}, converter: {%s}}"


def channel(name="a1", at="body 1", **sheet):
    return ChannelInfo(name, at, "acceleration", sensitivity=0.5, rate=RATE, **sheet)


def recording(*channels, converter="rate: 5120 Hz"):
    """Return the attributes of a recording that the error contributions use."""
    scene = rig.loads(SCENE % converter, where="a test")
    return SimpleNamespace(channels={info.name: info for info in channels}, scene=scene)


def single_value(part):
    """Return the bound of a part of the uncertainty that has a single name."""
    [value] = part.values()
    return value


def channels_with_tolerance(*tolerances):
    return [
        channel(name, sensor={"accelerometer.sensitivity_tolerance": str(sensor_tolerance)})
        for name, sensor_tolerance in zip("abc", tolerances, strict=False)
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


def reading_shares(value, response, reference, frequency=None, motion="acceleration", names="ab"):
    """Return shares: the contribution of each channel to the response `value`, and to its reference of 1."""
    return ReadingShares(names, frequency, motion, value, response, reference)


def quotient_shares(frequency, value, motion="acceleration", names="ab"):
    """Return the contributions of the two channels of a quotient."""
    share = np.array([[1.0], [0.0]])
    return reading_shares(value, value * share, share[::-1] + 0 * value, frequency, motion, names)


@pytest.mark.parametrize("tolerances", [(0.05, 0.1, 0.02), (0.0, 0.2, 0.0), (0.1, 0.0, 0.3)])
def test_sensor_tolerances_bound_quotient(tolerances):
    random = np.random.default_rng(3)
    readings = random.standard_normal((3, 40)) + 1j * random.standard_normal((3, 40))
    response_weights, reference_weights = np.array([1.0, 0.5, 0.0]), np.array([0.0, 0.3, 1.5])
    reference = reference_weights @ readings
    value = (response_weights @ readings) / reference
    response_share, reference_share = (
        weights[:, None] * readings / reference for weights in (response_weights, reference_weights)
    )
    rec = recording(*channels_with_tolerance(*tolerances))
    bound = single_value(sensitivity_part(rec, reading_shares(value, response_share, reference_share, names="abc")))
    max_error = np.zeros(40)
    for errors in product(*((-limit, limit) for limit in tolerances)):
        true_readings = readings / (1.0 + np.array(errors))[:, None]
        true_value = (response_weights @ true_readings) / (reference_weights @ true_readings)
        max_error = np.maximum(max_error, abs(true_value - value))
    assert (max_error <= bound * (1 + 1e-12)).all()


def test_single_sensor_tolerance_is_exact():
    value = np.array([2.0 - 1.0j])
    first_share, second_share = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
    rec = recording(*channels_with_tolerance(0.2, 0.0))

    def bound(response_share, reference_share):
        return single_value(sensitivity_part(rec, reading_shares(value, value * response_share, reference_share)))

    assert bound(first_share, second_share) == pytest.approx(abs(value / 0.8 - value))
    # If the reference may read 20 % too much, the quotient may be 20 % larger; at 100 % it is unbounded.
    assert bound(second_share, first_share) == pytest.approx(abs(value) * 0.2)
    assert bound(second_share, 4.0 * first_share - 3.0 * second_share) == pytest.approx(abs(value) * 2.0)
    assert bound(second_share, 6.0 * first_share - 5.0 * second_share) == np.inf
    without_tolerance = recording(channel("a"), channel("b"))
    assert sensitivity_part(without_tolerance, reading_shares(value, first_share, second_share)) == {}


def test_h1_bias_reaches_its_bound():
    truth, noise = 2.0 - 1.0j, np.array([0.0, 0.1, 1.0, 9.0])
    h1, coherence = truth / (1.0 + noise), 1.0 / (1.0 + noise)
    assert reference_noise_part(h1, coherence) == pytest.approx(abs(truth - h1))


def test_smaller_reference_increases_the_error():
    deviation = np.array([0.0, 0.1, 0.5, 0.99, 1.0, 1.5])
    first_error = np.full(6, 0.3)
    total = np.hypot(first_error, single_value(uncertain_reference_part(first_error, deviation)))
    assert total[:4] == pytest.approx(first_error[:4] / (1.0 - deviation[:4]))
    assert (total[4:] == np.inf).all()
    # If the response is unbounded, an exact reference adds no error.
    assert single_value(uncertain_reference_part(np.array([np.inf]), np.array([0.0]))) == 0.0


def test_gaussian_rounding_gain_is_bounded():
    for sigma in (0.3, 0.4, 0.5, 0.7, 1.0):
        # By Stein's lemma, E[x round(x)] / sigma^2 is the sum of the density at the thresholds. The deviation from 1
        # is largest if a threshold, or the middle between two thresholds, is at the mean.
        error = max(abs(np.sum(norm.pdf(np.arange(-20, 21) + shift, scale=sigma)) - 1.0) for shift in (0.0, 0.5))
        bound = noise_gain(np.array([sigma**2 + 1 / 12]))[0]
        assert 0.95 * bound < error < 1.05 * bound
    assert noise_gain(np.array([0.2499**2 + 1 / 12, 0.0, np.inf])).tolist() == [np.inf, np.inf, 0.0]


def test_tone_rounding_gain_is_bounded():
    angle = (np.arange(4000) + 0.5) * np.pi / 4000
    for nominal_amplitude in (1.0, 2.0, 5.0, 20.0):
        max_error = 0.0
        for amplitude, offset in product(np.linspace(0.97, 1.03, 13) * nominal_amplitude, np.linspace(0.0, 0.5, 6)):
            rounded = np.rint(amplitude * np.cos(angle) + offset)
            max_error = max(max_error, abs(2.0 * np.mean(rounded * np.cos(angle)) / amplitude - 1.0))
        bound = tone_gain(np.array([nominal_amplitude**2 / 2 + 1 / 12]))[0]
        assert 0.85 * bound < max_error < bound
    assert tone_gain(np.array([0.49**2 / 2 + 1 / 12, 0.0, np.inf])).tolist() == [np.inf, np.inf, 0.0]


def test_rounding_of_all_channels_is_summed():
    digital, analog = channel("a", volts_per_count=1e-3), channel("b")
    rec = recording(digital, analog)
    assert counts_of(rec, "ab").tolist() == [2e-3, 0.0]
    assert in_counts(rec, "ab", np.array([[4e-6, 16e-6], [1.0, 1.0]])).tolist() == [[1.0, 4.0], [np.inf] * 2]
    value = np.array([2.0 + 0j])
    response_share, reference_share = np.array([[2.0], [0.0]]), np.array([[0.0], [1.0]])
    shares = reading_shares(value, response_share, reference_share)
    assert single_value(rounding_part(np.array([[0.1], [0.02]]), shares)) == pytest.approx([2.0 * (0.1 + 0.02)])
    assert rounding_part(np.zeros((2, 1)), shares) == {}
    # A zero reading has an unbounded error, even if its contribution is zero.
    zero_shares = reading_shares(value, 0 * response_share, 0 * reference_share)
    assert single_value(rounding_part(np.array([[np.inf], [0.0]]), zero_shares)) == np.inf


@pytest.mark.parametrize(("motion", "order"), [("acceleration", 0), ("velocity", 1), ("displacement", 2)])
def test_clock_error_shifts_and_scales_curve(motion, order):
    frequency = np.array([30.0, 10.0, 20.0, 40.0])
    value = (3.0 - 4.0j) * frequency
    force = ChannelInfo("f", "shaker", "force", sensitivity=0.5, rate=RATE)

    def part(points, converter="rate: 5120 Hz, clock_error: -50 ppm"):
        rec = recording(channel(), force, converter=converter)
        return clock_part(rec, quotient_shares(frequency[:points], value[:points], motion, ["a1", "f"]))

    assert single_value(part(4)) == pytest.approx(abs(value) * 50e-6 * (1 + order))
    # Two lines may lie on the flank of a peak; the limit exceeds the slope between them.
    assert (single_value(part(2)) > 2.0 * single_value(part(4))[:2]).all()
    assert part(4, "rate: 5120 Hz") == {}


def test_steeper_chord_determines_the_slope():
    frequency, value = np.array([10.0, 12.0, 12.0, 13.0]), np.array([1.0, 5.0, 4.0j, 8.0])
    force = ChannelInfo("b", "shaker", "force", sensitivity=0.5, rate=RATE)
    rec = recording(channel("a"), force, converter="rate: 5120 Hz, clock_error: 50 ppm")

    def slope(points):
        f = frequency[:points]
        return single_value(clock_part(rec, quotient_shares(f, value[:points]))) / (50e-6 * f)

    last_slope = abs(8.0 - 4.0j)
    # Two points at one frequency have no slope between them.
    assert slope(4) == pytest.approx([2.0, 2.0, last_slope, last_slope])
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
    bound = single_value(clock_part(rec, quotient_shares(frequency, value, "displacement")))[1:-1]
    shifted_errors = [abs(curve(frequency * (1.0 + sign * ppm * 1e-6)) - value)[1:-1] for sign in (1.0, -1.0)]
    ratio = bound / np.maximum(*shifted_errors)
    # On the flanks the bound uses the steeper chord to a neighboring line, which exceeds the slope.
    assert 1.0 - 1e-6 < ratio.min() < ratio.max() < 1.6


def test_clock_error_cancels_in_quotient():
    value = np.full(4, 0.3 - 0.4j)
    rec = recording(channel("a"), channel("b"), converter="rate: 5120 Hz, clock_error: 50 ppm")
    shares = quotient_shares(np.arange(1.0, 5.0), value, "displacement")
    assert single_value(clock_part(rec, shares)).max() < 1e-18


def test_shared_noise_biases_h1_as_stated():
    random = np.random.default_rng(4)
    truth = random.standard_normal(30) + 1j * random.standard_normal(30)
    noise = np.abs(random.standard_normal((1, 30)))
    response_gain, reference_gain, power = 1.0 + 0j, -0.4 + 0.1j, 2.0
    cross_power = truth * power + response_gain * np.conj(reference_gain) * noise[0]
    reference_power = power + abs(reference_gain) ** 2 * noise[0]
    h1 = cross_power / reference_power
    error_gain, reference_gains = response_gain - h1[None] * reference_gain, np.full((1, 30), reference_gain)
    bound = shared_noise_part(noise, error_gain, reference_gains, reference_power)
    assert bound == pytest.approx(abs(h1 - truth))
    assert (shared_noise_part(noise, error_gain, reference_gains, 0.1 * noise[0]) == np.inf).all()


def test_noise_reduces_reproducible_rounding():
    counts = np.linspace(-8.0, 8.0, 20_001)
    for sigma in (0.05, 0.2, 0.5, 1.0):
        weights = np.exp(-0.5 * (counts / sigma) ** 2)
        reproducible = np.sum(weights * np.cos(2.0 * np.pi * counts)) / weights.sum()
        assert reproducible_rounding(np.array(sigma**2 + 1.0 / 12.0)) == pytest.approx(
            reproducible, rel=1e-3, abs=1e-12
        )
    assert reproducible_rounding(np.array([0.0, 1.0 / 12.0])).tolist() == [1.0, 1.0]
