"""Random errors of the responses of one test: covariance between outputs at each line, and between lines.

All responses are divided by the same reference, whose noise causes equal relative errors in all of them. Neighboring
lines of a local fit use the same bins. Both correlations determine the scatter of the parameters of a model that is
fitted to many lines. The errors of the readings are propagated to first order [1]_. An *entry* is the response of one
output to one input. A *bin* is a frequency of the discrete Fourier transform; a *line* is a frequency at which the
response is estimated. `shared` is the number of neighboring lines with a common error.

References
----------
.. [1] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012, sections 2.5
   and 9.4.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import Covariance, LineCovariance, Lines, RandomErrors

# The noise level is assumed to be constant over this number of widths of a local fit.
_CONSTANT_NOISE_WIDTHS = 5
# Number of iterations of the weighted fit that separates noise of reference and responses; fewer suffice.
_ITERATIONS = 4
# The noise power of a response is at least this fraction of the residual of a local fit.
_MIN_NOISE_RATIO = 1e-6
# With a single response, noise of the reference and noise of the response are distinguished only where the magnitude of
# the response varies, which is near peaks. The equations of each line therefore include those of the whole test, with
# this weight.
_WHOLE_TEST_WEIGHT = 0.1
# Value that replaces zero power; it is so large that its square does not underflow to zero.
_ZERO_POWER = 1e-40
# Variance that is uncorrelated between responses, due to errors of second order and covariances of few averages,
# relative to the computed variance. Tuned on chains of bodies with 3 % of reference noise: with 0.001, the scatter was
# twice the stated uncertainty.
_UNCORRELATED = 0.05
# Maximum number of array values of the noise covariances in memory at a time: 32 MB of complex values.
_MAX_ELEMENTS = 1 << 21


@dataclass(frozen=True)
class SharedErrors:
    """Random errors of selected entries of a response matrix, at selected lines, of readings that they may share.

    The arrays of a test are large. Selections, scaled responses and joined responses share them; only `covariance`
    makes copies.
    """

    entries: tuple[MeanErrors | LocalErrors, ...]  # errors of each entry, at all lines of the test
    lines: NDArray[np.intp]  # selected lines
    factors: tuple[ComplexArray, ...]  # factor of each entry at each selected line; shape (lines,)

    @classmethod
    def of(cls, errors: MeanErrors | LocalErrors) -> SharedErrors:
        """Select all lines of the errors of one entry."""
        n_lines = len(errors.residual)
        return cls((errors,), np.arange(n_lines), (np.ones(n_lines, dtype=complex),))

    def at(self, lines: Lines) -> SharedErrors:
        """Return a copy with only the selected lines."""
        return replace(self, lines=self.lines[lines], factors=tuple(factor[lines] for factor in self.factors))

    def select(self, entries: Sequence[int]) -> SharedErrors:
        """Return a copy with only the selected entries of the response matrix."""
        return replace(
            self, entries=tuple(self.entries[k] for k in entries), factors=tuple(self.factors[k] for k in entries)
        )

    def scaled(self, factor: ComplexArray) -> SharedErrors:
        """Multiply by a factor at each line."""
        return replace(self, factors=tuple(other * factor for other in self.factors))

    def joined(self, others: Sequence[RandomErrors]) -> SharedErrors | None:
        """Join these errors with those of other entries of the response matrix; None if their readings differ."""
        same = [self]
        for other in others:
            if not (
                isinstance(other, SharedErrors)
                and np.array_equal(self.lines, other.lines)
                and self.entries[0].has_same_readings(other.entries[0])
            ):
                return None
            same.append(other)
        return replace(
            self,
            entries=tuple(entry for errors in same for entry in errors.entries),
            factors=tuple(factor for errors in same for factor in errors.factors),
        )

    def covariance(self, error: Array, shared: float) -> Covariance:
        """Estimate the covariance over entries, and of local fits between lines; `error`: stated uncertainty."""
        first: Any = self.entries[0]  # all entries are of the same kind
        covariance: Covariance = first.covariance(
            self.entries, self.lines, np.stack(self.factors, axis=1), error, shared
        )
        return covariance


@dataclass(frozen=True)
class MeanErrors:
    """Errors of an entry that is a ratio of means, independent from line to line."""

    # factor of the covariance of the channels' means, for all entries of a test; shape (rows, channels, lines)
    test: ComplexArray
    # deviation of the entry in independent directions, (lines, directions); their products give covariances
    residual: ComplexArray

    def has_same_readings(self, other: MeanErrors | LocalErrors) -> bool:
        """Return whether another entry is of the same test."""
        return isinstance(other, MeanErrors) and (
            other.test is self.test or np.array_equal(other.test, self.test, equal_nan=True)
        )

    @staticmethod
    def covariance(
        entries: Sequence[MeanErrors], lines: NDArray[np.intp], factors: ComplexArray, error: Array, shared: float
    ) -> LineCovariance:
        """Compute the covariance over entries, scaled to the stated variances, which include neighboring lines."""
        residual = np.stack([entry.residual[lines] for entry in entries], axis=1) * factors[:, :, None]
        covariance = residual @ residual.conj().swapaxes(1, 2)
        return LineCovariance(_add_uncorrelated(_scale_to_variances(covariance, error)), shared)


@dataclass(frozen=True)
class LocalErrors:
    """Errors of the local fits to one entry: sums over bins, most of which neighboring lines have in common."""

    # change of the response per unit change of the reading at each bin; shape (lines, segments, width)
    bin_weights: ComplexArray
    first_bin: NDArray[np.int64]  # first bin of each line's fit; shape (lines,)
    residual: ComplexArray  # residual of the reading; shape (lines, segments, width)
    fitted_response: ComplexArray  # reading per unit of the reference, as fitted; shape (lines, width)
    reference_power: Array  # mean square of the reference over the bins of each fit; shape (lines,)
    complex_degrees_of_freedom: float  # degrees of freedom of the residual of each fit, in complex values
    measured_share: float  # measured share of the samples of the spectra, as in `local_fit`
    has_single_reference: bool  # whether the reference is a single channel that is not part of the response
    # errors common to all lines, each with a real coefficient of variance 1; shape (lines, parts)
    common_error: ComplexArray
    shared: float = 1.0  # number of neighboring lines with a common error although they have no bins in common

    def has_same_readings(self, other: MeanErrors | LocalErrors) -> bool:
        """Return whether the fits to another entry use the same bins and the same reference."""
        return (
            isinstance(other, LocalErrors)
            and self.residual.shape == other.residual.shape
            and np.array_equal(self.first_bin, other.first_bin)
            and (
                not self.has_single_reference
                or np.array_equal(self.reference_power, other.reference_power, equal_nan=True)
            )
        )

    @staticmethod
    def covariance(
        entries: Sequence[LocalErrors], lines: NDArray[np.intp], factors: ComplexArray, error: Array, shared: float
    ) -> LocalCovariance:
        """Estimate the covariance over entries and lines, from the residuals around each line."""

        def join(name: str) -> ComplexArray:
            return np.stack([getattr(entry, name)[lines] for entry in entries], axis=1)

        first, first_bin, fitted_response = entries[0], entries[0].first_bin[lines], join("fitted_response")
        bin_weights = join("bin_weights")
        bin_weights *= factors[..., None, None]
        common_error = join("common_error") * factors[..., None]
        n_lines, n_entries, _, width = bin_weights.shape
        # Zero padding correlates neighboring bins, and reduces the degrees of freedom in proportion to
        # `measured_share`. With these degrees of freedom, the result is the noise of a bin summed over all bins that
        # are correlated with it.
        power = _residual_power(entries, lines) / first.complex_degrees_of_freedom
        bins, center = int(first_bin.max()) + width, first_bin + width // 2
        nearest = np.clip(np.searchsorted(0.5 * (center[1:] + center[:-1]), np.arange(bins)), 0, n_lines - 1)
        reference_ratio: Array | None = None
        noise = BinNoise(power, nearest)
        if all(entry.has_single_reference for entry in entries):
            reference_power = first.reference_power[lines]
            reference, variances, ratio = _separate_noise(power, fitted_response, reference_power, center)
            reference_ratio = first.measured_share * ratio
            within = np.clip(np.arange(bins) - first_bin[nearest], 0, width - 1)
            own_noise = np.einsum("ka,ab->kab", variances, np.eye(n_entries)).astype(complex)
            noise = BinNoise(own_noise, nearest, reference, fitted_response, within)
        covariance = np.empty((n_lines, n_entries, n_entries), dtype=complex)
        for block in _blocks(n_lines, bin_weights[0].size + width * n_entries**2):
            by_bin = bin_weights[block].transpose(0, 3, 1, 2).astype(complex)
            pairs = by_bin @ by_bin.conj().swapaxes(2, 3)
            local_noise = noise.covariance(first_bin[block, None] + np.arange(width))
            covariance[block] = np.einsum("kwac,kwac->kac", pairs, local_noise)
        covariance = covariance + common_error @ common_error.conj().swapaxes(1, 2)
        if reference_ratio is None:
            # The fit reproduces part of the noise, so the residuals may underestimate the noise.
            covariance = _scale_to_variances(covariance, error, min_ratio=1.0)
        return LocalCovariance(
            _add_uncorrelated(covariance), shared, bin_weights, first_bin, common_error, first.shared, noise,
            reference_ratio,
        )  # fmt: skip


@dataclass(frozen=True)
class BinNoise:
    """Covariance of the readings at each bin, computed on demand, because there are many more bins than lines."""

    lines: ComplexArray  # noise of the readings around each line; shape (lines, entries, entries)
    nearest: NDArray[np.int64]  # nearest line of each bin; shape (bins,)
    reference: Array | None = None  # noise power of the reference, common to all entries; shape (lines,)
    fitted_response: ComplexArray | None = None  # as in `LocalErrors`
    within: NDArray[np.int64] | None = None  # position of each bin in the fit of its nearest line; shape (bins,)

    def select(self, entries: Sequence[int]) -> BinNoise:
        """Return a copy with only the selected entries of the response matrix."""
        fitted = None if self.fitted_response is None else self.fitted_response[:, entries]
        return replace(self, lines=self.lines[:, entries][:, :, entries], fitted_response=fitted)

    def covariance(self, bins: NDArray[np.int64]) -> ComplexArray:
        """Return the covariance at given bins, shape (*bins.shape, entries, entries)."""
        nearest = self.nearest[bins]
        covariance = self.lines[nearest]
        if self.reference is not None and self.fitted_response is not None and self.within is not None:
            response = self.fitted_response[nearest, :, self.within[bins]]
            common = self.reference[nearest][..., None, None] * response[..., :, None] * response[..., None, :].conj()
            covariance += common
        return covariance


@dataclass(frozen=True)
class LocalCovariance:
    """Covariance of the errors of local fits, whose lines have bins in common; attributes as in `Covariance`."""

    lines: ComplexArray
    shared: float
    bin_weights: ComplexArray  # as in `LocalErrors`, of all entries; shape (lines, entries, segments, width)
    first_bin: NDArray[np.int64]  # as in `LocalErrors`
    common_error: ComplexArray  # as in `LocalErrors`, of all entries; shape (lines, entries, parts)
    shared_bins: float  # `LocalErrors.shared`
    noise: BinNoise  # noise of the readings at each bin
    # noise power of the reference, relative to its power, shape (lines,); None if it is not estimated
    reference: Array | None

    def at(self, lines: Lines) -> LocalCovariance:
        """Return a copy with only the selected lines."""
        return replace(
            self,
            lines=self.lines[lines],
            bin_weights=self.bin_weights[lines],
            first_bin=self.first_bin[lines],
            common_error=self.common_error[lines],
            reference=None if self.reference is None else self.reference[lines],
        )

    def select(self, entries: Sequence[int]) -> LocalCovariance:
        """Return a copy with only the selected entries of the response matrix."""
        return replace(
            self,
            lines=self.lines[:, entries][:, :, entries],
            bin_weights=self.bin_weights[:, entries],
            common_error=self.common_error[:, entries],
            noise=self.noise.select(entries),
        )

    def of_sums(self, weights: ComplexArray) -> Array:
        """Compute the covariance of weighted sums over lines and entries; `weights`: shape (lines, entries, sums)."""
        from scipy.sparse import csr_array

        segments, width = self.bin_weights.shape[2:]
        entries, sums = weights.shape[1:]
        total = np.zeros((sums, sums))
        bins = int(self.first_bin.max()) + width
        step = max(width, _MAX_ELEMENTS // (entries * (entries + sums)))
        for begin in range(0, bins, step):
            end = min(begin + step, bins)
            # Lines whose fits use these bins.
            lines = np.flatnonzero((self.first_bin < end) & (self.first_bin > begin - width))
            columns = self.first_bin[lines, None] + np.arange(width) - begin
            is_inside = (columns >= 0) & (columns < end - begin)
            row_pointer = np.append(0, np.cumsum(is_inside.sum(axis=1)))
            noise = self.noise.covariance(np.arange(begin, end))
            for segment in range(segments):
                by_entry = []
                for k in range(entries):
                    bin_weights = self.bin_weights[lines, k, segment][is_inside]
                    matrix = csr_array((bin_weights, columns[is_inside], row_pointer), shape=(lines.size, end - begin))
                    by_entry.append((matrix.T @ weights[lines, k].conj()).T)
                by_bin = np.stack(by_entry, axis=2)
                total += np.einsum("pbi,bij,qbj->pq", by_bin, noise, by_bin.conj(), optimize=True).real
        common = np.einsum("kap,kaj->pj", weights.conj(), self.common_error, optimize=True).real
        total *= 0.5 * self.shared_bins
        variances = np.einsum("kaa->ka", self.lines).real * (0.5 * self.shared * _UNCORRELATED / (1.0 + _UNCORRELATED))
        total += np.einsum("kap,ka,kaq->pq", weights.conj(), variances, weights, optimize=True).real
        return np.asarray(total + common @ common.T)


def _blocks(n_lines: int, values_per_line: int) -> Iterator[slice]:
    """Yield blocks of lines whose arrays have at most `_MAX_ELEMENTS` values."""
    step = max(1, _MAX_ELEMENTS // max(values_per_line, 1))
    for begin in range(0, n_lines, step):
        yield slice(begin, begin + step)


def _residual_power(entries: Sequence[LocalErrors], lines: NDArray[np.intp]) -> ComplexArray:
    """Return the cross-powers of the residuals, shape (lines, entries, entries)."""
    power = np.empty((len(lines), len(entries), len(entries)), dtype=complex)
    for block in _blocks(len(lines), len(entries) * entries[0].residual[0].size):
        residual = np.stack([entry.residual[lines[block]] for entry in entries], axis=1).astype(complex)
        residual = residual.reshape(*residual.shape[:2], -1)
        power[block] = residual @ residual.conj().swapaxes(1, 2)
    return power


def _scale_to_variances(covariance: ComplexArray, error: Array, min_ratio: float = 0.0) -> ComplexArray:
    """Scale covariances to stated standard uncertainties of the real and of the imaginary part.

    `min_ratio`: smallest ratio of the scaled variances to the given.
    """
    stated, variances = 2.0 * error**2, np.einsum("kaa->ka", covariance).real
    with np.errstate(invalid="ignore"):
        ratio = np.divide(stated, variances, out=np.ones_like(variances), where=variances > 0.0)
        scale = np.sqrt(np.maximum(min_ratio, ratio))
    return np.asarray(covariance * scale[:, :, None] * scale[:, None])


def _add_uncorrelated(covariance: ComplexArray) -> ComplexArray:
    """Add uncorrelated variances to covariances, shape (lines, entries, entries)."""
    index = np.arange(covariance.shape[1])
    covariance = covariance.copy()
    covariance[:, index, index] += _UNCORRELATED * np.einsum("kaa->ka", covariance).real
    return covariance


def _separate_noise(
    power: ComplexArray, fitted_response: ComplexArray, reference_power: Array, center: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Separate noise of the reference, common to all responses, from noise of each response.

    The cross-powers of the residuals of local fits have two parts: the cross-powers of the fitted responses times the
    noise power of the reference, and the noise power of each response. Both noise powers are estimated by weighted
    least squares over the lines around each line. Returns the noise power of the reference, shape (lines,); the noise
    power of each response, shape (lines, entries); and the ratio of the noise power of the reference to its power,
    shape (lines,).

    `power`: cross-powers of the residuals, shape (lines, entries, entries); `fitted_response`, `reference_power`: as
    in `LocalErrors`; `center`: bin at the middle of each fit.
    """
    lines, entries, width = fitted_response.shape
    # In a short test all fits use the same bins, so the median distance of their centers is 0; each line has one bin.
    bins_per_line = max(float(np.median(np.diff(center))), 1.0) if lines > 1 else 1.0
    # Lines of the local means.
    n_lines = min(1 + 2 * int(np.ceil(_CONSTANT_NOISE_WIDTHS * width / bins_per_line / 2.0)), max(lines, 1))
    curve_power = fitted_response @ fitted_response.conj().swapaxes(1, 2) / width
    variances = np.einsum("kaa->ka", power).real
    curve_variances = np.einsum("kaa->ka", curve_power).real

    def local_mean(values: Array) -> Array:
        return np.asarray(scipy.ndimage.uniform_filter1d(values, n_lines, axis=0, mode="nearest"))

    expected = np.maximum(scipy.ndimage.uniform_filter1d(variances, 3, axis=0, mode="nearest"), _ZERO_POWER)
    for _ in range(_ITERATIONS):
        pairs = expected[:, :, None] * expected[:, None]
        # Normal equations of the noise of the reference and of each response; the noise of the responses is eliminated.
        a_reference = local_mean(np.sum(abs(curve_power) ** 2 / pairs, axis=(1, 2)))
        a_mixed, a_response = local_mean(curve_variances / expected**2), local_mean(1.0 / expected**2)
        b_reference = local_mean(np.sum((power * curve_power.conj()).real / pairs, axis=(1, 2)))
        b_response = local_mean(variances / expected**2)
        reduced = a_reference - np.sum(a_mixed**2 / a_response, axis=1)
        right = b_reference - np.sum(a_mixed * b_response / a_response, axis=1)
        if entries == 1:
            reduced, right = (values + _WHOLE_TEST_WEIGHT * values.mean() for values in (reduced, right))
        is_regular = reduced > 1e-6 * a_reference
        reference = np.where(is_regular, right, 0.0)
        reference = np.maximum(reference / np.where(is_regular, reduced, 1.0), 0.0)
        min_noise = _MIN_NOISE_RATIO * local_mean(variances)
        response_noise = np.maximum((b_response - a_mixed * reference[:, None]) / a_response, min_noise)
        expected = np.maximum(reference[:, None] * curve_variances + response_noise, _ZERO_POWER)
    mean_power = local_mean(reference_power)
    noise_ratio = np.divide(reference, mean_power, out=np.zeros_like(mean_power), where=mean_power > 0.0)
    return np.asarray(reference), np.asarray(response_noise), noise_ratio
