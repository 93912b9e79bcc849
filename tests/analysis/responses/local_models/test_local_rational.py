"""The local rational method, on independently computed spectra: exact for rational functions, and with noise."""

import numpy as np
import pytest

from analysis.core.responses.errors.random_errors import LocalErrors, SharedErrors
from analysis.core.responses.local_models import local_rational
from analysis.core.responses.local_models.local_rational import OutputSpectra, local_fit

BINS = 400
MIDDLE = 200
OFFSET = np.arange(BINS) - MIDDLE  # Distance of each bin from the middle.
HALF_WIDTH = 12  # Bins on either side of a line that a fit uses.
AT_REST = np.zeros((6, BINS))  # End phases of segments without transients of earlier motion.


def gaussian(random, *shape):
    """Draw complex numbers of unit power."""
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)) / np.sqrt(2.0)


def ideal_reading(spectra):
    """Return the reading of a channel with the response 1."""
    return OutputSpectra(spectra, np.ones(spectra.shape[1]), np.zeros((0, spectra.shape[1])))


def resonance(width):
    """Return a ratio of a linear and a quadratic polynomial, with a peak of 1 in the middle."""
    return (1.0 + 2e-3 * OFFSET) * width**2 / ((OFFSET - 0.5j * width) ** 2 - width**2) / (-0.8)


def transient(random, segments, width):
    """Return a transient (leakage) of each segment: a quadratic polynomial over the same denominator."""
    powers = (OFFSET / 100.0) ** np.arange(3)[:, None]
    return gaussian(random, segments, 3) @ powers / ((OFFSET - 0.5j * width) ** 2 - width**2) * width**2


@pytest.mark.parametrize("transients", ["at rest", "joined", "separate"])
def test_rational_response_is_exact(transients):
    random = np.random.default_rng(7)
    force, width = gaussian(random, 3, BINS), 20.0
    response = 1.0 / (1.0 + 0.02j * (OFFSET + 230.0))
    end_phases = {
        "at rest": np.zeros((3, BINS), dtype=complex),
        "joined": np.ones((3, BINS), dtype=complex),
        "separate": np.exp(-2j * np.pi * np.arange(BINS) * np.array([0.37, 0.21, 0.45])[:, None]),
    }[transients]
    spectra = response * force * resonance(width) + transient(random, 3, width)
    if transients == "separate":
        spectra = spectra + end_phases * transient(random, 3, width)
    lines = np.array([0, 3, 150, 199, 205, 390, 399])
    fit = local_fit(OutputSpectra(spectra, response, np.zeros((0, BINS))), force, end_phases, lines, HALF_WIDTH)
    np.testing.assert_allclose(fit.value, resonance(width)[lines], rtol=1e-7)
    assert (np.sqrt(fit.variance) < 1e-7 * abs(fit.value)).all()
    assert (fit.model_error < 1e-6 * abs(fit.value)).all()
    assert fit.coherence == pytest.approx(np.ones(7), abs=1e-9)


def test_slow_transient_is_separated_from_response():
    random = np.random.default_rng(8)
    force, slow_transient = gaussian(random, 2, BINS), 1.0 / (1j * np.arange(BINS) + 0.4)
    spectra = 2.0 * force + 50.0 * gaussian(random, 2, 1) * slow_transient
    lines = np.arange(1, 40)
    fit = local_fit(OutputSpectra(spectra, np.ones(BINS), slow_transient[None]), force, AT_REST[:2], lines, HALF_WIDTH)
    np.testing.assert_allclose(fit.value, 2.0, rtol=1e-7)


