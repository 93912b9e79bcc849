"""Spectra of segments of a recording, and responses with their uncertainty by the local rational method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import special

from analysis.responses.budget import assemble_budget
from analysis.responses.force_pulse import slow_and_fast
from analysis.responses.local_models.jitter import jitter_part
from analysis.responses.local_models.local_rational import ORDER, POWER_RATIO_95, LocalFit, Reading, local_fit
from analysis.responses.measurands import Measurand, reject_zero_reference
from analysis.responses.random_errors import LocalErrors
from analysis.responses.systematic import (
    MODEL,
    REFERENCE_NOISE,
    ReadingShares,
    common_scale,
    reference_noise_part,
    rounding_part,
    shared_noise_part,
)
from rig.arrays import Array, ComplexArray
from rig.results.response import Response

if TYPE_CHECKING:
    from daq.recording.recording import Recording


# Number of resolved lines on either side of a line that a local fit uses.
SIDE = 12


@dataclass(frozen=True)
class LocalSpectra:
    """Spectra of segments, without windows."""

    channels: tuple[str, ...]
    samples: ComplexArray  # spectra of the channels as recorded, shape (segments, channels, bins)
    ends: ComplexArray  # as in `local_fit`; complex, shape (segments, bins)
    frequency: Array  # Hz; shape (bins,)
    lines: NDArray[np.int64]  # bins at which the response is estimated; shape (lines,)
    side: int  # lines on either side that a local fit uses
    used: float  # measured part of the samples of the spectra, as in `local_fit`
    # largest relative change of each channel's gain by rounding, as in `rounding_part`; shape (channels, lines)
    gain: Array
    noise: Array  # known noise power of each channel at each line; shape (channels, lines)
    jitter: Array  # jitter of hits, from `jitter_factor`; shape (rows, channels)
    # stored fits of a channel to a reference, because responses share the channels of their reference
    fits: dict[tuple[str, Measurand], LocalFit] = field(default_factory=dict)
    # stored spectra of references; complex, shape (segments, bins)
    spectra: dict[Measurand, ComplexArray] = field(default_factory=dict)

    def frf(
        self,
        rec: Recording,
        numerator: Measurand,
        denominator: Measurand,
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
        names = list(dict.fromkeys([*numerator.channels, *denominator.channels]))
        if names != list(self.channels):
            rows = [self.channels.index(name) for name in names]
            selected = replace(
                self,
                channels=tuple(names),
                samples=self.samples[:, rows],
                gain=self.gain[rows],
                noise=self.noise[rows],
                jitter=self.jitter[:, rows],
            )
            return selected.frf(rec, numerator, denominator, reference, motion, label, warnings, reference_noise)
        frequency = self.frequency[self.lines]
        force = self.spectrum(rec, denominator)
        reject_zero_reference(reference, force)
        response_weights = numerator.row(rec, names, frequency)
        reference_weights = denominator.row(rec, names, frequency)
        # Reading of each channel per unit of the reference.
        readings = np.zeros((len(names), frequency.size), dtype=complex)
        for index, name in enumerate(names):
            if denominator.channels == (name,) and name != numerator.channels[0]:
                readings[index] = 1.0 / reference_weights[index]
                continue
            fit = self._fit(rec, name, denominator)
            readings[index] = fit.value * rec.channels[name].response(frequency)
            if name == numerator.channels[0]:
                main_fit = fit
        value = np.sum(response_weights * readings, axis=0)
        scale = abs(value) / np.maximum(abs(main_fit.value), 1e-300)
        # The fitted value follows the noise of the reference regardless of the residual.
        noise = np.einsum("cn,cn->n", abs(reference_weights) ** 2, self.noise)
        variance = np.maximum(main_fit.variance, main_fit.noise_gain * noise) * scale**2
        shares = ReadingShares(
            names, frequency, motion, value, response_weights * readings, reference_weights * readings
        )
        difference = response_weights - value * reference_weights
        limits = (
            rounding_part(self.gain, shares)
            | jitter_part(self.jitter, difference, len(force) * self.power(force, self.side))
            | {MODEL: main_fit.model_error * scale}
        )
        reference_limits = []
        if noise.any():
            # The relative change of the fit by noise of the reference is the effective uncertainty of the reference.
            # If the fitted value is zero, the whole reference may be noise.
            squared = abs(main_fit.value) ** 2
            noise_ratio = np.full(squared.shape, np.inf)
            np.divide(2.0 * main_fit.noise_gain * noise, squared, out=noise_ratio, where=squared > 0.0)
            reference_limits.append(np.sqrt(POWER_RATIO_95 * noise_ratio))
        if reference_noise is None:
            noise_bias = reference_noise_part(value, main_fit.coherence)
            if len(denominator.channels) > 1:
                power = np.minimum(self.power(force, 1), self.power(force, self.side)) * main_fit.independent
                channel_noise = self._reference_noise(rec, denominator)
                noise_bias = np.maximum(
                    noise_bias, shared_noise_part(channel_noise, difference, reference_weights, power)
                )
            limits[REFERENCE_NOISE] = noise_bias
            common = np.zeros(frequency.size, dtype=complex)
        else:
            variance, common = variance + abs(value) ** 2 * reference_noise, value * np.sqrt(reference_noise)
        output = numerator.channels[0]
        to_motion = response_weights[names.index(output)] * rec.channels[output].response(frequency)
        errors = LocalErrors(
            influence=(main_fit.influence * to_motion[:, None, None])[:, None],
            first=main_fit.first,
            residual=main_fit.residual[:, None],
            curve=main_fit.curve,
            drive=self.power(force, self.side),
            free=float(main_fit.degrees[0]) / 2.0,
            used=self.used,
            one_reference=denominator.channels[1:] == () and not noise.any(),
            common=common[:, None],
        )
        budget = assemble_budget(
            rec, shares, np.sqrt(variance), main_fit.degrees, limits, reference_limits, errors, self.shared,
            common_scale(rec, numerator.channels, denominator.channels),
        )  # fmt: skip
        return Response.curve(
            frequency, value, output, reference=reference, motion=motion, uncertainty=budget,
            coherence=main_fit.coherence, label=label, warnings=tuple(warnings),
        )  # fmt: skip

    @property
    def shared(self) -> float:
        """Return the number of neighboring lines with a common error: each fit reduces its lines to a single value."""
        step = float(np.median(np.diff(self.lines))) if self.lines.size > 1 else 1.0
        return max((2 * self.side + 1) / (3 * ORDER + 2) / step, 1.0)

    def spectrum(self, rec: Recording, measurand: Measurand) -> ComplexArray:
        """Compute the spectra of a measurand, shape (segments, bins)."""
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

    def power(self, spectra: ComplexArray, side: int) -> Array:
        """Compute the mean square of spectra over `side` lines on either side of each line; shape (lines,)."""
        return np.asarray(scipy.ndimage.uniform_filter1d(np.mean(abs(spectra) ** 2, axis=0), 2 * side + 1)[self.lines])

    def _fit(self, rec: Recording, name: str, to: Measurand) -> LocalFit:
        """Fit the response of a channel's measured quantity to a measurand; the fit is stored."""
        if (name, to) not in self.fits:
            reading = self.reading(rec, name)
            side = min(self.side, (self.frequency.size - 1) // 2)
            spectrum = self.spectrum(rec, to)
            self.fits[name, to] = local_fit(reading, spectrum, self.ends, self.lines, side, self.used)
        return self.fits[name, to]

    def _reference_noise(self, rec: Recording, denominator: Measurand) -> Array:
        """Return the upper limit of the noise power in the two channels of a spring force: their incoherent power."""
        limit = self.noise.copy()
        for name, other in permutations(denominator.channels):
            row = self.channels.index(name)
            fit = self._fit(rec, name, Measurand((other,), (1.0,), "displacement"))
            # Upper 95 % limit of the noise power for these degrees of freedom.
            limit[row] = np.maximum(limit[row], fit.noise * fit.degrees / special.chdtri(fit.degrees, 0.95))
        return limit
