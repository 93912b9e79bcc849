"""Noise of sensors, integrators and converters: spectral densities as in the data sheet."""

import numpy as np
import pytest
from scipy.signal import welch

from daq.core.dsp.noise import Noise, generator
from daq.core.signal_chain.decimation_filter import DecimationFilter
from tests.daq.dsp.analytic_motion import at_rest, chain_of, scene_of


def spectral_density(samples, rate, segment):
    """Return frequencies in Hz and the square root of the power spectral density, unit per sqrt(Hz)."""
    frequency, power = welch(samples, rate, nperseg=segment, detrend=False)
    return frequency, np.sqrt(power)


def draw_samples(source, count):
    """Return the next `count` samples of a source of noise, V."""
    samples = np.empty(count)
    source.fill(samples)
    return samples


def mean_density(frequency, density, low, high):
    """Return the root mean square of a density between two frequencies."""
    in_band = (frequency >= low) & (frequency <= high)
    return np.sqrt(np.mean(density[in_band] ** 2))


def test_white_density_is_that_of_the_data_sheet():
    samples = draw_samples(Noise(3e-6, None, 5120.0, generator(1, "c", "noise")), 400_000)
    frequency, density = spectral_density(samples, 5120.0, 512)
    for low, high in ((20.0, 300.0), (300.0, 1500.0), (1500.0, 2540.0)):
        assert mean_density(frequency, density, low, high) == pytest.approx(3e-6, rel=0.02)


@pytest.mark.parametrize(("corner", "rate"), [(10.0, 5120.0), (100.0, 5120.0), (300.0, 51200.0)])
def test_density_rises_below_the_corner(corner, rate):
    samples = draw_samples(Noise(1.0, corner, rate, generator(2, "c", "noise")), 3_000_000)
    frequency, density = spectral_density(samples, rate, int(rate / corner * 100))
    # Limits of frequency bands relative to the corner.
    for low, high in ((0.08, 0.12), (0.3, 0.5), (0.9, 1.1), (3.0, 5.0), (10.0, 15.0)):
        inside = (frequency >= low * corner) & (frequency <= high * corner)
        expected = np.sqrt(np.mean(1.0 + corner / frequency[inside]))
        assert mean_density(frequency, density, low * corner, high * corner) == pytest.approx(expected, rel=0.05)


def test_noise_does_not_depend_on_blocks():
    expected = draw_samples(Noise(1.0, 10.0, 5120.0, generator(5, "c", "noise")), 1000)
    source = Noise(1.0, 10.0, 5120.0, generator(5, "c", "noise"))
    blocks = [draw_samples(source, count) for count in (1, 0, 7, 128, 864)]
    assert np.array_equal(np.concatenate(blocks), expected)


def test_noise_differs_by_seed_channel_and_stage():
    def first(*key):
        return generator(*key).standard_normal()

    assert len({first(1, "a", "x"), first(2, "a", "x"), first(1, "b", "x"), first(1, "a", "y")}) == 4


@pytest.mark.parametrize("order", [1, 2])
def test_integrated_noise_has_density_of_each_stage(order):
    rate, corner, gain = 5120.0, 5.0, 500.0
    integrator = f", integrator: {{order: {order}, corner: {corner} Hz, gain: {gain}"
    cases = {
        ", accelerometer: {sensitivity: 2, noise: 0.01}" + integrator + "}": True,
        integrator + ", noise: 1e-5}": False,
    }
    for keys, is_before_integrator in cases.items():
        chain, _ = chain_of(scene_of(keys))
        volts = chain.measure(at_rest(1, rate, 600_000))[0]
        frequency, density = spectral_density(volts, rate, 8192)
        integrator_gain = gain / np.abs(2j * np.pi * frequency + 2 * np.pi * corner) ** order
        expected = 2 * 0.01 * integrator_gain if is_before_integrator else np.full(frequency.size, 1e-5)
        for low, high in ((2.0, 6.0), (20.0, 60.0), (100.0, 400.0)):
            result = mean_density(frequency, density, low, high)
            assert result == pytest.approx(mean_density(frequency, expected, low, high), rel=0.05)


def test_converter_noise_density_is_read():
    chain, rate = chain_of(scene_of("", converter="{noise: 2 uV/sqrt(Hz)}"))
    volts = chain.measure(at_rest(1, rate, 200_000))[0]
    assert volts.std() == pytest.approx(2e-6 * np.sqrt(rate / 2), rel=0.01)


@pytest.mark.parametrize("integrator", ["", ", integrator: {order: 1, corner: 20 Hz, gain: 500}"])
@pytest.mark.parametrize("oversampling", [1, 2])
def test_noise_before_decimation_is_filtered(integrator, oversampling):
    keys = ", accelerometer: {sensitivity: 2, noise: 0.01}" + integrator
    chain, interval_rate = chain_of(scene_of(keys, converter="{filter: delta_sigma}"), oversampling)
    rate = interval_rate / oversampling
    volts = chain.measure(at_rest(1, interval_rate, 300_000 * oversampling))[0][500:]
    frequency, density = spectral_density(volts, rate, 512)
    low_pass = DecimationFilter.standard(rate)

    def filtered_density(f):
        integrator_gain = 500.0 / abs(2j * np.pi * f + 2 * np.pi * 20.0) if integrator else 1.0
        return 0.02 * low_pass.amplitude_response(f) * integrator_gain

    # White noise above half the rate is aliased, attenuated by the filter.
    expected = np.hypot(filtered_density(frequency), filtered_density(rate - frequency))
    # Limits of frequency bands relative to the sample rate; the passband ends at 0.45.
    for low, high in ((0.02, 0.1), (0.1, 0.2), (0.2, 0.3), (0.3, 0.4), (0.4, 0.45), (0.455, 0.475), (0.475, 0.495)):
        result = mean_density(frequency, density, low * rate, high * rate)
        assert result == pytest.approx(mean_density(frequency, expected, low * rate, high * rate), rel=0.02)
    assert mean_density(frequency, expected, 0.475 * rate, 0.495 * rate) < 0.9 * mean_density(
        frequency, expected, 0.4 * rate, 0.45 * rate
    )