@pytest.mark.parametrize(("half_width", "noise"), [(6, 0.3), (15, 0.3), (15, 3.0)])
def test_scatter_due_to_noise_equals_stated_variance(half_width, noise):
    random = np.random.default_rng(9)
    segments, ratios, coherences, all_degrees = 3, [], [], []
    lines = np.arange(30, 370, 2 * half_width + 1)
    for _ in range(40):
        force = gaussian(random, segments, BINS)
        spectra = 2.0 * force + noise * gaussian(random, segments, BINS)
        reading = ideal_reading(spectra)
        fit = local_fit(reading, force, AT_REST[:segments], lines, half_width)
        ratios.append(abs(fit.value - 2.0) ** 2 / (2.0 * fit.variance))
        coherences.append(fit.coherence)
        all_degrees.append(fit.degrees_of_freedom)
    # The mean of 1 / (chi^2 / n) is n / (n - 2) for n degrees of freedom.
    degrees_of_freedom = np.median(all_degrees)
    assert np.mean(ratios) == pytest.approx(degrees_of_freedom / (degrees_of_freedom - 2.0), rel=0.15)
    # Two for each equation, minus the unknowns: three for the response and for each transient (no denominator).
    assert degrees_of_freedom == 2 * (segments * (2 * half_width + 1) - 3 - 3 * segments)
    assert np.mean(coherences) == pytest.approx(4.0 / (4.0 + noise**2), abs=0.01)


def test_noise_does_not_widen_narrow_peak():
    random, bins, values = np.random.default_rng(3), np.arange(120), []
    pole = 1j * (bins - 60.0) + 1.0
    for _ in range(100):
        force, noise = (gaussian(random, 1, bins.size) for _ in range(2))
        output = OutputSpectra(force / pole + 0.03 * noise, np.ones(bins.size), np.zeros((0, bins.size)))
        values.append(local_fit(output, force, np.zeros((1, bins.size)), np.array([60]), 12).value[0])
    assert abs(np.mean(values) - 1.0) < 0.015


def test_effect_of_reference_noise_at_narrow_peak():
    random = np.random.default_rng(14)
    noise, middle, squares = 0.02, np.array([MIDDLE]), []
    for _ in range(60):
        force = gaussian(random, 1, BINS)
        reading = ideal_reading(resonance(1.5) * force)
        noisy_reference = force + noise * gaussian(random, 1, BINS)
        fit = local_fit(reading, noisy_reference, AT_REST[:1], middle, HALF_WIDTH)
        squares.append(
            [abs(fit.value[0] - 1.0) ** 2 / 2.0, fit.variance[0], noise**2 * fit.variance_per_reference_noise[0]]
        )
    error, residual, predicted = np.median(squares, axis=0)
    # The median of the squared error of a complex value is ln 2 times its mean.
    assert predicted * np.log(2.0) == pytest.approx(error, rel=0.5)
    # The poles are fitted to the noise, so that the residual hardly shows it.
    assert residual < 0.5 * predicted


def test_effect_of_reference_noise_in_flat_response():
    random = np.random.default_rng(15)
    noise, lines, ratios = 0.03, np.arange(30, 370, 25), []
    for _ in range(40):
        force = gaussian(random, 3, BINS)
        reading = ideal_reading(2.0 * force)
        fit = local_fit(reading, force + noise * gaussian(random, 3, BINS), AT_REST[:3], lines, HALF_WIDTH)
        ratios.append(abs(fit.value - 2.0) ** 2 / 2.0 / (noise**2 * fit.variance_per_reference_noise))
    assert np.mean(ratios) == pytest.approx(1.0, rel=0.15)


def test_error_in_end_bin_affects_only_nearby_fits():
    random = np.random.default_rng(17)
    force, lines = gaussian(random, 2, BINS), np.array([3, 200, BINS - 4])
    for bin_, affected_lines in ((0, [True, False, False]), (BINS - 1, [False, False, True])):
        spectra = 2.0 * force
        spectra[:, bin_] += 1.0
        fit = local_fit(ideal_reading(spectra), force, AT_REST[:2], lines, HALF_WIDTH)
        assert (abs(fit.value - 2.0) > 1e-6).tolist() == affected_lines


