"""Bounds of systematic errors of a response are compared with the largest error that each effect can cause."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

import rig
from analysis.core.responses.errors.systematic import (
    ChannelContributions,
    clock_limit,
    noise_gain_error,
    power_in_counts,
    quantization_steps,
    reference_noise_limit,
    reproducible_rounding,
    rounding_limit,
    sensitivity_limit,
    shared_noise_limit,
    stated_tolerance,
    tone_gain_error,
    uncertain_reference_limit,
)
from daq.core.signal_chain.channel import ChannelInfo

RATE = 5120.0
SCENE = "{structure: {masses: [1 kg], springs: [4 kN/m]}, shaker: {kind: force, body: 1}, converter: {%s}}"


def channel(name="a1", at="body 1", **sheet):
    return ChannelInfo(name, at, "acceleration", sensitivity=0.5, rate=RATE, **sheet)


def recording(*channels, converter="rate: 5120 Hz"):
    """Return a substitute for a recording, with the attributes that the bounds of errors use."""
    scene = rig.loads(SCENE % converter, where="a test")
    return SimpleNamespace(channels={info.name: info for info in channels}, scene=scene, source="")


def only_bound(bounds):
    """Return the bound of the only error in a dictionary."""
    [bound] = bounds.values()
    return bound


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
    assert stated_tolerance(channel(sensor=sheet)) == pytest.approx(0.05 + 0.002 * 10 + 0.04 * 0.5)
    assert stated_tolerance(channel()) == 0.0


def contributions_of(value, response, reference, frequency=None, motion="acceleration", names="ab"):
    """Return the terms of numerator and denominator of the response `value`, both divided by the reference."""
    return ChannelContributions(names, frequency, motion, value, response, reference)


def ratio_contributions(frequency, value, motion="acceleration", names="ab"):
    """Return the contributions if the first channel is the motion and the second is the reference."""
    in_response, in_reference = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
    return contributions_of(value, value * in_response, in_reference + 0 * value, frequency, motion, names)


@pytest.mark.parametrize("tolerances", [(0.05, 0.1, 0.02), (0.0, 0.2, 0.0), (0.1, 0.0, 0.3)])
def test_sensor_tolerances_bound_the_response(tolerances):
    random = np.random.default_rng(3)
    readings = random.standard_normal((3, 40)) + 1j * random.standard_normal((3, 40))
    response_weights, reference_weights = np.array([1.0, 0.5, 0.0]), np.array([0.0, 0.3, 1.5])
    reference = reference_weights @ readings
    value = (response_weights @ readings) / reference
    in_response, in_reference = (
        weights[:, None] * readings / reference for weights in (response_weights, reference_weights)
    )
    rec = recording(*channels_with_tolerance(*tolerances))
    bound = only_bound(sensitivity_limit(rec, contributions_of(value, in_response, in_reference, names="abc")))
    max_error = np.zeros(40)
    for errors in product(*((-size, size) for size in tolerances)):
        true_readings = readings / (1.0 + np.array(errors))[:, None]
        true_value = (response_weights @ true_readings) / (reference_weights @ true_readings)
        max_error = np.maximum(max_error, abs(true_value - value))
    assert (max_error <= bound * (1 + 1e-12)).all()


def test_single_sensor_tolerance_is_exact():
    value = np.array([2.0 - 1.0j])
    first_channel, second_channel = np.array([[1.0], [0.0]]), np.array([[0.0], [1.0]])
    rec = recording(*channels_with_tolerance(0.2, 0.0))

    def bound(in_response, in_reference):
        return only_bound(sensitivity_limit(rec, contributions_of(value, value * in_response, in_reference)))

    assert bound(first_channel, second_channel) == pytest.approx(abs(value / 0.8 - value))
    # A reference that reads 20 % high makes the true response 20 % larger.
    assert bound(second_channel, first_channel) == pytest.approx(abs(value) * 0.2)
    # The true references are 4 / 1.2 - 3 = 1 / 3 and 6 / 1.2 - 5 = 0.
    assert bound(second_channel, 4.0 * first_channel - 3.0 * second_channel) == pytest.approx(abs(value) * 2.0)
    assert bound(second_channel, 6.0 * first_channel - 5.0 * second_channel) == np.inf
    without_tolerance = recording(channel("a"), channel("b"))
    assert sensitivity_limit(without_tolerance, contributions_of(value, first_channel, second_channel)) == {}


def test_h1_bias_reaches_its_bound():
    truth, noise = 2.0 - 1.0j, np.array([0.0, 0.1, 1.0, 9.0])
    h1, coherence = truth / (1.0 + noise), 1.0 / (1.0 + noise)
    assert reference_noise_limit(h1, coherence) == pytest.approx(abs(truth - h1))


def test_smaller_reference_increases_the_error():
    deviation = np.array([0.0, 0.1, 0.5, 0.99, 1.0, 1.5])
    first_error = np.full(6, 0.3)
    total = np.hypot(first_error, only_bound(uncertain_reference_limit(first_error, deviation)))
    assert total[:4] == pytest.approx(first_error[:4] / (1.0 - deviation[:4]))
    assert (total[4:] == np.inf).all()
    # If the response is unbounded, an exact reference adds no error.
    assert only_bound(uncertain_reference_limit(np.array([np.inf]), np.array([0.0]))) == 0.0


def test_gaussian_rounding_gain_is_bounded():
    for sigma in (0.3, 0.4, 0.5, 0.7, 1.0):
        # By Stein's lemma, E[x round(x)] / sigma^2 is the sum of the density at the thresholds. The deviation from 1
        # is largest if a threshold, or the middle between two thresholds, is at the mean.
        error = max(abs(np.sum(norm.pdf(np.arange(-20, 21) + shift, scale=sigma)) - 1.0) for shift in (0.0, 0.5))
        bound = noise_gain_error(np.array([sigma**2 + 1 / 12]))[0]
        assert 0.95 * bound < error < 1.05 * bound
    assert noise_gain_error(np.array([0.2499**2 + 1 / 12, 0.0, np.inf])).tolist() == [np.inf, np.inf, 0.0]


def test_tone_rounding_gain_is_bounded():
    angle = (np.arange(4000) + 0.5) * np.pi / 4000
    for nominal_amplitude in (1.0, 2.0, 5.0, 20.0):
        max_error = 0.0
        for amplitude, offset in product(np.linspace(0.97, 1.03, 13) * nominal_amplitude, np.linspace(0.0, 0.5, 6)):
            rounded = np.rint(amplitude * np.cos(angle) + offset)
            max_error = max(max_error, abs(2.0 * np.mean(rounded * np.cos(angle)) / amplitude - 1.0))
        bound = tone_gain_error(np.array([nominal_amplitude**2 / 2 + 1 / 12]))[0]
        assert 0.85 * bound < max_error < bound
    assert tone_gain_error(np.array([0.49**2 / 2 + 1 / 12, 0.0, np.inf])).tolist() == [np.inf, np.inf, 0.0]


def test_rounding_of_all_channels_is_summed():
    digital, analog = channel("a", volts_per_count=1e-3), channel("b")
    rec = recording(digital, analog)
    assert quantization_steps(rec, "ab").tolist() == [2e-3, 0.0]
    assert power_in_counts(rec, "ab", np.array([[4e-6, 16e-6], [1.0, 1.0]])).tolist() == [[1.0, 4.0], [np.inf] * 2]
    value = np.array([2.0 + 0j])
    in_response, in_reference = np.array([[2.0], [0.0]]), np.array([[0.0], [1.0]])
    contributions = contributions_of(value, in_response, in_reference)
    assert only_bound(rounding_limit(np.array([[0.1], [0.02]]), contributions)) == pytest.approx([2.0 * (0.1 + 0.02)])
    assert rounding_limit(np.zeros((2, 1)), contributions) == {}
    # A zero reading has an unbounded error, even if its contribution is zero.
    no_contributions = contributions_of(value, 0 * in_response, 0 * in_reference)
    assert only_bound(rounding_limit(np.array([[np.inf], [0.0]]), no_contributions)) == np.inf


@pytest.mark.parametrize(("motion", "order"), [("acceleration", 0), ("velocity", 1), ("displacement", 2)])
def test_clock_error_shifts_and_scales_curve(motion, order):
    frequency = np.array([30.0, 10.0, 20.0, 40.0])
    value = (3.0 - 4.0j) * frequency
    force = ChannelInfo("f", "shaker", "force", sensitivity=0.5, rate=RATE)

    def bound(points, converter="rate: 5120 Hz, clock_error: -50 ppm"):
        rec = recording(channel(), force, converter=converter)
        return clock_limit(rec, ratio_contributions(frequency[:points], value[:points], motion, ["a1", "f"]))

    assert only_bound(bound(4)) == pytest.approx(abs(value) * 50e-6 * (1 + order))
    # Two lines may lie on the flank of a peak: the assumed slope of 10 |H| / f exceeds the slope between them.
    assert (only_bound(bound(2)) > 2.0 * only_bound(bound(4))[:2]).all()
    assert bound(4, "rate: 5120 Hz") == {}


def test_steeper_neighboring_chord_determines_the_slope():
    frequency, value = np.array([10.0, 12.0, 12.0, 13.0]), np.array([1.0, 5.0, 4.0j, 8.0])
    force = ChannelInfo("b", "shaker", "force", sensitivity=0.5, rate=RATE)
    rec = recording(channel("a"), force, converter="rate: 5120 Hz, clock_error: 50 ppm")

    def slope(points):
        f = frequency[:points]
        return only_bound(clock_limit(rec, ratio_contributions(f, value[:points]))) / (50e-6 * f)

    first_slope, last_slope = (5.0 - 1.0) / (12.0 - 10.0), abs(8.0 - 4.0j)
    # Two points at one frequency have no slope between them.
    assert slope(4) == pytest.approx([first_slope, first_slope, last_slope, last_slope])
    assert slope(3) == pytest.approx([first_slope, first_slope, 0.0])
    # Assumed slope of a curve with two lines: 10 |H| / f.
    assert slope(2) == pytest.approx([first_slope, 10.0 * 5.0 / 12.0])


@pytest.mark.parametrize("ppm", [50, 1000])
def test_clock_bound_contains_shifted_peak(ppm):
    half_width = 0.005
    frequency = 10.0 + half_width * np.arange(-6.0, 7.0)

    def curve(f):
        return 1.0 / (half_width + 1j * (f - 10.0)) + 3.0

    rec = recording(channel("a"), channel("b"), converter=f"rate: 5120 Hz, clock_error: {ppm} ppm")
    value = curve(frequency)
    bound = only_bound(clock_limit(rec, ratio_contributions(frequency, value, "displacement")))[1:-1]
    shifted_errors = [abs(curve(frequency * (1.0 + sign * ppm * 1e-6)) - value)[1:-1] for sign in (1.0, -1.0)]
    ratio = bound / np.maximum(*shifted_errors)
    # On the flanks the bound uses the steeper chord to a neighboring line, which exceeds the slope.
    assert 1.0 - 1e-6 < ratio.min() < ratio.max() < 1.6


def test_clock_error_cancels_between_equal_channels():
    value = np.full(4, 0.3 - 0.4j)
    rec = recording(channel("a"), channel("b"), converter="rate: 5120 Hz, clock_error: 50 ppm")
    contributions = ratio_contributions(np.arange(1.0, 5.0), value, "displacement")
    assert only_bound(clock_limit(rec, contributions)).max() < 1e-18


def test_bias_due_to_shared_noise_reaches_its_bound():
    random = np.random.default_rng(4)
    truth = random.standard_normal(30) + 1j * random.standard_normal(30)
    noise = np.abs(random.standard_normal((1, 30)))
    response_weight, reference_weight, power = 1.0 + 0j, -0.4 + 0.1j, 2.0
    cross_power = truth * power + response_weight * np.conj(reference_weight) * noise[0]
    reference_power = power + abs(reference_weight) ** 2 * noise[0]
    h1 = cross_power / reference_power
    change_per_reading = response_weight - h1[None] * reference_weight
    reference_weights = np.full((1, 30), reference_weight)
    bound = shared_noise_limit(noise, change_per_reading, reference_weights, reference_power)
    assert bound == pytest.approx(abs(h1 - truth))
    assert (shared_noise_limit(noise, change_per_reading, reference_weights, 0.1 * noise[0]) == np.inf).all()


def test_noise_reduces_reproducible_rounding():
    counts = np.linspace(-8.0, 8.0, 20_001)
    for sigma in (0.05, 0.2, 0.5, 1.0):
        weights = np.exp(-0.5 * (counts / sigma) ** 2)
        reproducible = np.sum(weights * np.cos(2.0 * np.pi * counts)) / weights.sum()
        assert reproducible_rounding(np.array(sigma**2 + 1.0 / 12.0)) == pytest.approx(
            reproducible, rel=1e-3, abs=1e-12
        )
    assert reproducible_rounding(np.array([0.0, 1.0 / 12.0])).tolist() == [1.0, 1.0]
