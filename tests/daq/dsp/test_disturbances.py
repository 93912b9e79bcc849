"""Disturbances of a channel (noise, offset) as polynomials within a sample interval, and their spectra."""

import numpy as np
import pytest
from numpy.polynomial.legendre import legval

from daq.core.dsp.disturbances import Disturbances, Offset, OffsetPolynomial
from daq.core.dsp.noise import LOWEST, FastNoise, Noise, flicker_filter, generator


class KnownValues:
    """A source of known values in place of random numbers."""

    def __init__(self, values):
        self._values, self._n_used = values, 0

    def fill(self, samples):
        samples[:] = self._values[self._n_used : self._n_used + samples.size]
        self._n_used += samples.size


@pytest.mark.parametrize("oversampling", [1, 2, 5])
@pytest.mark.parametrize("block_ends", [[], [1], [1, 2, 3, 9], [0, 7, 7, 20]])
def test_interval_polynomials_equal_sample_polynomials(oversampling, block_ends):
    # Voltages of four disturbances, of degrees 0, 1, 2 and 0, at 30 samples.
    samples = np.random.default_rng(oversampling).standard_normal((4, 30))
    disturbances = Disturbances([KnownValues(row) for row in samples], np.zeros(4), (0, 1, 2, 0), oversampling)
    n_intervals = 29 * oversampling + 1
    coefficients = np.concatenate([disturbances.draw(int(n)) for n in np.diff([0, *block_ends, n_intervals])], axis=1)
    interval_time = np.linspace(-1.0, 1.0, 5)  # instants in an interval, from -1 to 1
    # Interval 0 ends at sample 0; the polynomials of a sample are valid since the previous sample.
    for interval in range(n_intervals):
        sample = -(-interval // oversampling)  # rounded up
        position = (interval - 1) % oversampling
        sample_time = (2 * position + 1 + interval_time) / oversampling - 1.0  # in the sample interval, from -1 to 1
        values, expected = legval(interval_time, coefficients[:3, interval]), legval(sample_time, samples[:3, sample])
        np.testing.assert_allclose(values, expected, atol=1e-12)
        assert coefficients[3, interval] == samples[3, sample]


def test_direct_disturbances_are_added():
    disturbances = Disturbances(
        [Offset(level, None, 1.0) for level in (1.0, 2.0, 5.0)], np.array([0.5, 0.0, -1.0]), (0, 0, 0), 1
    )
    # 0.5 * 1 + 0 * 2 - 1 * 5 = -4.5 V is added to each sample.
    volts = np.array([10.0, 20.0])
    disturbances.add_direct(disturbances.draw(2), volts)
    assert volts.tolist() == [5.5, 15.5]
    without_sources = Disturbances([], np.zeros(0), (), 4)
    assert without_sources.draw(3).shape == (0, 3)


def test_settling_offset_is_exponential():
    level, time_constant, rate = -3.0, 0.25, 100.0
    source = Offset(level, time_constant, rate)
    samples = np.empty(200)
    # Blocks of 1, 0, 59 and 140 samples.
    for start, stop in ((0, 1), (1, 1), (1, 60), (60, 200)):
        source.fill(samples[start:stop])
    np.testing.assert_allclose(samples, level * (1.0 - np.exp(-np.arange(200) / rate / time_constant)), atol=1e-12)


@pytest.mark.parametrize("time_constant", [0.25, None])
def test_offset_polynomials_equal_offset_within_intervals(time_constant):
    level, rate, n_intervals = -3.0, 100.0, 30
    coefficients = np.empty((3, 1 + n_intervals))
    for degree, row in enumerate(coefficients):
        source = OffsetPolynomial(level, time_constant, rate, degree)
        # Blocks of 1, 0, 9 and 21 samples.
        for start, stop in ((0, 1), (1, 1), (1, 10), (10, 31)):
            source.fill(row[start:stop])
    # The interval before sample 0 precedes power-on.
    assert not coefficients[:, 0].any()
    position = np.linspace(-1.0, 1.0, 5)  # in an interval, from -1 to 1
    time = (np.arange(n_intervals)[:, None] + 0.5 * (1.0 + position)) / rate
    rise = np.ones_like(time) if time_constant is None else 1.0 - np.exp(-time / time_constant)
    error = legval(position, coefficients[:, 1:]) - level * rise
    assert abs(error).max() <= (0.0 if time_constant is None else -level * (1.0 / rate / time_constant) ** 3 / 100.0)


@pytest.mark.parametrize(
    ("corner", "rate", "tolerance", "tolerance_at_nyquist"),
    [
        (0.5, 5120.0, 3e-3, 3e-3),
        (50.0, 5120.0, 3e-3, 3e-3),
        (3.0, 1e5, 3e-3, 3e-3),
        (100.0, 50.0, 0.03, 0.06),
        (2e-3, 1e-3, 0.03, 0.06),
    ],
)
def test_flicker_noise_density_follows_the_corner(corner, rate, tolerance, tolerance_at_nyquist):
    loss, weight, gain = flicker_filter(corner, rate)
    frequency = np.geomspace(10 * min(LOWEST, 0.1 * corner, 0.01 * rate), 0.5 * rate, 200)
    # Transfer function of a delay by one sample.
    delay = np.exp(-2j * np.pi * frequency / rate)[:, None]
    density = gain * abs(1.0 + np.sum(weight * delay / (1.0 - (1.0 - loss) * delay), axis=1))
    error = abs(density / np.sqrt(1.0 + corner / frequency) - 1.0)
    assert error[frequency < 0.45 * rate].max() < tolerance and error.max() < tolerance_at_nyquist
    # The states are stable.
    assert ((loss > 0.0) & (loss <= 1.0)).all()
    # There is about one state for each factor of four in frequency.
    assert loss.size <= 2 + np.log(0.25 * rate / (0.1 * frequency[0])) / np.log(4.0)


def test_flicker_noise_is_filtered_white_noise():
    corner, rate = 20.0, 5120.0
    loss, weight, gain = flicker_filter(corner, rate)
    samples = np.empty(500)
    Noise(3e-6, corner, rate, generator(4, "c", "noise")).fill(samples)
    white = generator(4, "c", "noise").standard_normal(500) * 3e-6 * np.sqrt(0.5 * rate)
    states, expected = np.zeros(loss.size), []
    for value in white:
        expected.append(gain * (value + weight @ states))
        states = (1.0 - loss) * states + value
    np.testing.assert_allclose(samples, expected, rtol=1e-9)


@pytest.mark.parametrize("degree", [1, 2])
def test_noise_of_each_polynomial_degree_has_expected_power(degree):
    density, samples = 2e-6, np.empty(200_000)
    # The power density at half the sample rate is 1 + 2 corner / rate times the density of white noise.
    for corner, rate, power_ratio in ((None, 1.0, 1.0), (100.0, 1000.0, 1.2)):
        FastNoise(density, corner, rate, generator(5, "c", "fast"), degree).fill(samples)
        # White noise projected on P_d has 2 d + 1 times the variance of its average, density^2 rate / 2.
        expected = density * np.sqrt(power_ratio * (2 * degree + 1) * 0.5 * rate)
        assert samples.std() == pytest.approx(expected, rel=0.01)
        assert abs(samples.mean()) < 0.01 * expected