def test_results_are_proportional_to_units():
    random = np.random.default_rng(16)
    force, lines = gaussian(random, 2, BINS), np.arange(100, 300, 20)
    spectra = force * resonance(30.0) + 0.01 * gaussian(random, 2, BINS)

    def fit(response_unit, force_unit):
        reading = ideal_reading(response_unit * spectra)
        return local_fit(reading, force_unit * force, AT_REST[:2], lines, HALF_WIDTH)

    base, scaled = fit(1.0, 1.0), fit(3.0, 50.0)
    np.testing.assert_allclose(scaled.value, base.value * 3.0 / 50.0, rtol=1e-6)
    np.testing.assert_allclose(scaled.model_error, base.model_error * 3.0 / 50.0, rtol=1e-5)
    np.testing.assert_allclose(scaled.variance, base.variance * (3.0 / 50.0) ** 2, rtol=1e-6)
    np.testing.assert_allclose(
        scaled.variance_per_reference_noise, base.variance_per_reference_noise * (3.0 / 50.0**2) ** 2, rtol=1e-6
    )
    for name in ("coherence", "degrees_of_freedom", "independent_share"):
        np.testing.assert_allclose(getattr(scaled, name), getattr(base, name), rtol=1e-6)


def test_zero_padding_increases_the_variance():
    random = np.random.default_rng(10)
    force = gaussian(random, 3, BINS)
    reading = ideal_reading(force + 0.1 * gaussian(random, 3, BINS))
    lines = np.arange(50, 350, 7)
    without_padding, half_padding = (
        local_fit(reading, force, AT_REST[:3], lines, HALF_WIDTH, measured_share) for measured_share in (1.0, 0.5)
    )
    # If both fits have the same order, half of the equations (two for each bin of three segments) are lost.
    comparable = without_padding.degrees_of_freedom - half_padding.degrees_of_freedom == 3 * (2 * HALF_WIDTH + 1)
    assert comparable.mean() > 0.8
    np.testing.assert_array_equal(without_padding.value[comparable], half_padding.value[comparable])
    ratio = without_padding.degrees_of_freedom[comparable] / half_padding.degrees_of_freedom[comparable]
    np.testing.assert_allclose(half_padding.variance[comparable] / without_padding.variance[comparable], ratio)


