"""Spectra of segments of a recording, and responses with their uncertainty by the local rational method."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.responses.checks.several_inputs import MAX_CONDITION_NUMBER, condition
from analysis.core.responses.errors.budget import Quotient
from analysis.core.responses.errors.random_errors import LocalErrors, SharedErrors
from analysis.core.responses.errors.systematic import (
    MODEL,
    REFERENCE_NOISE,
    jitter_limit,
    reference_noise_limit,
    rounding_limit,
    shared_noise_limit,
)
from analysis.core.responses.force_pulse import slow_and_fast
from analysis.core.responses.local_models.local_rational import (
    ORDER,
    POWER_RATIO_95,
    LocalFit,
    OutputSpectra,
    local_fit,
)
from analysis.core.responses.measurands import Measurand, motion_of, reject_zero_reference
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response

# Number of bins on either side of a line that a local fit uses: more than twice the number of unknowns with one input.
FIT_HALF_WIDTH = 12


@dataclass(frozen=True)
class LocalSpectra:
    """Spectra of segments, without windows."""

    channels: tuple[str, ...]
    channel_spectra: ComplexArray  # spectra of the channels as recorded, shape (segments, channels, bins)
    end_phases: ComplexArray  # as in `local_fit`; complex, shape (segments, bins)
    frequency: Array  # Hz; shape (bins,)
    lines: NDArray[np.int64]  # bins at which the response is estimated; shape (lines,)
    half_width: int  # bins on either side of a line that a local fit uses
    measured_share: float  # measured share of the samples of the spectra, as in `local_fit`
    # largest relative change of each channel's gain due to rounding, as in `rounding_limit`; shape (channels, lines)
    rounding_gain_error: Array
    noise: Array  # known noise power of each channel at each line; shape (channels, lines)
    jitter: Array  # factor of the covariance of errors due to jitter, from `jitter_factor`; shape (rows, channels)
    # number of neighboring lines with a common error, if the segments of the lines differ and overlap in time (sweeps)
    overlap: float | None = None
    # stored fits of a channel to a reference, because responses share the channels of their reference
    stored_fits: dict[tuple[str, Measurand], LocalFit] = field(default_factory=dict)
    # stored noise bounds of several inputs, relative to their power; shape (lines,)
    stored_noise: dict[Measurand, Array] = field(default_factory=dict)
    # stored spectra of references; complex, shape (segments, bins)
    stored_spectra: dict[Measurand, ComplexArray] = field(default_factory=dict)

    def frf(
        self,
        rec: Recording,
        numerator: Measurand,
        denominator: Measurand,
        others: Sequence[Measurand] = (),
        reference_noise: ComplexArray | None = None,
        warnings: Sequence[str] = (),
    ) -> Response:
        """Estimate the response of one measurand to another; `others`: other inputs, each with its own numerator.

        `reference_noise`, shape (lines, parts): relative change of the reference due to independent parts of its noise,
        each with a real coefficient of variance 1. If omitted, a limit of the noise follows from the coherence.
        """
        frequency, force = self.frequency[self.lines], self.spectrum(rec, denominator)
        reject_zero_reference(rec, denominator, force)
        quotient = Quotient(rec, numerator, denominator, others, frequency)
        rows = [self.channels.index(name) for name in quotient.names]
        fit, readings = self._readings(quotient)
        value = np.sum(quotient.response_weights * readings, axis=0)
        scale = abs(value) / np.maximum(abs(fit.value), 1e-300)
        contributions, change_per_reading = quotient.contributions(value, readings), quotient.change_per_reading(value)
        # Noise of the reference changes the value even if the residual does not show the noise.
        reference_noise_power = np.einsum("cn,cn->n", abs(quotient.reference_weights) ** 2, self.noise[rows])
        noise_variance = fit.variance_per_reference_noise * reference_noise_power
        variance = np.maximum(fit.variance, noise_variance) * scale**2
        limits = (
            rounding_limit(self.rounding_gain_error[rows], contributions)
            | jitter_limit(self.jitter[:, rows], change_per_reading, len(force) * self.power(force, self.half_width))
            | {MODEL: fit.model_error * scale}
        )
        reference_limits = []
        if reference_noise_power.any():
            # Noise of the reference is its uncertainty, as a change of the value: infinite where the response is zero.
            squared = abs(fit.value) ** 2
            noise_ratio = np.full(squared.shape, np.inf)
            np.divide(2.0 * noise_variance, squared, out=noise_ratio, where=squared > 0.0)
            reference_limits.append(np.sqrt(POWER_RATIO_95 * noise_ratio))
        common_error = np.zeros((frequency.size, 0), dtype=complex)
        if reference_noise is None:
            limits[REFERENCE_NOISE] = self._noise_bias(quotient, value, fit)
        else:
            common_error = value[:, None] * reference_noise
            variance = variance + 0.5 * np.sum(abs(common_error) ** 2, axis=1)
        output = numerator.channels[0]
        to_motion = quotient.response_weights[quotient.names.index(output)] * rec.channels[output].response(frequency)
        has_single_reference = len(denominator.channels) == 1 and not others and not reference_noise_power.any()
        errors = LocalErrors(
            # These are the largest arrays of an analysis. Single precision is sufficient for errors.
            bin_weights=(fit.bin_weights * to_motion[:, None, None]).astype(np.complex64),
            first_bin=fit.first_bin,
            residual=fit.residual.astype(np.complex64),
            fitted_response=fit.fitted_response[:, 0],
            reference_power=self.power(force, self.half_width),
            complex_degrees_of_freedom=float(fit.degrees_of_freedom[0]) / 2.0,
            measured_share=self.measured_share,
            has_single_reference=has_single_reference and self.overlap is None,
            common_error=common_error,
            shared=self.overlap or 1.0,
        )
        coherence, valid = fit.coherence, np.ones(frequency.size, dtype=np.bool_)
        if others:
            coherence = np.clip(1.0 - fit.noise_power / self.power(self.output(rec, output).spectra), 0.0, 1.0)
            valid = ~(self._condition(rec, (denominator, *others)) > MAX_CONDITION_NUMBER)
        return quotient.response(
            contributions, np.sqrt(variance), fit.degrees_of_freedom, limits, reference_limits, SharedErrors.of(errors),
            self.shared, value=np.where(valid, value, np.nan), coherence=coherence, warnings=tuple(warnings),
        )  # fmt: skip

    def _readings(self, quotient: Quotient) -> tuple[LocalFit, ComplexArray]:
        """Return the fit to the output, and the readings per unit of the reference, shape (channels, lines)."""
        rec, output, reference = quotient.rec, quotient.numerator.channels[0], quotient.denominator
        frequency, of_others = quotient.frequency, [name for other in quotient.others for name in other.channels]
        readings = np.zeros((len(quotient.names), frequency.size), dtype=complex)
        for index, name in enumerate(quotient.names):
            if reference.channels == (name,) and name != output:
                readings[index] = 1.0 / quotient.reference_weights[index]
            elif name not in of_others:
                # Fits that are needed only once are not stored, because they are large.
                is_stored = name in reference.channels or bool(quotient.others)
                fit = self._fit(rec, name, reference, quotient.others, is_stored)
                readings[index] = fit.value * rec.channels[name].response(frequency)
                if name == output:
                    output_fit = fit
        return output_fit, readings

    def _noise_bias(self, quotient: Quotient, value: ComplexArray, fit: LocalFit) -> Array:
        """Return the largest bias due to noise in the reference, shape (lines,)."""
        rec, reference, others = quotient.rec, quotient.denominator, quotient.others
        if others:
            if reference not in self.stored_noise:
                self.stored_noise[reference] = self._input_noise(rec, reference, others)
            return np.asarray(abs(value) * self.stored_noise[reference])
        bias = reference_noise_limit(value, fit.coherence)
        if len(reference.channels) == 1:
            return bias
        force = self.spectrum(rec, reference)
        power = np.minimum(self.power(force, 1), self.power(force, self.half_width)) * fit.independent_share
        noise = self._reference_noise(rec, reference)[[self.channels.index(name) for name in quotient.names]]
        shared = shared_noise_limit(noise, quotient.change_per_reading(value), quotient.reference_weights, power)
        return np.maximum(bias, shared)

    @property
    def shared(self) -> float:
        """Return the number of neighboring lines with a common error: their fits use the same bins or samples."""
        if self.overlap is not None:
            return self.overlap
        step = float(np.median(np.diff(self.lines))) if self.lines.size > 1 else 1.0
        return max((2 * self.half_width + 1) / (3 * ORDER + 2) / step, 1.0)

    def spectrum(self, rec: Recording, measurand: Measurand) -> ComplexArray:
        """Compute the spectra of a measurand, shape (segments, bins)."""
        if measurand not in self.stored_spectra:
            row = measurand.row(rec, measurand.channels, self.frequency)
            spectra = self.channel_spectra[:, [self.channels.index(name) for name in measurand.channels]]
            self.stored_spectra[measurand] = np.einsum("cn,scn->sn", row, spectra)
        return self.stored_spectra[measurand]

    def output(self, rec: Recording, name: str) -> OutputSpectra:
        """Return the spectra of a channel, its response, and the transients of its high-pass filters."""
        info = rec.channels[name]
        transients = [1.0 / (2j * np.pi * self.frequency - pole) for pole in slow_and_fast(info)[0]]
        return OutputSpectra(
            self.channel_spectra[:, self.channels.index(name)],
            info.response(self.frequency),
            np.array(transients).reshape(-1, self.frequency.size),
        )

    def power(self, spectra: ComplexArray, half_width: int | None = None) -> Array:
        """Compute the mean square of spectra over `half_width` bins (default: as a fit) around each line."""
        half_width = self.half_width if half_width is None else half_width
        mean_square = np.mean(abs(spectra) ** 2, axis=0)
        return np.asarray(scipy.ndimage.uniform_filter1d(mean_square, 2 * half_width + 1)[self.lines])

    def _input_noise(self, rec: Recording, to: Measurand, others: Sequence[Measurand]) -> Array:
        """Return the largest relative noise power of an input: the part that is not coherent with an output."""
        inputs = {name for each in (to, *others) for name in each.channels}
        frequency, power = self.frequency[self.lines], self.power(self.spectrum(rec, to))
        ratios = [np.ones(frequency.size)]
        for name in self.channels:
            if name not in inputs:
                fit = self._fit(rec, name, to, others)
                explained = np.square(abs(fit.value * rec.channels[name].response(frequency))) * power
                ratios.append(fit.noise_power / np.maximum(explained, 1e-300))
        return np.asarray(np.min(ratios, axis=0))

    def _condition(self, rec: Recording, inputs: Sequence[Measurand]) -> Array:
        """Compute the condition number of the spectra of inputs at unit power, averaged over the bins of each fit."""
        forces = np.stack([self.spectrum(rec, each) for each in inputs])
        products = np.mean(forces[:, None] * forces[None].conj(), axis=2)
        averages = scipy.ndimage.uniform_filter1d(products, 2 * self.half_width + 1, axis=-1)
        return condition(np.moveaxis(averages[..., self.lines], -1, 0))

    def _fit(
        self, rec: Recording, name: str, to: Measurand, others: Sequence[Measurand] = (), is_stored: bool = True
    ) -> LocalFit:
        """Fit the response of the quantity that a channel measures to the measurand `to` and to other inputs."""
        if (name, to) in self.stored_fits:
            return self.stored_fits[name, to]
        half_width = min(self.half_width, (self.frequency.size - 1) // 2)
        fit = local_fit(
            self.output(rec, name), self.spectrum(rec, to), self.end_phases, self.lines, half_width,
            self.measured_share, np.stack([self.spectrum(rec, other) for other in others]) if others else None,
        )  # fmt: skip
        if is_stored:
            self.stored_fits[name, to] = fit
        return fit

    def _reference_noise(self, rec: Recording, denominator: Measurand) -> Array:
        """Return an upper bound of the noise power in the two channels of a spring force: their incoherent power."""
        bound = self.noise.copy()
        for name, other in permutations(denominator.channels):
            row = self.channels.index(name)
            fit = self._fit(rec, name, motion_of(rec, other))
            # Upper end of the 95 % interval of the noise power for these degrees of freedom.
            n = fit.degrees_of_freedom
            bound[row] = np.maximum(bound[row], fit.noise_power * n / scipy.special.chdtri(n, 0.95))
        return bound
