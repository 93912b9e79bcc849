"""Random errors of the responses of one test: covariance between outputs at each line, and between lines.

All responses are divided by the same reference, whose noise causes equal relative errors in all of them. Neighboring
lines of a local fit use the same bins. Both correlations determine the scatter of the parameters of a model that is
fitted to many lines. The errors of the readings are propagated to first order [1]_. An *element* is the response of one
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

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import LineCovariance, Lines, RandomErrors

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
# Maximum number of array elements of the noise covariances in memory at a time: 32 MB of complex values.
_MAX_ELEMENTS = 1 << 21


@dataclass(frozen=True)
class MeanErrors:
    """Selected lines of errors of ratios of means, independent from line to line.

    The array of the test is large. All elements and selections share it.
    """

    # factor of the covariance of the channels' means, for all elements of a test; shape (rows, channels, lines)
    test: ComplexArray
    lines: NDArray[np.intp]  # selected lines
    # deviation of each element in independent directions, (lines, directions); their products give covariances
    deviations: tuple[ComplexArray, ...]

    @classmethod
    def of(cls, test: ComplexArray, deviations: ComplexArray) -> MeanErrors:
        """Select all lines of the errors of one element."""
        return cls(test, np.arange(test.shape[2]), (deviations,))

    def at(self, lines: Lines) -> MeanErrors:
        """Return a copy with only the selected lines."""
        return replace(self, lines=self.lines[lines], deviations=tuple(each[lines] for each in self.deviations))

    def select(self, elements: Sequence[int]) -> MeanErrors:
        """Return a copy with only the selected elements of the response matrix."""
        return replace(self, deviations=tuple(self.deviations[k] for k in elements))

    def scaled(self, factor: ComplexArray) -> MeanErrors:
        """Multiply by a factor at each line."""
        return replace(self, deviations=tuple(each * factor[:, None] for each in self.deviations))

    def joined(self, others: Sequence[RandomErrors]) -> MeanErrors | None:
        """Join the errors of these and other elements."""
        same = [self]
        for other in others:
            if not isinstance(other, MeanErrors) or not np.array_equal(other.lines, self.lines):
                return None
            if other.test is not self.test and not np.array_equal(other.test, self.test, equal_nan=True):
                return None
            same.append(other)
        return replace(self, deviations=tuple(each for errors in same for each in errors.deviations))

    def covariance(self, error: Array, shared: float) -> LineCovariance:
        """Compute the covariance over elements, scaled to the stated variances, which include neighboring lines."""
        deviations = np.stack(self.deviations, axis=1)
        elements = deviations @ deviations.conj().swapaxes(1, 2)
        return LineCovariance(_add_uncorrelated(_scale_to_variances(elements, error)), shared)


@dataclass(frozen=True)
class LocalErrors:
    """Errors of the local fits to one element: sums over bins, most of which neighboring lines have in common."""

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


@dataclass(frozen=True)
class SharedErrors:
    """Errors of local fits at selected lines, for selected elements of the response matrix.

    The arrays of the fits are large. Selections, scaled responses and joined responses share them; only `covariance`
    makes copies.
    """

    elements: tuple[LocalErrors, ...]  # errors of each element, at all lines of the fits
    lines: NDArray[np.intp]  # selected lines
    factors: tuple[ComplexArray, ...]  # factor of each element at each selected line; shape (lines,)

    @classmethod
    def of(cls, errors: LocalErrors) -> SharedErrors:
        """Select all lines of the errors of one element."""
        n_lines = len(errors.first_bin)
        return cls((errors,), np.arange(n_lines), (np.ones(n_lines, dtype=complex),))

    def at(self, lines: Lines) -> SharedErrors:
        """Return a copy with only the selected lines."""
        return replace(self, lines=self.lines[lines], factors=tuple(factor[lines] for factor in self.factors))

    def select(self, elements: Sequence[int]) -> SharedErrors:
        """Return a copy with only the selected elements of the response matrix."""
        return replace(
            self, elements=tuple(self.elements[k] for k in elements), factors=tuple(self.factors[k] for k in elements)
        )

    def scaled(self, factor: ComplexArray) -> SharedErrors:
        """Multiply by a factor at each line."""
        return replace(self, factors=tuple(other * factor for other in self.factors))

    def joined(self, others: Sequence[RandomErrors]) -> SharedErrors | None:
        """Join the errors of these and other elements; None if their bins or references differ."""
        same = [self]
        for errors in others:
            if not isinstance(errors, SharedErrors) or not self._has_same_bins(errors):
                return None
            same.append(errors)
        return replace(
            self,
            elements=tuple(element for errors in same for element in errors.elements),
            factors=tuple(factor for errors in same for factor in errors.factors),
        )

    def _has_same_bins(self, other: SharedErrors) -> bool:
        first, second = self.elements[0], other.elements[0]
        return (
            first.residual.shape == second.residual.shape
            and np.array_equal(self.lines, other.lines)
            and np.array_equal(first.first_bin, second.first_bin)
            and (
                not first.has_single_reference
                or np.array_equal(first.reference_power, second.reference_power, equal_nan=True)
            )
        )

    def covariance(self, error: Array, shared: float) -> LocalCovariance:
        """Estimate the covariance over elements and lines, from the residuals around each line."""

        def join(name: str) -> ComplexArray:
            return np.stack([getattr(errors, name)[self.lines] for errors in self.elements], axis=1)

        first, factors = self.elements[0], np.stack(self.factors, axis=1)
        first_bin, fitted_response = first.first_bin[self.lines], join("fitted_response")
        bin_weights = join("bin_weights")
        bin_weights *= factors[..., None, None]
        common_error = join("common_error") * factors[..., None]
        n_lines, elements, _, width = bin_weights.shape
        # Zero padding correlates neighboring bins, and reduces the degrees of freedom in proportion to
        # `measured_share`. With these degrees of freedom, the result is the noise of a bin summed over all bins that
        # are correlated with it.
        power = self._residual_power() / first.complex_degrees_of_freedom
        bins, center = int(first_bin.max()) + width, first_bin + width // 2
        nearest = np.clip(np.searchsorted(0.5 * (center[1:] + center[:-1]), np.arange(bins)), 0, n_lines - 1)
        reference_ratio: Array | None = None
        noise = BinNoise(power, nearest)
        if all(errors.has_single_reference for errors in self.elements):
            reference_power = first.reference_power[self.lines]
            reference, variances, ratio = _separate_noise(power, fitted_response, reference_power, center)
            reference_ratio = first.measured_share * ratio
            within = np.clip(np.arange(bins) - first_bin[nearest], 0, width - 1)
            own_noise = np.einsum("ka,ab->kab", variances, np.eye(elements)).astype(complex)
            noise = BinNoise(own_noise, nearest, reference, fitted_response, within)
        covariance = np.empty((n_lines, elements, elements), dtype=complex)
        for lines in _blocks(n_lines, bin_weights[0].size + width * elements**2):
            by_bin = bin_weights[lines].transpose(0, 3, 1, 2).astype(complex)
            pairs = by_bin @ by_bin.conj().swapaxes(2, 3)
            local_noise = noise.covariance(first_bin[lines, None] + np.arange(width))
            covariance[lines] = np.einsum("kwac,kwac->kac", pairs, local_noise)
        covariance = covariance + common_error @ common_error.conj().swapaxes(1, 2)
        if reference_ratio is None:
            # The fit reproduces part of the noise, so the residuals may underestimate the noise.
            stated, variances = 2.0 * error**2, np.einsum("kaa->ka", covariance).real
            stated_ratio = np.divide(stated, variances, out=np.ones_like(variances), where=variances > 0.0)
            scale = np.sqrt(np.maximum(1.0, stated_ratio))
            covariance = covariance * scale[:, :, None] * scale[:, None]
        return LocalCovariance(
            _add_uncorrelated(covariance), shared, bin_weights, first_bin, common_error, first.shared, noise,
            reference_ratio,
        )  # fmt: skip

    def _residual_power(self) -> ComplexArray:
        """Return the cross-powers of the residuals, shape (lines, elements, elements)."""
        n_lines, elements = len(self.lines), len(self.elements)
        power = np.empty((n_lines, elements, elements), dtype=complex)
        for block in _blocks(n_lines, elements * self.elements[0].residual[0].size):
            lines = self.lines[block]
            residual = np.stack([errors.residual[lines].reshape(len(lines), -1) for errors in self.elements], axis=1)
            residual = residual.astype(complex)
            power[block] = residual @ residual.conj().swapaxes(1, 2)
        return power


@dataclass(frozen=True)
class BinNoise:
    """Covariance of the readings at each bin, computed on demand, because there are many more bins than lines."""

    lines: ComplexArray  # noise of the readings around each line; shape (lines, elements, elements)
    nearest: NDArray[np.int64]  # nearest line of each bin; shape (bins,)
    reference: Array | None = None  # noise power of the reference, common to all elements; shape (lines,)
    fitted_response: ComplexArray | None = None  # as in `LocalErrors`
    within: NDArray[np.int64] | None = None  # position of each bin in the fit of its nearest line; shape (bins,)

    def select(self, elements: Sequence[int]) -> BinNoise:
        """Return a copy with only the selected elements of the response matrix."""
        fitted = None if self.fitted_response is None else self.fitted_response[:, elements]
        return replace(self, lines=self.lines[:, elements][:, :, elements], fitted_response=fitted)

    def covariance(self, bins: NDArray[np.int64]) -> ComplexArray:
        """Return the covariance at given bins, shape (*bins.shape, elements, elements)."""
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
    bin_weights: ComplexArray  # as in `LocalErrors`, of all elements; shape (lines, elements, segments, width)
    first_bin: NDArray[np.int64]  # as in `LocalErrors`
    common_error: ComplexArray  # as in `LocalErrors`, of all elements; shape (lines, elements, parts)
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

    def select(self, elements: Sequence[int]) -> LocalCovariance:
        """Return a copy with only the selected elements of the response matrix."""
        return replace(
            self,
            lines=self.lines[:, elements][:, :, elements],
            bin_weights=self.bin_weights[:, elements],
            common_error=self.common_error[:, elements],
            noise=self.noise.select(elements),
        )

    def of_sums(self, weights: ComplexArray) -> Array:
        """Compute the covariance of weighted sums over lines and elements; `weights`: shape (lines, elements, sums)."""
        from scipy.sparse import csr_array

        segments, width = self.bin_weights.shape[2:]
        elements, sums = weights.shape[1:]
        total = np.zeros((sums, sums))
        bins = int(self.first_bin.max()) + width
        step = max(width, _MAX_ELEMENTS // (elements * (elements + sums)))
        for begin in range(0, bins, step):
            end = min(begin + step, bins)
            # Lines whose fits use these bins.
            lines = np.flatnonzero((self.first_bin < end) & (self.first_bin > begin - width))
            columns = self.first_bin[lines, None] + np.arange(width) - begin
            is_inside = (columns >= 0) & (columns < end - begin)
            row_pointer = np.append(0, np.cumsum(is_inside.sum(axis=1)))
            noise = self.noise.covariance(np.arange(begin, end))
            for segment in range(segments):
                by_element = []
                for k in range(elements):
                    bin_weights = self.bin_weights[lines, k, segment][is_inside]
                    matrix = csr_array((bin_weights, columns[is_inside], row_pointer), shape=(lines.size, end - begin))
                    by_element.append((matrix.T @ weights[lines, k].conj()).T)
                by_bin = np.stack(by_element, axis=2)
                total += np.einsum("pbi,bij,qbj->pq", by_bin, noise, by_bin.conj(), optimize=True).real
        common = np.einsum("kap,kaj->pj", weights.conj(), self.common_error, optimize=True).real
        total *= 0.5 * self.shared_bins
        variances = np.einsum("kaa->ka", self.lines).real * (0.5 * self.shared * _UNCORRELATED / (1.0 + _UNCORRELATED))
        total += np.einsum("kap,ka,kaq->pq", weights.conj(), variances, weights, optimize=True).real
        return np.asarray(total + common @ common.T)


def _blocks(n_lines: int, elements_per_line: int) -> Iterator[slice]:
    """Yield blocks of lines whose arrays have at most `_MAX_ELEMENTS` elements."""
    step = max(1, _MAX_ELEMENTS // max(elements_per_line, 1))
    for begin in range(0, n_lines, step):
        yield slice(begin, begin + step)


def _scale_to_variances(covariance: ComplexArray, error: Array) -> ComplexArray:
    """Scale covariances to stated standard uncertainties of the real and of the imaginary part."""
    stated, variances = 2.0 * error**2, np.einsum("kaa->ka", covariance).real
    with np.errstate(invalid="ignore"):
        scale = np.sqrt(np.divide(stated, variances, out=np.ones_like(variances), where=variances > 0.0))
    return np.asarray(covariance * scale[:, :, None] * scale[:, None])


def _add_uncorrelated(covariance: ComplexArray) -> ComplexArray:
    """Add uncorrelated variances to covariances, shape (lines, elements, elements)."""
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
    power of each response, shape (lines, elements); and the ratio of the noise power of the reference to its power,
    shape (lines,).

    `power`: cross-powers of the residuals, shape (lines, elements, elements); `fitted_response`, `reference_power`: as
    in `LocalErrors`; `center`: bin at the middle of each fit.
    """
    lines, elements, width = fitted_response.shape
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
        if elements == 1:
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