@pytest.mark.parametrize("measured_share", [1.0, 0.5])
def test_covariance_of_padded_segments_equals_scatter(measured_share):
    random, size, lines = np.random.default_rng(11), 4096, np.arange(200, 1000, 10)
    half_width = int(HALF_WIDTH / measured_share)
    samples = int(measured_share * size)
    end_phases = np.exp(-2j * np.pi * np.arange(size // 2 + 1) * (1.0 - measured_share))[None]
    means, variances = [], []
    for _ in range(20):
        force = random.standard_normal(samples)
        noisy = force + 0.1 * random.standard_normal(samples)
        spectra = np.fft.rfft(np.pad([force, noisy], ((0, 0), (size - samples, 0))))[:, None]
        fit = local_fit(ideal_reading(spectra[1]), spectra[0], end_phases, lines, half_width, measured_share)
        errors = LocalErrors(
            fit.bin_weights, fit.first_bin, fit.residual, fit.fitted_response[:, 0], np.ones(lines.size),
            float(fit.degrees_of_freedom[0]) / 2.0, measured_share, False, np.zeros((lines.size, 0)),
        )  # fmt: skip
        covariance = SharedErrors.of(errors).covariance(np.sqrt(fit.variance)[:, None], 1.0)
        variances.append(covariance.of_sums(np.full((lines.size, 1, 1), 1.0 / lines.size + 0j))[0, 0])
        means.append(np.mean(fit.value - 1.0))
    scatter = np.mean(np.square(np.abs(means))) / 2.0
    assert 0.5 < np.mean(variances) / scatter < 1.9


@pytest.mark.parametrize("reference_noise", [0.0, 1e-3])
def test_single_response_separates_noise_of_reference(reference_noise):
    random, bins, lines = np.random.default_rng(18), np.arange(3000), np.arange(20, 2980, 8)
    response = sum(60.0 / (1j * (bins - peak) + 60.0) for peak in (900, 2100))
    force = gaussian(random, 2, bins.size)
    reading = ideal_reading(response * force + np.sqrt(1e-3) * gaussian(random, 2, bins.size))
    noisy_force = force + np.sqrt(reference_noise) * gaussian(random, 2, bins.size)
    fit = local_fit(reading, noisy_force, np.zeros((2, bins.size)), lines, HALF_WIDTH)
    errors = LocalErrors(
        fit.bin_weights, fit.first_bin, fit.residual, fit.fitted_response[:, 0], np.ones(lines.size),
        float(fit.degrees_of_freedom[0]) / 2.0, 1.0, True, np.zeros((lines.size, 0)),
    )  # fmt: skip
    estimated = SharedErrors.of(errors).covariance(np.sqrt(fit.variance)[:, None], 1.0).reference
    assert np.mean(estimated) == pytest.approx(reference_noise, rel=0.3, abs=3e-4)


def test_model_error_of_three_near_peaks_is_estimated():
    random = np.random.default_rng(11)
    # A denominator of second order cannot represent three peaks in one fit.
    truth = sum(5.0 / (1j * (OFFSET - peak) + 1.0) for peak in (-6.0, 0.0, 6.0))
    force = gaussian(random, 6, BINS)
    reading = ideal_reading(truth * force)
    lines = np.arange(20, 380)
    fit = local_fit(reading, force, AT_REST, lines, HALF_WIDTH)
    error = abs(fit.value - truth[lines])
    peaks, far_from_peaks = abs(OFFSET[lines]) < 8, abs(OFFSET[lines]) > 60
    scale = np.sqrt(np.mean(error[peaks] ** 2))
    assert 0.3 * scale < np.sqrt(np.mean(fit.model_error[peaks] ** 2)) < 3.0 * scale
    assert fit.model_error[far_from_peaks].max() < 0.01 * scale


def test_batch_size_does_not_change_fit(monkeypatch):
    random = np.random.default_rng(12)
    force = gaussian(random, 2, BINS)
    reading = ideal_reading(force * resonance(30.0) + 0.01 * gaussian(random, 2, BINS))
    lines = np.arange(5, 395, 9)
    single_batch = local_fit(reading, force, AT_REST[:2], lines, 10)
    monkeypatch.setattr(local_rational, "_MAX_ELEMENTS", 3000)
    small_batches = local_fit(reading, force, AT_REST[:2], lines, 10)
    np.testing.assert_allclose(small_batches.value, single_batch.value, rtol=1e-9)
    np.testing.assert_allclose(small_batches.model_error, single_batch.model_error, rtol=1e-6)


def test_lines_without_excitation_have_no_value():
    random = np.random.default_rng(13)
    reading = ideal_reading(gaussian(random, 2, BINS))
    fit = local_fit(reading, np.zeros((2, BINS), dtype=complex), AT_REST[:2], np.array([50, 60]), 8)
    assert np.isnan(fit.value).all()


def test_smooth_reference_resembles_a_transient():
    random = np.random.default_rng(21)
    smooth, lines = 1.0 + 2e-3 * np.arange(BINS)[None] ** 1.5, np.arange(100, 300, 10)
    one_transient = np.ones((1, BINS))
    for noise in (1e-3, 1e-1):
        noisy_reference = smooth * (1.0 + 0j) + noise * smooth * gaussian(random, 1, BINS)
        reading = ideal_reading(2.0 * smooth * (1.0 + 0j))
        fit = local_fit(reading, noisy_reference, one_transient, lines, HALF_WIDTH)
        assert np.median(fit.independent_share) < 2.0 * noise**2
        # If only noise distinguishes the reference from a smooth curve, the estimate tends to zero.
        assert np.median(abs(fit.value)) < 0.2
    noise_reference = gaussian(random, 1, BINS)
    reading = ideal_reading(2.0 * noise_reference)
    fit = local_fit(reading, noise_reference, one_transient, lines, HALF_WIDTH)
    assert np.median(fit.independent_share) > 0.5
