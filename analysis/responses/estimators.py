"""Frequency responses from averaged spectra: H1, H2 and Hv with coherence and error bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from analysis.responses.budget import ReadingShares, assemble_budget
from analysis.responses.measurands import driven, motion_of, reference_of
from analysis.responses.random_errors import MeanErrors
from analysis.responses.systematic import (
    LEAKAGE,
    REFERENCE_NOISE,
    common_scale,
    nothing_times,
    reference_noise_part,
    rounding_part,
    shared_noise_part,
)
from rig.arrays import Array, ComplexArray
from rig.errors import SceneError
from rig.results.response import Response

if TYPE_CHECKING:
    from analysis.responses.whole_stretches import WholeStretches
    from daq.recording.recording import Recording

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
    raise SceneError(f"unknown estimator {estimator!r}: expected {', '.join(ESTIMATORS)}")


@dataclass(frozen=True)
class Averages:
    """Spectral matrix of the recorded channels, averaged over blocks."""

    channels: tuple[str, ...]  # names, in the order of rows and columns
    frequency: Array  # Hz; shape (n,)
    # mean of Y_i conj(Y_j) as recorded, without correction for the sensors; complex, shape (n, channels,
    # channels)
    cross: ComplexArray
    averages: float  # number of independent blocks; overlapping blocks count as fewer
    resolution: float  # bandwidth of the window in Hz; 0 without leakage (bursts that end inside their block)
    label: str = ""  # For legends
    warnings: tuple[str, ...] = ()  # In full sentences
    # largest relative change of each channel's gain by rounding, as in `rounding_part`; shape (channels, n)
    gain: Array = field(default_factory=lambda: np.zeros((1, 1)))
    # the same test without windows, where windows cause leakage: the difference of the two is stated as
    # leakage
    unsmeared: WholeStretches | None = None

    estimator: str = "H1"  # Or ``"H2"``, ``"Hv"``

    def by(self, estimator: str | None) -> Averages:
        """Return these averages with another estimator; None selects H1."""
        return replace(self, estimator=estimator or "H1")

    def frf(
        self,
        rec: Recording,
        response: str,
        reference: str = "force",
        motion: str = "displacement",
    ) -> Response:
        """Estimate a frequency response with coherence; error bars after Bendat and Piersol, eq. 9.90."""
        above = motion_of(rec, response, motion)
        upper = above.row(rec, self.channels, self.frequency)
        below = reference_of(rec, reference)
        lower = below.row(rec, self.channels, self.frequency)
        factor = square_root(self.cross)
        x, f = (np.einsum("in,nir->nr", row, factor) for row in (upper, lower))
        sxx, sff = (np.sum(np.square(np.abs(each)), axis=1) for each in (x, f))
        sxf = np.sum(x * f.conj(), axis=1)
        driven(reference, sff)
        value = estimate(self.estimator, sxx, sff, sxf)
        # Ratio of incoherent to coherent power of the response.
        with np.errstate(divide="ignore", invalid="ignore"):
            other = np.sum(np.square(np.abs(x - (sxf / sff)[:, None] * f)), axis=1) / (abs(sxf) ** 2 / sff)
        coherence = 1.0 / (1.0 + other)
        # Reading of each channel per unit of the reference.
        reads = np.einsum("nij,jn->in", self.cross, lower.conj()) / sff
        if self.averages > 1.0:
            # Coherence from few blocks is biased towards 1; the scatter has averages - 1 degrees of freedom.
            error = abs(value) * np.sqrt(other / (2.0 * (self.averages - 1.0)))
        else:
            error = np.full(value.shape, np.nan)
        causes: dict[str, Array] = {}
        if self.unsmeared is not None:
            sharp = self.unsmeared.frf(rec, response, reference, motion)
            causes[LEAKAGE] = leakage(self.frequency, value, error, sharp)
        shares = ReadingShares(self.channels, self.frequency, motion, value, upper * reads, lower * reads)
        incoherent = reference_noise_part(value, coherence)
        if len(below.channels) > 1:
            noise = self._noise_of_two(below.channels)
            incoherent = np.maximum(incoherent, shared_noise_part(noise, upper - value * lower, lower, sff))
        causes[REFERENCE_NOISE] = incoherent
        causes |= rounding_part(self.gain, value, shares.upper, shares.lower)
        # Part that is not coherent with the reference, relative to its power (Bendat and Piersol, chapter 7).
        off = (upper - value * lower).T / np.sqrt(sff * max(self.averages - 1.0, 1e-300))[:, None]
        return Response.curve(
            self.frequency,
            value,
            above.channels[0],
            reference=reference,
            motion=motion,
            uncertainty=assemble_budget(
                rec, shares, error, np.full(value.shape, max(2.0 * (self.averages - 1.0), 0.0)), causes,
                doubts=[np.sum(nothing_times(np.abs(shares.lower), self.gain), axis=0)],
                errors=MeanErrors(off[:, None], self.cross),
                scale=common_scale(rec, above.channels, below.channels),
            ),
            coherence=coherence,
            label=self.label,
            resolution=self.resolution,
            warnings=self.warnings,
        )  # fmt: skip

    def _noise_of_two(self, names: Sequence[str]) -> Array:
        """Upper limit of the noise power in the two channels of a spring force: the power that they do not share."""
        rows = [self.channels.index(name) for name in names]
        readings = square_root(self.cross)[:, rows]
        noise = np.zeros((len(self.channels), self.frequency.size))
        for row, own, second in zip(rows, (0, 1), (1, 0), strict=True):
            reading, other = readings[:, own], readings[:, second]
            power = np.sum(np.square(np.abs(other)), axis=1)
            common = np.sum(reading * other.conj(), axis=1) / np.maximum(power, 1e-300)
            noise[row] = np.sum(np.square(np.abs(reading - common[:, None] * other)), axis=1)
        # Few blocks increase the common power by chance.
        return np.asarray(noise * self.averages / max(self.averages - 1.0, 1e-300))


def leakage(frequency: Array, value: ComplexArray, error: Array, sharp: Response) -> Array:
    """Estimate the leakage of block averages by their difference from a curve without leakage.

    The random errors of both, of known variance, are subtracted from its mean square over three lines, the bandwidth
    of a Hann window: a single line's difference contains the random error of that line. `value` and `error`, the
    standard uncertainty of either quadrature component, belong to one curve, as `sharp` does.
    """
    difference = value - np.interp(frequency, sharp.frequency, sharp.value)
    scatter = sharp.uncertainty.scatter
    of_sharp = 0.0 if scatter is None else np.interp(frequency, sharp.frequency, scatter.size)
    excess = np.square(np.abs(difference)) - 2.0 * np.nan_to_num(np.square(error) + np.square(of_sharp))
    return np.sqrt(np.maximum(np.convolve(np.pad(excess, 1, "edge"), np.full(3, 1.0 / 3.0), "valid"), 0.0))


def square_root(matrices: ComplexArray) -> ComplexArray:
    """Factor F of positive semidefinite matrices ``F F^H``, to the rounding of each of their diagonal elements.

    Eigenvalues that are negative by rounding are set to zero, which gives the nearest semidefinite matrix (Higham
    1988).

    `matrices` has the shape (n, size, size).

    >>> factor = square_root(np.array([[[1.0, 2e9j], [-2e9j, 4e18]]]))
    >>> np.allclose(factor @ factor.conj().swapaxes(1, 2), [[[1.0, 2e9j], [-2e9j, 4e18]]])
    True
    """
    scale = np.sqrt(np.einsum("nii->ni", matrices).real)
    unit = scale + (scale == 0.0)
    power, axes = np.linalg.eigh(matrices / (unit[:, :, None] * unit[:, None, :]))
    return np.asarray(unit[:, :, None] * axes * np.sqrt(np.maximum(power, 0.0))[:, None, :])


def independent_blocks(window: Array, step: int, blocks: int) -> float:
    """Compute the equivalent number of independent averages of overlapping windowed blocks (Welch 1967, eq. 11).

    >>> from scipy.signal import windows
    >>> round(independent_blocks(windows.hann(1000, sym=False), 500, 99), 1)
    93.8
    """
    power = float(window @ window)
    variance = 1.0
    for k in range(1, min(blocks, -(-window.size // step))):
        overlap = float(window[k * step :] @ window[: window.size - k * step]) / power
        variance += 2.0 * (1.0 - k / blocks) * overlap**2
    return blocks / variance
