"""The decimator of a converter against an explicit sum, and its taps against integrals of the filter's kernel.

The signal in each interval is given by its moments: the coefficients of Legendre polynomials P_k.
"""

import numpy as np
import pytest
from scipy.integrate import quad, trapezoid

from daq.core.dsp.block_buffers import SharedScratch
from daq.core.dsp.decimator import Decimator
from daq.core.signal_chain.decimation_filter import (
    DELAY_SAMPLES,
    MOMENTS,
    PASSBAND_EDGE,
    STOPBAND_EDGE,
    DecimationFilter,
    legendre_taps,
)


@pytest.mark.parametrize(("oversampling", "delay"), [(1, 0), (1, 3), (3, 0), (4, 5)])
def test_filtered_sample_is_the_weighted_sum(oversampling, delay):
    random = np.random.default_rng(oversampling)
    length, intervals = 7, 211
    taps = random.standard_normal((oversampling, MOMENTS, length))
    moments = random.standard_normal((intervals, MOMENTS))
    scratch = SharedScratch()
    decimator, parts = Decimator(taps, delay, scratch), []
    for begin, end in ((0, 1), (1, 1), (1, 3), (3, 100), (100, 105), (105, intervals)):
        decimator.moments_buffer(end - begin)[: end - begin] = moments[begin:end]
        parts.append(decimator.filter(end - begin).copy())
        # Other channels use the same memory.
        scratch.rows(1000)[:] = np.nan
    samples = np.concatenate(parts)
    assert samples.size == -(-intervals // oversampling)  # rounded up
    for n, sample in enumerate(samples):
        expected = 0.0
        for p in range(oversampling):
            for j in range(length):
                interval = n * oversampling - p - j * oversampling - delay
                if interval >= 0:
                    expected += taps[p, :, j] @ moments[interval]
        assert sample == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("oversampling", [1, 3])
def test_taps_are_integrals_of_the_kernel(oversampling):
    low_pass = DecimationFilter.standard(1000.0)
    taps = legendre_taps(low_pass, oversampling)
    assert taps.shape == (oversampling, MOMENTS, 2 * DELAY_SAMPLES)
    # A constant is unchanged, and a ramp is delayed by 38 samples.
    assert taps[:, 0].sum() == pytest.approx(1.0, rel=1e-12)
    interval = np.arange(2 * DELAY_SAMPLES * oversampling).reshape(2 * DELAY_SAMPLES, oversampling).T
    middle = -(interval + 0.5) / oversampling
    half = 0.5 / oversampling
    ramp = np.sum(taps[:, 0] * middle) + np.sum(taps[:, 1] * half / 3.0)
    assert ramp == pytest.approx(-DELAY_SAMPLES, abs=1e-9)
    total = quad(lambda t: float(low_pass.impulse_response(np.array(t))), -DELAY_SAMPLES, DELAY_SAMPLES, limit=400)[0]
    # Some taps: interval p in the sample interval, sample interval j, and moment k.
    for p, j, k in ((0, 40, 0), (0, 40, 3), (oversampling - 1, 37, 1), (0, 2, 2)):
        # Moment k is the mean of the signal times P_k: its weight is (2 k + 1) times the mean of kernel times P_k.
        end = j + p / oversampling
        polynomial = np.polynomial.legendre.Legendre.basis(k)

        def weighted_polynomial(lag, end=end, polynomial=polynomial):
            position = 1.0 - 2.0 * oversampling * (lag - end)  # In the interval, from -1 to 1.
            return float(low_pass.impulse_response(np.array(lag - DELAY_SAMPLES)) * polynomial(position))

        expected = quad(weighted_polynomial, end, end + 1 / oversampling)[0] * (2 * k + 1) / total
        assert taps[p, k, j] == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_constant_is_not_changed_by_the_filter():
    time = np.linspace(-DELAY_SAMPLES, DELAY_SAMPLES, 100 * DELAY_SAMPLES + 1)
    kernel = DecimationFilter.standard(5120.0).impulse_response(time)
    assert trapezoid(kernel, time) == pytest.approx(1.0, abs=1e-5)


def test_filter_response_is_the_fourier_integral():
    low_pass = DecimationFilter.standard(5120.0)
    beta = pytest.approx(11.0531, abs=1e-4)
    assert low_pass.parameters == {"rate": 5120.0, "delay": 38.0, "cutoff": 0.5, "beta": beta}
    time = np.linspace(-38.0, 38.0, 200_001)
    kernel = low_pass.impulse_response(time)
    step = time[1] - time[0]
    for cycles_per_sample in (0.0, 0.2, 0.44, PASSBAND_EDGE, 0.5, STOPBAND_EDGE, 0.7, 3.0):
        expected = np.sum(kernel * np.cos(2 * np.pi * cycles_per_sample * time)) * step / (np.sum(kernel) * step)
        assert low_pass.amplitude_response(cycles_per_sample * 5120.0) == pytest.approx(expected, abs=2e-6)
    stopband, passband = np.linspace(STOPBAND_EDGE, 8.0, 4000), np.linspace(0.0, PASSBAND_EDGE, 2000)
    assert 20 * np.log10(abs(low_pass.amplitude_response(stopband * 5120.0)).max()) < -100.0
    assert abs(20 * np.log10(abs(low_pass.amplitude_response(passband * 5120.0)))).max() < 1e-4
    assert not low_pass.impulse_response(np.array([-38.0, -40.0, 38.0, 41.5])).any()
