"""Estimators H1, H2 and Hv from windowed and averaged spectra of blocks of a recording (Welch).

References
----------
.. [1] G. T. Rocklin, J. Crowley, H. Vold, A comparison of H1, H2 and Hv frequency response functions, Proceedings of
   the 3rd International Modal Analysis Conference (1985).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.recordings.slices import read_slices
from analysis.core.responses.checks.clean_segments import Flaw, find_flaws
from analysis.core.responses.checks.several_inputs import MAX_CONDITION_NUMBER, condition, unit_power
from analysis.core.responses.errors.budget import Quotient
from analysis.core.responses.errors.random_errors import MeanErrors, SharedErrors
from analysis.core.responses.errors.systematic import (
    LEAKAGE,
    REFERENCE_NOISE,
    reference_noise_limit,
    rounding_limit,
    shared_noise_limit,
    zero_safe_product,
)
from analysis.core.responses.measurands import Measurand, reject_zero_reference
from analysis.core.responses.segment_fits import SegmentFits
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.base.progress import CountProgress
from rig.core.numerics.memory import require_memory_with_program
from rig.core.results.response import Response

ESTIMATORS = ("H1", "H2", "Hv")
# Number of copies of the factor of the spectral matrix that are in memory at a time.
_COPIES = 1.2
# Number of lines whose spectral matrices are factorized at a time, to limit the memory.
_FACTORED_LINES = 256


def estimate(estimator: str, sxx: Array, sff: Array, sxf: ComplexArray) -> ComplexArray:
    """Estimate a frequency response from auto and cross spectra.

    `estimator`: 'H1', 'H2' or 'Hv'. H1 assumes a reference without noise, H2 a response without noise; Hv is the
    geometric mean of both; `sxx`, `sff`: mean of abs(X)² and of abs(F)²; `sxf`: mean of X conj(F).

    >>> x, f = np.array([2.0 - 2.0j]), np.array([1.0 + 0.0j])
    >>> [complex(estimate(name, abs(x)**2, abs(f)**2, x * f.conj())[0].round(12)) for name in ESTIMATORS]
    [(2-2j), (2-2j), (2-2j)]
    """
    if estimator == "H1":
        return sxf / sff
    if estimator == "H2":
        return sxx / sxf.conj()
    if estimator == "Hv":
        return sxf / abs(sxf) * np.sqrt(sxx / sff)
    raise SceneError(f"estimator: got {estimator!r}; expected {', '.join(ESTIMATORS)}")


@dataclass(frozen=True)
class AveragedSpectra:
    """Spectral matrix of the recorded channels, averaged over blocks, as a factor.

    The powers in `frf` are sums of squares of the factor. The size of the factor is linear in the number of channels.
    """

    channels: tuple[str, ...]  # names
    frequency: Array  # Hz; shape (n,)
    # factor S (rows, channels, n): the mean of Y_i conj(Y_j) as recorded is the sum of ``S_i conj(S_j)`` over rows
    factor: ComplexArray
    n_averages: float  # equivalent number of independent blocks; overlapping blocks count as fewer
    resolution: float  # bandwidth of the window in Hz; 0 without leakage (bursts that end inside their block)
    warnings: tuple[str, ...] = ()  # in full sentences
    # largest relative change of each channel's gain due to rounding, as in `rounding_limit`; shape (channels, n)
    rounding_gain_error: Array = field(default_factory=lambda: np.zeros((1, 1)))
    # local fits to the same test; their difference from the averages is the leakage. None: the averages have no leakage
    leakage_free: SegmentFits | None = None
    estimator: str = "H1"  # or ``"H2"``, ``"Hv"``

    def frf(
        self, rec: Recording, numerator: Measurand, denominator: Measurand, others: Sequence[Measurand] = ()
    ) -> Response:
        """Estimate a frequency response with coherence; random error by Bendat and Piersol, Random Data, eq. 9.90.

        `others`: other inputs. Numerator and denominator are conditioned on them (section 7.3).
        """
        quotient = Quotient(rec, numerator, denominator, others, self.frequency)
        names, response_weights, reference_weights = (
            quotient.names,
            quotient.response_weights,
            quotient.reference_weights,
        )
        positions = [self.channels.index(name) for name in names]
        factor = self.factor[:, positions]
        rounding = np.broadcast_to(self.rounding_gain_error, (len(self.channels), self.frequency.size))[positions]
        x, f = (np.einsum("in,rin->nr", row, factor) for row in (response_weights, reference_weights))
        reject_zero_reference(rec, denominator, f)
        several = None
        if others:
            if self.estimator == "H2":
                raise SceneError("estimator: got 'H2'; expected H1 or Hv for several inputs")
            rows = [reference_weights, *(other.row(rec, names, self.frequency) for other in others)]
            amplitudes = np.stack([np.einsum("in,rin->nr", row, factor) for row in rows], axis=2)
            input_names = [each.channels[0] for each in (denominator, *others)]
            outputs = [k for k, name in enumerate(self.channels) if name not in input_names]
            several = _SeveralInputs(x, amplitudes, np.argsort(input_names), self.factor[:, outputs].transpose(2, 0, 1))
            x, f = several.conditioned()
        sxx, sff = (np.sum(np.square(np.abs(amplitude)), axis=1) for amplitude in (x, f))
        sxf = np.sum(x * f.conj(), axis=1)
        is_coherent = several is not None and several.condition > MAX_CONDITION_NUMBER
        sff = np.where(is_coherent, 1.0, sff)  # avoids a division by zero; the response to coherent inputs has no value
        value = estimate(self.estimator, sxx, sff, sxf)
        if several is not None and self.estimator == "Hv":
            value = np.where(is_coherent, value, several.total_least_squares())
        # Ratio of incoherent to coherent power of the response.
        with np.errstate(divide="ignore", invalid="ignore"):
            incoherence = np.sum(np.square(np.abs(x - (sxf / sff)[:, None] * f)), axis=1) / (abs(sxf) ** 2 / sff)
        coherence = 1.0 / (1.0 + incoherence)
        # Each input uses up a degree of freedom of the averages. The coherence of few blocks remains too large.
        n_free_averages = self.n_averages - (1 + len(others))
        error = np.full(value.shape, np.nan)
        if n_free_averages > 0.0:
            error = abs(value) * np.sqrt(incoherence / (2.0 * n_free_averages))
        limits: dict[str, Array] = {}
        if self.leakage_free is not None:
            leakage_free = self.leakage_free.frf(rec, numerator, denominator, others)
            limits[LEAKAGE] = leakage(self.frequency, value, error, leakage_free)
        contributions = quotient.contributions(value, np.einsum("rin,nr->in", factor, f.conj()) / sff)
        change_per_reading = quotient.change_per_reading(value)
        noise_bias = reference_noise_limit(value, coherence)
        if len(denominator.channels) > 1:
            noise = self._incoherent_power(factor, [names.index(name) for name in denominator.channels])
            noise_bias = np.maximum(noise_bias, shared_noise_limit(noise, change_per_reading, reference_weights, sff))
        if several is not None:
            noise_bias = several.noise_bias()
        limits[REFERENCE_NOISE] = noise_bias
        limits |= rounding_limit(rounding, contributions)
        # Incoherent part of the response, relative to the reference (Bendat and Piersol, chapter 7).
        deviations = np.einsum("in,rin->nr", change_per_reading / np.sqrt(sff * max(n_free_averages, 1e-300)), factor)
        if several is not None:
            deviations = several.deviations() / np.sqrt(max(n_free_averages, 1e-300))
            coherence = several.multiple_coherence()
        reference_limits = [np.sum(zero_safe_product(np.abs(contributions.reference), rounding), axis=0)]
        return quotient.response(
            contributions, error, np.full(value.shape, max(2.0 * n_free_averages, 0.0)), limits, reference_limits,
            SharedErrors.of(MeanErrors(self.factor, deviations)), value=np.where(is_coherent, np.nan, value),
            coherence=coherence, resolution=self.resolution, warnings=self.warnings,
        )  # fmt: skip

    def _incoherent_power(self, factor: ComplexArray, rows: Sequence[int]) -> Array:
        """Return an upper bound of the noise power in the two channels of a spring force: their incoherent power."""
        noise = np.zeros(factor.shape[1:])
        for row, other_row in zip(rows, rows[::-1], strict=True):
            reading, other = factor[:, row], factor[:, other_row]
            power = np.sum(np.square(np.abs(other)), axis=0)
            common = np.sum(reading * other.conj(), axis=0) / np.maximum(power, 1e-300)
            noise[row] = np.sum(np.square(np.abs(reading - common * other)), axis=0)
        # With few blocks, part of the noise is coherent by chance; the power is corrected for this.
        return np.asarray(noise * self.n_averages / max(self.n_averages - 1.0, 1e-300))


@dataclass(frozen=True)
class _SeveralInputs:
    """Amplitudes of a response and of several inputs, the reference first: rows of a factor at each line."""

    response: ComplexArray  # shape (lines, rows)
    inputs: ComplexArray  # shape (lines, rows, inputs)
    order: NDArray[np.intp]  # order of the inputs, independent of the choice of the reference
    outputs: ComplexArray  # readings of all response channels, shape (lines, rows, outputs)

    def conditioned(self) -> tuple[ComplexArray, ComplexArray]:
        """Return response and reference without their components that are coherent with the other inputs."""
        q, _ = np.linalg.qr(self.inputs[:, :, 1:])
        both: ComplexArray = np.stack([self.response, self.inputs[:, :, 0]], axis=2)
        both -= q @ (q.conj().swapaxes(1, 2) @ both)
        return both[:, :, 0], both[:, :, 1]

    @cached_property
    def spectra(self) -> ComplexArray:
        """Spectral matrix of the inputs, shape (lines, inputs, inputs)."""
        return np.asarray(self.inputs.swapaxes(1, 2) @ self.inputs.conj())

    @property
    def condition(self) -> Array:
        """Condition number of the input spectra at unit power, shape (lines,)."""
        return condition(self.spectra)

    def _fit(self, responses: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return responses to all inputs by H1, shape (lines, inputs, responses), and the residuals."""
        values = np.linalg.pinv(self.inputs) @ responses
        return values, responses - self.inputs @ values

    @cached_property
    def residual(self) -> ComplexArray:
        """Residual of the response, shape (lines, rows)."""
        return np.asarray(self._fit(self.response[:, :, None])[1][:, :, 0])

    def total_least_squares(self) -> ComplexArray:
        """Estimate the response by Hv for several inputs [1]_, shape (lines,).

        The eigenvector of the smallest eigenvalue of the spectral matrix at unit power is the linear combination of
        response and inputs that contains only noise: response minus the sum over the inputs, up to a factor.
        """
        amplitudes = np.concatenate([self.response[:, :, None], self.inputs], axis=2)
        unit, scale = unit_power(amplitudes.swapaxes(1, 2) @ amplitudes.conj())
        noise = np.linalg.eigh(unit)[1][:, :, 0].conj() / scale
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(-noise[:, 1] / noise[:, 0])

    def noise_bias(self) -> Array:
        """Return the largest bias by noise of the inputs: their power not coherent with an output, shape (lines,)."""
        values, residual = self._fit(self.outputs)
        power = np.sum(np.square(abs(residual)), axis=1)[:, None]
        noise = np.min(power / np.maximum(np.square(abs(values)), 1e-300), axis=2)
        noise = np.minimum(noise, np.einsum("nkk->nk", self.spectra).real)
        own = abs(self._fit(self.response[:, :, None])[0][:, :, 0])
        return np.asarray(np.sum(own * noise * abs(np.linalg.pinv(self.spectra)[:, 0]), axis=1))

    def deviations(self) -> ComplexArray:
        """Return the residual times the reference in the basis of all inputs, shape (lines, rows inputs).

        The covariance of two entries, the covariance of the residuals times the inverse of the input spectra, follows
        from it.
        """
        q, _ = np.linalg.qr(self.inputs[:, :, self.order])
        _, reference = self.conditioned()
        power = np.sum(np.square(abs(reference)), axis=1)
        direction = np.einsum("nrs,nr->ns", q.conj(), reference) / np.maximum(power, 1e-300)[:, None]
        return np.asarray((self.residual[:, :, None] * direction[:, None]).reshape(len(q), -1))

    def multiple_coherence(self) -> Array:
        """Return the share of the response's power that is coherent with all inputs, shape (lines,)."""
        total = np.sum(np.square(abs(self.response)), axis=1)
        residual = np.sum(np.square(abs(self.residual)), axis=1)
        return np.asarray(np.clip(1.0 - residual / np.maximum(total, 1e-300), 0.0, 1.0))


