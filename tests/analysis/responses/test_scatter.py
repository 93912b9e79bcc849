"""Variances of estimates from few averages: not negative, pooled with neighboring lines (moderated), accurate."""

import numpy as np
import pytest
from scipy import stats

from analysis.core.responses import estimators
from analysis.core.responses.errors.scatter import Scatter, moderate
from analysis.core.responses.errors.systematic import jitter_limit
from analysis.core.responses.estimators import AveragedSpectra, square_root
from analysis.core.responses.lock_in import LockIn, parts_of_whole_periods
from analysis.core.responses.measurands import motion_of, reference_of
from daq.core.recording.recording import Recording
from rig.core.base.errors import RunError
from tests.analysis.responses.synthetic import stepped_sine


def complex_noise(seed, *shape):
    random = np.random.default_rng(seed)
    return random.standard_normal(shape) + 1j * random.standard_normal(shape)


@pytest.mark.parametrize("seed", range(20))
def test_variance_is_zero_for_weights_orthogonal_to_scatter(seed):
    rows = complex_noise(seed, 2, 4, 50) * np.array([1.0, 1e3, 1e-3, 1e6])[:, None]
    # Weights orthogonal to both rows.
    weights = np.stack([np.linalg.svd(rows[:, :, n])[2][-1].conj() for n in range(50)], axis=1)

    variance = Scatter(rows, np.full(50, 2.0)).variance(weights)

    assert (variance >= 0.0).all()
    assert np.sqrt(variance).max() < 1e-9 * abs(rows).max()


@pytest.mark.parametrize("degrees_of_freedom", [2, 4, 10])
def test_moderated_uncertainty_covers_95_percent_of_errors(degrees_of_freedom):
    lines = 4000
    error = complex_noise(1, lines) / np.sqrt(2.0)
    single_variance = np.random.default_rng(2).chisquare(degrees_of_freedom, lines) / degrees_of_freedom

    variance, moderated_degrees = moderate(
        single_variance, np.full(lines, float(degrees_of_freedom)), np.full(lines, 3.0), 12
    )

    # The squared magnitude over the variance has an F distribution.
    normalized = abs(error) / np.sqrt(variance * stats.f.ppf(0.95, 2.0, moderated_degrees))
    assert 0.94 < np.mean(normalized <= 1.0) < 0.96
    assert normalized.max() < 3.0


def test_different_variances_are_hardly_moderated():
    lines = 400
    true_variance = np.exp(3.0 * np.random.default_rng(3).standard_normal(lines))
    single_variance = true_variance * np.random.default_rng(4).chisquare(8.0, lines) / 8.0

    variance, moderated_degrees = moderate(single_variance, np.full(lines, 8.0), np.ones(lines), 12)

    assert moderated_degrees.max() < 10.0
    assert np.median(abs(np.log(variance / single_variance))) < 0.3


@pytest.mark.parametrize("seed", range(10))
def test_coherence_of_dependent_channels_is_at_most_one(seed, tmp_path):
    # The spring force is a small difference of two readings: rounding could make its power negative.
    path = stepped_sine(tmp_path / "a.mcap", [20.0], periods=2)
    motion = complex_noise(seed, 40)
    readings = np.array([1.0, 0.3, 0.2, 1.0 + 1e-7])
    cross = abs(motion)[:, None, None] ** 2 * np.outer(readings, readings) + 0j
    with Recording(path) as recording:
        factor = square_root(cross).transpose(2, 1, 0)
        averages = AveragedSpectra(tuple(recording.channels), np.linspace(10.0, 50.0, 40), factor, 30.0, 0.0)

        frf = averages.frf(recording, motion_of(recording, "body3"), reference_of(recording, "force"))

    assert np.isfinite(frf.error).all()
    assert ((frf.coherence >= 0.0) & (frf.coherence <= 1.0)).all()


@pytest.mark.parametrize("seed", range(10))
def test_square_root_keeps_small_elements(seed):
    scale = np.array([1e-9, 1.0, 1e9])
    factor = scale[:, None] * complex_noise(seed, 5, 3, 1)
    matrices = factor @ factor.conj().swapaxes(1, 2)

    root = square_root(matrices)

    product = root @ root.conj().swapaxes(1, 2)
    assert (abs(product - matrices) <= 1e-12 * np.outer(scale, scale) * 100.0).all()


