"""Frequency responses from averaged spectra: H1, H2 and Hv with coherence and error bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.responses.aliasing import aliasing_part
from analysis.responses.frf import Frf
from analysis.responses.measurands import driven, motion_of, reference_of
from analysis.responses.systematic import (
    LEAKAGE,
    REFERENCE_NOISE,
    clock_deviation,
    clock_part,
    common_scale,
    reference_noise_part,
    sensitivity_part,
    shared_noise_part,
)
from rig.errors import SceneError

if TYPE_CHECKING:
    from analysis.responses.whole_stretches import WholeStretches
    from daq.recording.recording import Recording

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
ESTIMATORS = ("H1", "H2", "Hv")


def estimate(estimator: str, sxx: Array, sff: Array, sxf: ComplexArray) -> ComplexArray:
    """Frequency response from auto and cross spectra.

    Parameters
    ----------
    estimator : {'H1', 'H2', 'Hv'}
        H1 assumes the reference free of noise, H2 the response; Hv lies between (geometric mean of both).
    sxx, sff : ndarray
        Mean of abs(X)² and of abs(F)².
    sxf : ndarray of complex
        Mean of X conj(F).

    Examples
    --------
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

    channels: tuple[str, ...]
    """Names, in the order of rows and columns."""
    frequency: Array  # Hz; shape (n,)
    cross: ComplexArray
    """Mean of Y_i conj(Y_j), as recorded: not yet corrected for the sensors; complex, shape (n, channels,
    channels)."""
    averages: float
    """Number of independent blocks; overlapping ones count for less."""
    resolution: float
    """Bandwidth of the window in Hz, 0 where nothing leaks (bursts that end inside their block)."""
    label: str = ""  # For legends
    warnings: tuple[str, ...] = ()  # In full sentences
    unsmeared: WholeStretches | None = None
    """The same test without windows, where these leak: what the two differ by is stated as leakage."""

    def frf(
        self,
        rec: Recording,
        response: str,
        reference: str = "force",
        motion: str = "displacement",
        estimator: str = "H1",
    ) -> Frf:
        """Frequency response with coherence; error bars after Bendat and Piersol, eq. 9.90."""
        above = motion_of(rec, response, motion)
        upper = above.row(rec, self.channels, self.frequency)
        below = reference_of(rec, reference)
        lower = below.row(rec, self.channels, self.frequency)
        sxx = np.einsum("in,nij,jn->n", upper, self.cross, upper.conj()).real
        sff = np.einsum("in,nij,jn->n", lower, self.cross, lower.conj()).real
        sxf = np.einsum("in,nij,jn->n", upper, self.cross, lower.conj())
        driven(reference, sff)
        value = estimate(estimator, sxx, sff, sxf)
        coherence = np.minimum(abs(sxf) ** 2 / (sxx * sff), 1.0)
        # Of every channel, how much it reads per unit of the reference.
        reads = np.einsum("nij,jn->in", self.cross, lower.conj()) / sff
        if self.averages > 1.0:
            # Coherence from few blocks is biased towards one; the scatter belongs to averages - 1 of them.
            error = abs(value) * np.sqrt((1.0 - coherence) / (2.0 * coherence * (self.averages - 1.0)))
        else:
            error = np.full(value.shape, np.nan)
        leakage: dict[str, Array] = {}
        if self.unsmeared is not None:
            sharp = self.unsmeared.frf(rec, response, reference, motion)
            leakage[LEAKAGE] = np.asarray(
                abs(value - np.interp(self.frequency, sharp.frequency, sharp.value)), dtype=float
            )
        shares = value, upper * reads, lower * reads
        incoherent = reference_noise_part(value, coherence)
        if len(below.channels) > 1:
            noise = self._noise_of_two(below.channels)
            incoherent = np.maximum(incoherent, shared_noise_part(noise, upper - value * lower, lower, sff))
        return Frf(
            frequency=self.frequency,
            value=value,
            error=error,
            coherence=coherence,
            degrees=np.full(value.shape, max(2.0 * (self.averages - 1.0), 0.0)),
            response=above.channels[0],
            reference=reference,
            motion=motion,
            label=self.label,
            resolution=self.resolution,
            warnings=self.warnings,
            systematic=sensitivity_part(rec, self.channels, *shares)
            | aliasing_part(rec, self.channels, self.frequency, *shares, motion)
            | {REFERENCE_NOISE: incoherent}
            | clock_part(rec, self.channels, self.frequency, *shares, motion)
            | leakage,
            clock=clock_deviation(rec),
            scale=common_scale(rec, above.channels, below.channels),
        )

    def _noise_of_two(self, names: Sequence[str]) -> Array:
        """Power of noise that the channels of a spring's force can hold at most: what they have not in common."""
        one, other = (self.channels.index(name) for name in names)
        own, second = self.cross[:, one, one].real, self.cross[:, other, other].real
        common = abs(self.cross[:, one, other]) ** 2
        noise = np.zeros((len(self.channels), self.frequency.size))
        noise[one] = own - common / np.maximum(second, 1e-300)
        noise[other] = second - common / np.maximum(own, 1e-300)
        # Few blocks have more in common by chance.
        return np.asarray(np.maximum(noise, 0.0) * self.averages / max(self.averages - 1.0, 1e-300))


def independent_blocks(window: Array, step: int, blocks: int) -> float:
    """Count the independent averages that overlapping windowed blocks amount to (Welch 1967, eq. 11).

    Examples
    --------
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
