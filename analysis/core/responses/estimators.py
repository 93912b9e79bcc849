"""Estimators H1, H2 and Hv from windowed and averaged spectra of blocks of a recording (Welch)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from analysis.core.recordings.slices import read_slices
from analysis.core.responses.budget import assemble_budget
from analysis.core.responses.clean_segments import Flaw, find_flaws
from analysis.core.responses.measurands import motion_of, reference_of, reject_zero_reference
from analysis.core.responses.random_errors import MeanErrors
from analysis.core.responses.systematic import (
    LEAKAGE,
    REFERENCE_NOISE,
    ChannelContributions,
    common_scale,
    reference_noise_bound,
    rounding_bound,
    shared_noise_bound,
    zero_safe_product,
)
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import SceneError
from rig.core.base.progress import CountProgress
from rig.core.results.response import Response

if TYPE_CHECKING:
    from analysis.core.responses.segment_fits import SegmentFits
    from daq.core.recording.recording import Recording

ESTIMATORS = ("H1", "H2", "Hv")


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
    """Spectral matrix of the recorded channels, averaged over blocks."""

    channels: tuple[str, ...]  # names, in the order of rows and columns
    frequency: Array  # Hz; shape (n,)
    # mean of Y_i conj(Y_j) as recorded, without correction for the sensors; shape (n, channels, channels)
    cross: ComplexArray
    n_averages: float  # equivalent number of independent blocks; overlapping blocks count as fewer
    resolution: float  # bandwidth of the window in Hz; 0 without leakage (bursts that end inside their block)
    label: str = ""  # for legends
    warnings: tuple[str, ...] = ()  # in full sentences
    # largest relative change of each channel's gain due to rounding, as in `rounding_bound`; shape (channels, n)
    rounding_gain_error: Array = field(default_factory=lambda: np.zeros((1, 1)))
    # local fits to the same test; their difference from the averages is the leakage. None: the averages have no leakage
    leakage_free: SegmentFits | None = None
    estimator: str = "H1"  # or ``"H2"``, ``"Hv"``

    def frf(self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement") -> Response:
        """Estimate a frequency response with coherence; random error by Bendat and Piersol, Random Data, eq. 9.90."""
        numerator = motion_of(rec, response, motion)
        response_weights = numerator.row(rec, self.channels, self.frequency)
        denominator = reference_of(rec, reference)
        reference_weights = denominator.row(rec, self.channels, self.frequency)
        # Factors of the spectral matrices, so that all powers below are sums of squares.
        factor = square_root(self.cross)
        x, f = (np.einsum("in,nir->nr", row, factor) for row in (response_weights, reference_weights))
        sxx, sff = (np.sum(np.square(np.abs(amplitude)), axis=1) for amplitude in (x, f))
        sxf = np.sum(x * f.conj(), axis=1)
        reject_zero_reference(rec, reference, sff)
        value = estimate(self.estimator, sxx, sff, sxf)
        # Ratio of incoherent to coherent power of the response.
        with np.errstate(divide="ignore", invalid="ignore"):
            incoherence = np.sum(np.square(np.abs(x - (sxf / sff)[:, None] * f)), axis=1) / (abs(sxf) ** 2 / sff)
        coherence = 1.0 / (1.0 + incoherence)
        # Reading of each channel per unit of the reference.
        readings = np.einsum("nij,jn->in", self.cross, reference_weights.conj()) / sff
        # The estimated response uses one average, so that few blocks have too much coherence and too little scatter.
        n_free_averages = self.n_averages - 1.0
        error = np.full(value.shape, np.nan)
        if n_free_averages > 0.0:
            error = abs(value) * np.sqrt(incoherence / (2.0 * n_free_averages))
        bounds: dict[str, Array] = {}
        if self.leakage_free is not None:
            leakage_free = self.leakage_free.frf(rec, response, reference, motion)
            bounds[LEAKAGE] = leakage(self.frequency, value, error, leakage_free)
        contributions = ChannelContributions(
            self.channels, self.frequency, motion, value, response_weights * readings, reference_weights * readings
        )
        change_per_reading = response_weights - value * reference_weights
        noise_bias = reference_noise_bound(value, coherence)
        if len(denominator.channels) > 1:
            noise = self._incoherent_power(denominator.channels)
            noise_bias = np.maximum(noise_bias, shared_noise_bound(noise, change_per_reading, reference_weights, sff))
        bounds[REFERENCE_NOISE] = noise_bias
        bounds |= rounding_bound(self.rounding_gain_error, contributions)
        # Weights of the channels in the incoherent part of the response, relative to the reference (Bendat and Piersol,
        # chapter 7).
        residual_weights = change_per_reading.T / np.sqrt(sff * max(n_free_averages, 1e-300))[:, None]
        degrees_of_freedom = np.full(value.shape, max(2.0 * n_free_averages, 0.0))
        reference_bounds = [
            np.sum(zero_safe_product(np.abs(contributions.reference), self.rounding_gain_error), axis=0)
        ]
        budget = assemble_budget(
            rec, contributions, error, degrees_of_freedom, bounds, reference_bounds,
            MeanErrors(residual_weights[:, None], self.cross),
            scale=common_scale(rec, numerator.channels, denominator.channels),
        )  # fmt: skip
        return Response.curve(
            self.frequency, value, numerator.channels[0], reference=reference, motion=motion, uncertainty=budget,
            coherence=coherence, label=self.label, resolution=self.resolution, warnings=self.warnings,
        )  # fmt: skip

    def _incoherent_power(self, names: Sequence[str]) -> Array:
        """Return an upper bound of the noise power in the two channels of a spring force: their incoherent power."""
        rows = [self.channels.index(name) for name in names]
        readings = square_root(self.cross)[:, rows]
        noise = np.zeros((len(self.channels), self.frequency.size))
        for index, row in enumerate(rows):
            reading, other = readings[:, index], readings[:, 1 - index]
            power = np.sum(np.square(np.abs(other)), axis=1)
            common = np.sum(reading * other.conj(), axis=1) / np.maximum(power, 1e-300)
            noise[row] = np.sum(np.square(np.abs(reading - common[:, None] * other)), axis=1)
        # With few blocks, too much power is coherent by chance.
        return np.asarray(noise * self.n_averages / max(self.n_averages - 1.0, 1e-300))


def leakage(frequency: Array, value: ComplexArray, error: Array, leakage_free: Response) -> Array:
    """Estimate the leakage of block averages by their difference from a curve without leakage, shape (lines,).

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
    """Average the spectra of blocks after removal of each block's mean, from `low` to `high`, Hz.

    `starts`: first samples of the blocks, in ascending order, every `step` samples; `window`, shape (samples of a
    block,).
    """
    names, block_samples = list(channels), window.size
    all_flaws = find_flaws(rec, names, starts[0], starts[-1] + block_samples)
    flaw_bounds = np.array([[flaw.first, flaw.stop] for flaw in all_flaws]).reshape(-1, 2)
    frequency = scipy.fft.rfftfreq(block_samples, 1.0 / rec.rate)
    in_band = (frequency >= low) & (frequency <= min(high, 0.45 * rec.rate)) & (frequency > 0)
    cross: ComplexArray = np.zeros((int(in_band.sum()), len(names), len(names)), dtype=complex)
    end_ratio, used, power = 0.0, 0, np.zeros(len(names))
    blocks = read_slices(rec, names, ((begin, begin + block_samples) for begin in starts))
    for n_completed, (begin, samples) in enumerate(zip(starts, blocks, strict=True), 1):
        if progress is not None:
            progress(n_completed, len(starts))
        if np.any((flaw_bounds[:, 0] < begin + block_samples) & (flaw_bounds[:, 1] > begin)):
            continue
        samples = samples - samples.mean(axis=1, keepdims=True)
        spectra = scipy.fft.rfft(samples * window, axis=1)[:, in_band]
        cross = cross + np.einsum("in,jn->nij", spectra, spectra.conj())
        used += 1
        power += np.mean(np.square(samples), axis=1)
        largest = np.maximum(abs(samples).max(axis=1), 1e-300)
        end_ratio = max(end_ratio, float(np.max(abs(samples[:, -max(1, block_samples // 50) :]).max(axis=1) / largest)))
    averaged = AveragedSpectra(
        tuple(names), frequency[in_band], np.asarray(cross / max(used, 1e-300), dtype=complex),
        independent_blocks(window, step, used) if used else 0.0, 0.0, rec.scene.name,
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
