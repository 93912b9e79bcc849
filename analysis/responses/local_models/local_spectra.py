"""Spectra of stretches of a recording, and their response by the local rational method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import special

from analysis.responses.budget import measured_curve
from analysis.responses.force_pulse import slow_and_fast
from analysis.responses.local_models.jitter import jitter_part
from analysis.responses.local_models.local_rational import LARGEST, ORDER, LocalFit, Reading, local_fit
from analysis.responses.measurands import Measurand, driven
from analysis.responses.random_errors import LocalErrors
from analysis.responses.systematic import (
    MODEL,
    REFERENCE_NOISE,
    ReadingShares,
    reference_noise_part,
    rounding_part,
    shared_noise_part,
)
from rig.arrays import Array, ComplexArray
from rig.results.response import Response

if TYPE_CHECKING:
    from daq.recording.recording import Recording


# Resolved lines on either side that a local fit uses.
SIDE = 12


@dataclass(frozen=True)
class LocalSpectra:
    """Spectra of stretches, without windows."""

    channels: tuple[str, ...]
    samples: ComplexArray  # complex, shape (stretches, channels, bins)
    ends: ComplexArray  # as in `local_fit`; complex, shape (stretches, bins)
    frequency: Array  # Hz; shape (bins,)
    lines: NDArray[np.int64]  # bins at which the response is estimated; shape (lines,)
    side: int  # lines on either side that a local fit uses
    used: float  # measured share of the samples of the spectra, as in `local_fit`
    # largest relative change of each channel's gain by rounding, as in `rounding_part`; shape (channels,
    # lines)
    gain: Array
    noise: Array  # known noise power of each channel at each line; shape (channels, lines)
    jitter: Array  # jitter of hits, from `jitter_factor`; shape (rows, channels)
    # stored fits of a channel to a reference, because responses share the channels of their reference
    fits: dict[tuple[str, Measurand], LocalFit] = field(default_factory=dict)
    # stored spectra of references; complex, shape (stretches, bins)
    spectra: dict[Measurand, ComplexArray] = field(default_factory=dict)

    def frf(
        self,
        rec: Recording,
        above: Measurand,
        below: Measurand,
        reference: str,
        motion: str,
        label: str,
        warnings: Sequence[str],
        reference_noise: Array | None = None,
    ) -> Response:
        """Estimate the response of one measurand to another.

        `reference_noise`, shape (lines,): relative variance of either quadrature component of the reference. If it is
        unknown, the coherence bounds it.
        """
        names = list(dict.fromkeys([*above.channels, *below.channels]))
        if names != list(self.channels):
            rows = [self.channels.index(name) for name in names]
            only = replace(
                self,
                channels=tuple(names),
                samples=self.samples[:, rows],
                gain=self.gain[rows],
                noise=self.noise[rows],
                jitter=self.jitter[:, rows],
            )
            return only.frf(rec, above, below, reference, motion, label, warnings, reference_noise)
        at = self.frequency[self.lines]
        force = self.spectrum(rec, below)
        driven(reference, force)
        upper, lower = above.row(rec, names, at), below.row(rec, names, at)
        # Reading of each channel per unit of the reference.
        reads = np.zeros((len(names), at.size), dtype=complex)
        for index, name in enumerate(names):
            if below.channels == (name,):
                reads[index] = 1.0 / lower[index]
                continue
            fit = self._fit(rec, name, below)
            reads[index] = fit.value * rec.channels[name].response(at)
            if name == above.channels[0]:
                of_response = fit
        scale = abs(np.sum(upper * reads, axis=0)) / np.maximum(abs(of_response.value), 1e-300)
        # The fitted value follows the noise of the reference regardless of the residual.
        noise = np.einsum("cn,cn->n", abs(lower) ** 2, self.noise)
        variance = np.maximum(of_response.variance, of_response.through * noise) * scale**2
        value = np.sum(upper * reads, axis=0)
        shares = ReadingShares(names, at, motion, value, upper * reads, lower * reads)
        off = upper - value * lower
        causes = (
            rounding_part(self.gain, shares)
            | jitter_part(self.jitter, off, len(force) * self._power(force, self.side))
            | {MODEL: of_response.missed * scale}
        )
        doubts = []
        if noise.any():
            # The relative amount by which the fit follows reference noise is the effective uncertainty of the
            # reference.
            size = abs(of_response.value) ** 2
            # Without a fit, the whole reference may be noise.
            follows = np.full(size.shape, np.inf)
            np.divide(2.0 * of_response.through * noise, size, out=follows, where=size > 0.0)
            doubts.append(np.sqrt(LARGEST * follows))
        if reference_noise is None:
            incoherent = reference_noise_part(value, of_response.coherence)
            if len(below.channels) > 1:
                power = np.minimum(self._power(force, 1), self._power(force, self.side)) * of_response.apart
                incoherent = np.maximum(
                    incoherent, shared_noise_part(self._reference_noise(rec, below), off, lower, power)
                )
            causes[REFERENCE_NOISE] = incoherent
            common = np.zeros(at.size, dtype=complex)
        else:
            variance, common = variance + abs(value) ** 2 * reference_noise, value * np.sqrt(reference_noise)
        turned = upper[names.index(above.channels[0])] * rec.channels[above.channels[0]].response(at)
        errors = LocalErrors(
            influence=(of_response.influence * turned[:, None, None])[:, None],
            first=of_response.first,
            residual=of_response.residual[:, None],
            curve=of_response.curve,
            drive=self._power(force, self.side),
            free=float(of_response.degrees[0]) / 2.0,
            used=self.used,
            one_reference=below.channels[1:] == () and not noise.any(),
            common=common[:, None],
        )
        return measured_curve(
            rec, shares, above, below, reference, np.sqrt(variance), of_response.degrees, causes, doubts, errors,
            self.shared, coherence=of_response.coherence, label=label, warnings=tuple(warnings),
        )  # fmt: skip

    @property
    def shared(self) -> float:
        """Number of neighbouring lines with a common error: each fit reduces its lines to a single value."""
        step = float(np.median(np.diff(self.lines))) if self.lines.size > 1 else 1.0
        return max((2 * self.side + 1) / (3 * ORDER + 2) / step, 1.0)

    def spectrum(self, rec: Recording, measurand: Measurand) -> ComplexArray:
        """Compute the spectra of a measurand, shape (stretches, bins)."""
        if measurand not in self.spectra:
            row = measurand.row(rec, self.channels, self.frequency)
            self.spectra[measurand] = np.einsum("cn,scn->sn", row, self.samples)
        return self.spectra[measurand]

    def reading(self, rec: Recording, name: str) -> Reading:
        """Return the spectra of a channel, its response, and the transients of its high-pass filters."""
        info = rec.channels[name]
        slow = [1.0 / (2j * np.pi * self.frequency - pole) for pole in slow_and_fast(info)[0]]
        return Reading(
            self.samples[:, self.channels.index(name)],
            info.response(self.frequency),
            np.array(slow).reshape(-1, self.frequency.size),
        )

    def _power(self, spectra: ComplexArray, side: int) -> Array:
        """Mean square of spectra over `side` lines on either side of each line; shape (lines,)."""
        return np.asarray(
            scipy.ndimage.uniform_filter1d(np.mean(abs(spectra) ** 2, axis=0), 2 * side + 1)[self.lines]
        )

    def _fit(self, rec: Recording, name: str, to: Measurand) -> LocalFit:
        """Fit the response of a channel's measured quantity to a measurand."""
        if (name, to) not in self.fits:
            reading = self.reading(rec, name)
            side = min(self.side, (self.frequency.size - 1) // 2)
            spectrum = self.spectrum(rec, to)
            self.fits[name, to] = local_fit(reading, spectrum, self.ends, self.lines, side, self.used)
        return self.fits[name, to]

    def _reference_noise(self, rec: Recording, below: Measurand) -> Array:
        """Upper limit of the noise power of the two channels of a spring force: the power that they do not share."""
        most = self.noise.copy()
        for name, other in permutations(below.channels):
            row = self.channels.index(name)
            fit = self._fit(rec, name, Measurand((other,), (1.0,), "displacement"))
            # Upper 95 % limit of the noise power for these degrees of freedom.
            most[row] = np.maximum(most[row], fit.noise * fit.degrees / special.chdtri(fit.degrees, 0.95))
        return most