@pytest.mark.parametrize("n_blocks, n_channels", [(3, 8), (8, 3)])
def test_factor_of_averages_has_few_rows(n_blocks, n_channels):
    blocks = complex_noise(4, n_blocks, n_channels, 5)
    averages = estimators._Averages(min(n_blocks, n_channels), n_channels, 5, "averaging")
    for spectra in blocks:
        averages.add(spectra)
    factor = averages.factor()
    assert factor.shape == (3, n_channels, 5)
    expected = np.einsum("bin,bjn->nij", blocks, blocks.conj()) / n_blocks
    np.testing.assert_allclose(np.einsum("rin,rjn->nij", factor, factor.conj()), expected, atol=1e-12)


def test_averages_of_many_channels_are_refused():
    with pytest.raises(RunError, match="averaging would need"):
        estimators._Averages(1000, 1000, 10_000, "averaging")


def test_large_offset_does_not_change_residual():
    time = np.arange(4000) / 5120.0
    noise = 1e-4 * np.random.default_rng(5).standard_normal((1, 4000))
    lock_in = LockIn(10.24, 5120.0, 3)
    lock_in.add(1e5 + 2.0 * np.cos(2 * np.pi * 10.24 * time)[None] + noise, [1000] * 4)

    assert lock_in.tone().residual[0] == pytest.approx(1e-4, rel=0.05)


def test_harmonics_change_all_parts_of_a_window_equally():
    frequency, rate = 12.804, 5120.0
    parts = parts_of_whole_periods(0, 8000, frequency, rate)
    cycles = frequency / rate * np.arange(parts[-1][1])
    # Pulses of a tenth of a period, with harmonics above the three that are fitted.
    pulses = np.exp(-0.5 * (((cycles % 1.0) - 0.07) / 0.02) ** 2)
    lock_in = LockIn(frequency, rate, 3)
    lock_in.add((np.cos(2 * np.pi * cycles) + pulses)[None], [stop - first for first, stop in parts])

    fundamentals = lock_in.tone().parts
    assert np.ptp(abs(fundamentals)) < 5e-5
    assert np.ptp(np.angle(fundamentals)) < 5e-5


@pytest.mark.parametrize("time_constant", [1.0, 4.0])
def test_settling_bias_does_not_change_tone(time_constant):
    frequency, rate = 10.24, 5120.0
    time = np.arange(10_000) / rate
    bias = 5.0 * np.exp(-time / time_constant)
    lock_in = LockIn(frequency, rate, 3)
    lock_in.add((2.0 * np.cos(2 * np.pi * frequency * time) + bias)[None], [500] * 20)

    tone = lock_in.tone()
    assert tone.amplitude[0, 0] == pytest.approx(2.0, abs=2e-4)
    assert abs(tone.parts - 2.0).max() < 3e-3


def test_residual_excludes_curved_drift():
    time = np.arange(10_000) / 5120.0
    noise = 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    lock_in = LockIn(10.24, 5120.0, 3)
    lock_in.add((2.0 * np.cos(2 * np.pi * 10.24 * time) + 5.0 * np.exp(-time) + noise)[None], [500] * 20)

    assert lock_in.tone().residual[0] == pytest.approx(1e-3, rel=0.05)


def test_noise_excludes_harmonics_that_repeat():
    frequency, rate, deviation = 12.8, 5120.0, 0.01
    parts = parts_of_whole_periods(0, 8000, frequency, rate)
    cycles = frequency / rate * np.arange(parts[-1][1])
    pulses = np.exp(-0.5 * (((cycles % 1.0) - 0.07) / 0.02) ** 2)
    noise = deviation * np.random.default_rng(1).standard_normal(cycles.size)
    lock_in = LockIn(frequency, rate, 3)
    lock_in.add((np.cos(2 * np.pi * cycles) + pulses + noise)[None], [stop - first for first, stop in parts])

    tone = lock_in.tone()
    assert tone.residual[0] > 10.0 * deviation
    assert 0.7 * deviation < tone.noise[0] < 1.1 * deviation


def test_bound_of_canceled_jitter_is_not_negative():
    factor = np.random.default_rng(6).standard_normal((2, 3))
    orthogonal = np.cross(factor[0], factor[1])[:, None].repeat(5, axis=1) + 0j

    (bound,) = jitter_limit(factor, orthogonal, np.ones(5)).values()

    assert (bound >= 0.0).all()
    assert bound.max() < 1e-12