def leakage(frequency: Array, value: ComplexArray, error: Array, leakage_free: Response) -> Array:
    """Estimate the leakage of block averages from their difference to a curve without leakage, shape (lines,).

    The squared difference is averaged over three lines, the bandwidth of a Hann window. The variances of both curves
    are subtracted.
    """
    difference = value - np.interp(frequency, leakage_free.frequency, leakage_free.value)
    scatter = leakage_free.uncertainty.scatter
    leakage_free_error = 0.0 if scatter is None else np.interp(frequency, leakage_free.frequency, scatter.deviation)
    excess = np.square(np.abs(difference)) - 2.0 * np.nan_to_num(np.square(error) + np.square(leakage_free_error))
    return np.sqrt(np.maximum(np.convolve(np.pad(excess, 1, "edge"), np.full(3, 1.0 / 3.0), "valid"), 0.0))


def square_root(matrices: ComplexArray) -> ComplexArray:
    """Factorize positive semidefinite matrices into ``F F^H``, to the rounding error of each diagonal element.

    Eigenvalues that are negative due to rounding are set to zero: the nearest semidefinite matrix (N. J. Higham,
    Linear Algebra and its Applications 103 (1988) 103-118).

    >>> factor = square_root(np.array([[[1.0, 2e9j], [-2e9j, 4e18]]]))
    >>> np.allclose(factor @ factor.conj().swapaxes(1, 2), [[[1.0, 2e9j], [-2e9j, 4e18]]])
    True
    """
    scale = np.sqrt(np.einsum("nii->ni", matrices).real)
    unit = scale + (scale == 0.0)
    power, axes = np.linalg.eigh(matrices / (unit[:, :, None] * unit[:, None, :]))
    return np.asarray(unit[:, :, None] * axes * np.sqrt(np.maximum(power, 0.0))[:, None, :])


