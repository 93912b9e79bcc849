"""Multisine with random phases: best linear approximation, with noise and nonlinear distortion told apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from analysis.recordings.slices import read_slices
from analysis.responses.frf import Frf
from analysis.responses.measurands import reference_of
from analysis.responses.spectral_lines import Lines
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class BestLinearApproximation:
    """What the periods and the realisations of a multisine say."""

    total: Lines
    """Mean over realisations, its covariance from their scatter: noise and nonlinear distortion together."""
    noise: Lines
    """The same mean, its covariance from the scatter of the periods alone."""
    realisations: int

    def frf(
        self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement"
    ) -> Frf:
        """Best linear approximation, its error bars holding noise and nonlinear distortion."""
        return self.total.frf(rec, response, reference, motion)

    def distortion(self, rec: Recording, response: str, reference: str = "force") -> Array:
        """Tell the nonlinear distortion in one realisation, as a standard deviation of the receptance.

        Zero where the realisations scatter no more than noise explains. Needs several realisations [1]_.

        References
        ----------
        .. [1] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed.,
        section 4.3.
        """
        total = self.total.frf(rec, response, reference).error ** 2
        noise = self.noise.frf(rec, response, reference).error ** 2
        return np.sqrt(2.0 * self.realisations * np.maximum(total - noise, 0.0))


def best_linear_approximation(
    rec: Recording,
    markers: Sequence[Marker],
    reference: str = "force",
    progress: Callable[[int, int], None] | None = None,
) -> BestLinearApproximation:
    """Average over periods, then over realisations.

    Each realisation's spectra are turned back by the phase of its own reference, so that they can be
    averaged; what then still scatters from realisation to realisation, beyond the noise seen from period
    to period, is the nonlinear distortion.

    Parameters
    ----------
    markers : sequence of daq.marker.Marker
        Its ``measure`` markers, one per realisation.
    reference : {'force', 'table'}
        The reference that the phases are taken from.
    progress : callable, optional
        Called with (realisations done, realisations in all).
    """
    names = list(rec.channels)
    means, noises, notes = [], [], []
    frequency = np.empty(0)
    periods = 0
    for index, marker in enumerate(markers):
        size, periods = int(marker.fields["period"]), int(marker.fields["periods"])
        low, high = marker.fields["lines"]
        lines = np.arange(int(low), int(high) + 1)
        frequency = lines * rec.rate / size
        starts = [marker.first_sample + k * size for k in range(periods)]
        blocks = read_slices(rec, names, [(start, start + size) for start in starts])
        whole = [block for block in blocks if np.isfinite(block).all()]
        if progress is not None:
            progress(index + 1, len(markers))
        if marker.fields.get("settled") is False:
            notes.append(f"Realisation {index + 1} was measured before the motion had become periodic.")
        if len(whole) < 2:
            notes.append(f"Realisation {index + 1} left out: fewer than two whole periods.")
            continue
        spectra = fft.rfft(np.stack(whole), axis=2)[:, :, lines] * (2.0 / size)
        mean = spectra.mean(axis=0)
        turn = np.sum(reference_of(rec, reference).row(rec, names, frequency) * mean, axis=0)
        turn = turn.conj() / np.maximum(abs(turn), 1e-300)
        scatter = (spectra - mean) * turn
        means.append(mean * turn)
        noises.append(np.einsum("pin,pjn->nij", scatter, scatter.conj()) / (len(whole) * (len(whole) - 1.0)))
    if not means:
        raise RecordingError("no realisation of the multisine holds two whole periods: " + " ".join(notes))
    count = len(means)
    stack = np.stack(means)
    centre = stack.mean(axis=0)
    noise = np.mean(noises, axis=0) / count
    averages = np.full(frequency.size, float(count * (periods - 1) + 1))
    base = Lines(tuple(names), frequency, centre, noise, averages, rec.scene.name, tuple(notes))
    if count == 1:
        return BestLinearApproximation(base, base, 1)
    off = stack - centre
    scatter_all = np.einsum("min,mjn->nij", off, off.conj()) / (count * (count - 1.0))
    total = replace(base, covariance=scatter_all, averages=np.full(frequency.size, float(count)))
    return BestLinearApproximation(total, base, count)
