"""Averages of a periodic test: the mean of every channel at every line, and how far the mean may be off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.responses.frf import Frf
from analysis.responses.measurands import driven, motion_of, reference_of

if TYPE_CHECKING:
    from daq.recording.recording import Recording


@dataclass(frozen=True)
class Lines:
    """Amplitudes of the recorded channels at the frequencies of a periodic excitation."""

    channels: tuple[str, ...]
    """Names, in the order of the rows."""
    frequency: NDArray[np.float64]
    """Hz, in the order measured; shape (n,)."""
    mean: NDArray[np.complex128]
    """Amplitude as recorded: not yet corrected for the sensors; complex, shape (channels, n)."""
    covariance: NDArray[np.complex128]
    """Of the mean; complex, shape (n, channels, channels)."""
    averages: NDArray[np.float64]
    """Number of parts behind each mean; shape (n,)."""
    label: str = ""  # Setting, for legends
    warnings: tuple[str, ...] = field(default=())  # What went wrong on the way

    def frf(
        self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement"
    ) -> Frf:
        """Divide the mean response by the mean reference; their covariance propagates to first order."""
        names: Sequence[str] = self.channels
        above = motion_of(rec, response, motion)
        upper = above.row(rec, names, self.frequency)
        lower = reference_of(rec, reference).row(rec, names, self.frequency)
        x, f = np.sum(upper * self.mean, axis=0), np.sum(lower * self.mean, axis=0)
        driven(reference, f)
        value = x / f
        # d(x/f) = (dx - value df) / f, and both are sums over the same channels.
        off = (upper - value * lower) / f
        variance = np.einsum("in,nij,jn->n", off, self.covariance, off.conj()).real
        with np.errstate(invalid="ignore", divide="ignore"):
            coherence = 1.0 / (1.0 + self.averages * variance / abs(value) ** 2)
        return Frf(
            frequency=self.frequency,
            value=value,
            error=np.sqrt(variance / 2.0),
            coherence=coherence,
            degrees=2.0 * np.maximum(self.averages - 1.0, 0.0),
            response=above.channels[0],
            reference=reference,
            motion=motion,
            label=self.label,
            warnings=self.warnings,
        )