class _Averages:
    """Mean spectral matrix of blocks as a factor S: element (i, j) is the sum of S_i conj(S_j) over the rows of S."""

    def __init__(self, n_rows: int, n_channels: int, n_lines: int, purpose: str) -> None:
        # Size of the factor and its copies, or of the matrices from which the factor is computed.
        require_memory_with_program(_COPIES * 16 * n_rows * n_channels * n_lines, purpose)
        self._rows = np.zeros((n_rows, n_channels, n_lines), dtype=complex)
        self._count = 0

    def add(self, spectra: ComplexArray) -> None:
        """Add the spectra of a block, shape (channels, lines)."""
        n_rows, n_channels, _ = self._rows.shape
        if n_rows < n_channels:
            self._rows[self._count] = spectra
        else:
            for row, conjugate in enumerate(spectra.conj()):
                self._rows[row] += spectra * conjugate
        self._count += 1

    def factor(self) -> ComplexArray:
        """Return the factor S of the mean spectral matrix, shape (rows, channels, lines); rows: blocks or channels."""
        n_rows, n_channels, n_lines = self._rows.shape
        if n_rows == n_channels:
            for first in range(0, n_lines, _FACTORED_LINES):
                lines = slice(first, first + _FACTORED_LINES)
                self._rows[:, :, lines] = square_root(self._rows[:, :, lines].transpose(2, 1, 0)).transpose(2, 1, 0)
        self._rows /= np.sqrt(max(self._count, 1))
        return self._rows


def independent_blocks(window: Array, step: int, blocks: int) -> float:
    """Compute the equivalent number of independent averages of overlapping windowed blocks.

    Source: P. D. Welch, IEEE Transactions on Audio and Electroacoustics 15 (1967) 70-73, eq. 11.

    >>> from scipy.signal import windows
    >>> round(independent_blocks(windows.hann(1000, sym=False), 500, 99), 1)
    93.8
    """
    power = float(window @ window)
    variance = 1.0
    for k in range(1, min(blocks, -(-window.size // step))):  # rounded up
        overlap = float(window[k * step :] @ window[: window.size - k * step]) / power
        variance += 2.0 * (1.0 - k / blocks) * overlap**2
    return blocks / variance


class BlockSpectra(NamedTuple):
    """Result of `block_spectra`, over the blocks without flaws."""

    spectra: AveragedSpectra
    used: int  # number of averaged blocks
    flaws: Sequence[Flaw]  # flaws between the first and the last block
    end_ratio: float  # largest ratio, in any channel and block, of the reading in its last 2 % to its maximum
    mean_squares: Array  # mean square of each channel within a block, less its mean; shape (channels,)


def block_spectra(
    rec: Recording,
    channels: Sequence[str],
    starts: Sequence[int],
    step: int,
    window: Array,
    low: float,
    high: float,
    progress: CountProgress | None = None,
) -> BlockSpectra:
    """Average the spectra of blocks after removal of each block's mean, from `low` to `high` [Hz].

    `starts`: first samples of the blocks, in ascending order, every `step` samples; `window`, shape (samples of a
    block,).
    """
    names, block_samples = list(channels), window.size
    all_flaws = find_flaws(rec, names, starts[0], starts[-1] + block_samples)
    flaw_ends = np.array([[flaw.first, flaw.stop] for flaw in all_flaws]).reshape(-1, 2)
    frequency = scipy.fft.rfftfreq(block_samples, 1.0 / rec.rate)
    in_band = (frequency >= low) & (frequency <= min(high, 0.45 * rec.rate)) & (frequency > 0)
    averages = _Averages(min(len(starts), len(names)), len(names), int(in_band.sum()), f"{rec.path}: averaging blocks")
    end_ratio, used, power = 0.0, 0, np.zeros(len(names))
    blocks = read_slices(rec, names, ((begin, begin + block_samples) for begin in starts))
    for n_completed, (begin, samples) in enumerate(zip(starts, blocks, strict=True), 1):
        if progress is not None:
            progress(n_completed, len(starts))
        if np.any((flaw_ends[:, 0] < begin + block_samples) & (flaw_ends[:, 1] > begin)):
            continue
        samples = samples - samples.mean(axis=1, keepdims=True)
        averages.add(scipy.fft.rfft(samples * window, axis=1)[:, in_band])
        used += 1
        power += np.mean(np.square(samples), axis=1)
        largest = np.maximum(abs(samples).max(axis=1), 1e-300)
        end_ratio = max(end_ratio, float(np.max(abs(samples[:, -max(1, block_samples // 50) :]).max(axis=1) / largest)))
    averaged = AveragedSpectra(
        tuple(names), frequency[in_band], averages.factor(),
        independent_blocks(window, step, used) if used else 0.0, 0.0,
    )  # fmt: skip
    return BlockSpectra(averaged, used, all_flaws, end_ratio, power / max(used, 1))


def sampled_window(name: str, size: int) -> Array:
    """Return a periodic window of `size` samples by its scipy name; ``none`` is a rectangular window."""
    try:
        return np.asarray(scipy.signal.get_window("boxcar" if name == "none" else name, size), dtype=float)
    except ValueError:
        raise SceneError(
            f"window: got {name!r}; expected none, hann, hamming, flattop, blackmanharris or another window of scipy"
        ) from None


def noise_bandwidth_bins(window: Array) -> float:
    """Compute the equivalent noise bandwidth of a window, in bins (F. J. Harris, Proc. IEEE 66 (1978) 51-83, eq. 11).

    >>> round(noise_bandwidth_bins(sampled_window("hann", 1000)), 6), noise_bandwidth_bins(sampled_window("none", 10))
    (1.5, 1.0)
    """
    return float(window.size * np.sum(window**2) / np.sum(window) ** 2)
