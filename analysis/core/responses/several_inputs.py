"""Responses to several shakers at once: the matrix of outputs over inputs, with coherences and a reciprocity check.

Random tests are evaluated by the local rational method, with one numerator for each input and a common denominator.
Block averages are the alternative: H1 [1]_, and Hv (total least squares, each channel scaled to unit power) [2]_. A
multisine test consists of as many experiments as shakers, with mutually orthogonal phases, so that the matrix of inputs
can be inverted at each line [3]_.

One measured force has the values and random errors of a matrix with one column, because both use the same local fits,
block averages and budgets. It is computed separately for the other uncertainties: its reference may be a combination of
readings, such as the force of a spring, whose errors are correlated with those of the outputs; and its covariance
extends over neighboring lines, which the modal fit uses. Here every reference is a measured force, and the covariance
is that of all elements at one line.

References
----------
.. [1] J. S. Bendat, A. G. Piersol, Random Data, 4th ed., Wiley 2010, chapter 7.
.. [2] G. T. Rocklin, J. Crowley, H. Vold, A comparison of H1, H2 and Hv frequency response functions, Proceedings of
   the 3rd International Modal Analysis Conference (1985).
.. [3] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012, section 2.7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.responses import random
from analysis.core.responses.errors.budget import assemble_budget
from analysis.core.responses.errors.random_errors import MatrixErrors
from analysis.core.responses.errors.scatter import moderate
from analysis.core.responses.errors.systematic import (
    LEAKAGE,
    MODEL,
    REFERENCE_NOISE,
    RESOLUTION,
    UNSETTLED,
    ChannelContributions,
    common_scale,
    rounding_bound,
)
from analysis.core.responses.estimator import Blocks, Estimator, Request
from analysis.core.responses.estimators import AveragedSpectra, leakage
from analysis.core.responses.local_models.local_rational import local_fit
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH
from analysis.core.responses.measurands import Measurand, motion_of, output_point
from analysis.core.responses.multisine import period_spectra
from analysis.core.responses.spectral_lines import residual_transient
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.results import format_percent
from rig.core.results.response import Point, Response
from rig.core.results.uncertainty import UncertaintyBudget, stack_budgets

if TYPE_CHECKING:
    from daq.core.recording.markers import Marker
    from daq.core.recording.recording import Recording


# Inputs can be separated up to this condition number of the matrix of their spectra, scaled to unit power.
MAX_CONDITION_NUMBER = 1e3
# Reciprocal responses must agree within their uncertainties at this share of the lines or more.
_MIN_RECIPROCAL_LINES = 0.8
COHERENT_INPUTS = (
    "The inputs are coherent at {lines} of {all} lines: the responses to them cannot be separated there and "
    "have no value. Drive the shakers with uncorrelated noise, or with a multisine of orthogonal "
    "phases."
)


def _compute(request: Request) -> list[Response]:
    """Estimate the responses to several forces: by local models, from averaged blocks, or from experiments."""
    rec, markers, blocks = request.rec, request.measured, request.blocks
    points = request.names, request.inputs, request.motion
    if "experiment" in markers[0].fields:
        return [_from_experiments(rec, markers, *points)]
    if blocks == Blocks():
        return [_from_local_fits(rec, markers[0], *points)]
    spectra = input_output_spectra(rec, *points, blocks.block, blocks.overlap, blocks.window)
    return [spectra.response(rec, blocks.estimator or "H1")]


ESTIMATOR = Estimator(_compute, "the matrix of the responses to several forces is estimated at once")


@dataclass(frozen=True)
class SpectralMatrix:
    """Spectra of outputs and several inputs at n lines, averaged over blocks."""

    outputs: tuple[Point, ...]
    inputs: tuple[Point, ...]
    # auto and cross spectra, outputs first, corrected for the sensors; shape (n, points, points)
    spectral_matrix: ComplexArray
    spectra: AveragedSpectra  # spectra of the channels as recorded
    leakage_free: Response  # the same responses by the local rational method

    @property
    def frequency(self) -> Array:
        """Frequencies of the lines, Hz."""
        return self.spectra.frequency

    def _spectra_blocks(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        """Return the spectra xx, xf and ff of outputs x (motions) and inputs f (forces)."""
        n_outputs, matrix = len(self.outputs), self.spectral_matrix
        x, f = slice(n_outputs), slice(n_outputs, None)
        return matrix[:, x, x], matrix[:, x, f], matrix[:, f, f]

    def condition(self) -> Array:
        """Compute the condition number of the input spectra at unit power, shape (n,); 1 for uncorrelated inputs."""
        return np.asarray(np.linalg.cond(_unit_power(self._spectra_blocks()[2])[0]))

    def _inverse_inputs(self) -> ComplexArray:
        """Invert the spectra of the inputs, shape (n, inputs, inputs); NaN where the inputs are coherent."""
        inputs = self._spectra_blocks()[2].copy()
        inputs[self.condition() > MAX_CONDITION_NUMBER] = np.nan
        return np.asarray(np.linalg.inv(inputs))

    def residual(self) -> ComplexArray:
        """Compute the spectra of the outputs conditioned on all inputs, shape (n, outputs, outputs)."""
        xx, xf, _ = self._spectra_blocks()
        return np.asarray(xx - xf @ self._inverse_inputs() @ xf.conj().swapaxes(1, 2))

    def multiple_coherence(self) -> Array:
        """Compute the share of each output's power that is coherent with all inputs, shape (n, outputs)."""
        total = np.einsum("naa->na", self._spectra_blocks()[0]).real
        residual = np.einsum("naa->na", self.residual()).real
        return np.clip(1.0 - residual / np.maximum(total, 1e-300), 0.0, 1.0)

    def partial_coherence(self) -> Array:
        """Compute the coherence of output and input conditioned on the other inputs, shape (n, outputs, inputs)."""
        xx, xf, ff = self._spectra_blocks()
        coherence = np.empty(xf.shape)
        for k in range(len(self.inputs)):
            others = [m for m in range(len(self.inputs)) if m != k]
            inverse = np.linalg.inv(ff[:, others][:, :, others])
            from_x, from_f = xf[:, :, others], ff[:, [k]][:, :, others]
            cross = xf[:, :, k] - (from_x @ inverse @ from_f.conj().swapaxes(1, 2))[:, :, 0]
            output = np.einsum("naa->na", xx - from_x @ inverse @ from_x.conj().swapaxes(1, 2)).real
            force = ff[:, k, k].real - (from_f @ inverse @ from_f.conj().swapaxes(1, 2))[:, 0, 0].real
            coherence[:, :, k] = abs(cross) ** 2 / np.maximum(output * force[:, None], 1e-300)
        return np.clip(coherence, 0.0, 1.0)

    def frf(self, estimator: str) -> ComplexArray:
        """Estimate the response by H1 or Hv, shape (n, outputs, inputs); NaN where the inputs are coherent."""
        if estimator not in ("H1", "Hv"):
            raise SceneError(f"estimator: got {estimator!r}; expected H1 or Hv for several inputs")
        _, xf, _ = self._spectra_blocks()
        h1 = np.asarray(xf @ self._inverse_inputs())
        if estimator == "H1":
            return h1
        n_outputs, hv = len(self.outputs), np.empty_like(h1)
        for a in range(n_outputs):
            rows = [a, *range(n_outputs, n_outputs + len(self.inputs))]
            unit, scale = _unit_power(self.spectral_matrix[:, rows][:, :, rows])
            # The eigenvector of the smallest eigenvalue is the linear combination of output and inputs that contains
            # only noise: output minus response times inputs, up to a factor.
            noise = np.linalg.eigh(unit)[1][:, :, 0].conj() / scale
            hv[:, a] = -noise[:, 1:] / noise[:, :1]
        return np.where(np.isfinite(h1), hv, np.nan)

    def response(self, rec: Recording, estimator: str = "H1") -> Response:
        """Return the response with its budget; covariance of the random errors after [1]_, section 7.3."""
        value = self.frf(estimator)
        n_free_averages = max(self.spectra.n_averages - len(self.inputs), 1e-300)
        inverse, residual = self._inverse_inputs(), self.residual()
        n_lines, n_outputs, n_inputs = value.shape
        n_elements = n_outputs * n_inputs
        covariance = np.einsum("nab,nlk->nakbl", residual, inverse).reshape(n_lines, n_elements, n_elements)
        covariance = covariance / n_free_averages
        variance = np.maximum(np.einsum("npp->np", covariance).real, 0.0).reshape(value.shape)
        residual_power = np.einsum("naa->na", residual).real[:, :, None]
        # Upper bound of the noise power of each force: its power that is not coherent with an output.
        force_noise = np.minimum(
            np.min(residual_power / np.maximum(abs(value) ** 2, 1e-300), axis=1),
            np.einsum("nkk->nk", self._spectra_blocks()[2]).real,
        )
        bias = np.einsum("nam,nm,nmk->nak", abs(value), force_noise, abs(inverse))
        error = np.sqrt(variance / 2.0)
        leakages = np.empty(value.shape)
        for a, output in enumerate(self.outputs):
            for k, force in enumerate(self.inputs):
                leakage_free = self.leakage_free[output.name, force.name]
                leakages[:, a, k] = leakage(self.frequency, value[:, a, k], error[:, a, k], leakage_free)
        points, degrees_of_freedom = (self.outputs, self.inputs), np.full(value.shape, 2.0 * n_free_averages)
        bounds = {REFERENCE_NOISE: bias, LEAKAGE: leakages}
        budget = _matrix_budget(rec, self.frequency, value, points, error, degrees_of_freedom, bounds, covariance)
        response = Response(
            self.frequency, value, *points, budget, self.multiple_coherence(),
            label=self.spectra.label, resolution=self.spectra.resolution, warnings=self.spectra.warnings,
        )  # fmt: skip
        return _add_warnings(response)


def input_output_spectra(
    rec: Recording,
    names: Sequence[str],
    inputs: Sequence[Point],
    motion: str = "displacement",
    block: float | None = None,
    overlap: float | None = None,
    window: str | None = None,
) -> SpectralMatrix:
    """Average the spectra of a random test with several shakers.

    `motion`: displacement, velocity or acceleration; the other arguments are as in `averaged_spectra`.
    """
    marker = next(marker for marker in rec.markers if marker.kind == "measure")
    channels = [*dict.fromkeys([*names, *(point.name for point in inputs)])]
    spectra = random.averaged_spectra(rec, marker, channels, block, overlap, window=window)
    rows = _rows(rec, channels, spectra.frequency, names, inputs, motion)
    amplitudes = np.einsum("acn,rcn->nar", rows, spectra.factor)
    spectral_matrix = amplitudes @ amplitudes.conj().swapaxes(1, 2)
    leakage_free = _from_local_fits(rec, marker, names, inputs, motion)
    return SpectralMatrix(_outputs(rec, names, motion), tuple(inputs), spectral_matrix, spectra, leakage_free)


def _unit_power(spectra: ComplexArray) -> tuple[ComplexArray, Array]:
    """Scale spectra to unit power; also return the scale, shape (n, rows)."""
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", spectra).real, 1e-300))
    return np.asarray(spectra / (scale[:, :, None] * scale[:, None])), scale


def _rows(
    rec: Recording,
    channels: Sequence[str],
    frequency: Array,
    names: Sequence[str],
    inputs: Sequence[Point],
    motion: str,
) -> ComplexArray:
    """Return the weights of the readings in motions and forces, shape (motions and forces, channels, frequencies)."""
    forces = [Measurand((point.name,), (1.0,), "force") for point in inputs]
    measurands = [*(motion_of(rec, name, motion) for name in names), *forces]
    return np.stack([measurand.row(rec, channels, frequency) for measurand in measurands])


def _outputs(rec: Recording, names: Sequence[str], motion: str) -> tuple[Point, ...]:
    return tuple(output_point(rec, name, motion) for name in names)


def _matrix_budget(
    rec: Recording, frequency: Array, value: ComplexArray, points: tuple[Sequence[Point], Sequence[Point]],
    error: Array, degrees_of_freedom: Array, bounds: dict[str, Array], covariance: ComplexArray, shared: float = 1.0,
) -> UncertaintyBudget:  # fmt: skip
    """Assemble the budget of each matrix element from the gains of its output and input channels.

    `points`: outputs and inputs; `error`, `degrees_of_freedom` and `bounds` as in `assemble_budget`, of the shape of
    `value`; `covariance`: covariance of the random errors of the elements at each line, shape (n, elements, elements).
    """
    budgets = []
    for a, output in enumerate(points[0]):
        for k, force in enumerate(points[1]):
            contributions = _element_contributions(output.name, force.name, frequency, output.quantity, value[:, a, k])
            element_bounds = {name: bound[:, a, k] for name, bound in bounds.items()}
            budgets.append(
                assemble_budget(
                    rec, contributions, error[:, a, k], degrees_of_freedom[:, a, k], element_bounds, shared=shared,
                    scale=common_scale(rec, [output.name], [force.name]),
                )
            )  # fmt: skip
    return replace(stack_budgets(budgets, value.shape), errors=MatrixErrors(covariance))


def _element_contributions(
    output: str, force: str, frequency: Array, motion: str, value: ComplexArray
) -> ChannelContributions:
    """Return the contributions of the output and input channels to an element of the matrix."""
    zero = np.zeros(frequency.size, dtype=complex)
    contributions = np.stack([value, zero]), np.stack([zero, zero + 1.0])
    return ChannelContributions([output, force], frequency, motion, value, *contributions)


def _from_local_fits(
    rec: Recording, marker: Marker, names: Sequence[str], inputs: Sequence[Point], motion: str
) -> Response:
    """Estimate by the local rational method with one numerator for each input."""
    channels = tuple(dict.fromkeys([*names, *(point.name for point in inputs)]))
    fits = random.segment_fits(rec, marker, channels)
    segments, notes = fits.usable_segments(rec, [point.name for point in inputs])
    spectra = fits.spectra(rec, channels, segments)
    frequency = spectra.frequency[spectra.lines]
    forces = np.stack([spectra.spectrum(rec, Measurand((point.name,), (1.0,), "force")) for point in inputs])
    shape = frequency.size, len(names), len(inputs)
    value = np.empty(shape, dtype=complex)
    error, degrees_of_freedom, model_error, rounding = (np.empty(shape) for _ in range(4))
    coherence, noise = np.empty(shape[:2]), np.empty(shape[:2])
    half_width = min(spectra.half_width, (spectra.frequency.size - 1) // 2)
    fit_settings = spectra.end_phases, spectra.lines, half_width, spectra.measured_share
    residuals, all_bin_weights = [], []
    # A fit for each output and input, in which the other inputs have their own numerators.
    for a, name in enumerate(names):
        reading_to_motion = motion_of(rec, name, motion).row(rec, [name], frequency)[0]
        channel_to_motion = reading_to_motion * rec.channels[name].response(frequency)
        output = spectra.output(rec, name)
        for k in range(len(inputs)):
            others = np.delete(forces, k, axis=0)
            fit = local_fit(output, forces[k], *fit_settings, others)
            value[:, a, k] = fit.value * channel_to_motion
            error[:, a, k] = np.sqrt(fit.variance) * abs(channel_to_motion)
            model_error[:, a, k] = fit.model_error * abs(channel_to_motion)
            degrees_of_freedom[:, a, k] = fit.degrees_of_freedom
            rows = [spectra.channels.index(channel) for channel in (name, inputs[k].name)]
            contributions = _element_contributions(name, inputs[k].name, frequency, motion, value[:, a, k])
            rounding[:, a, k] = rounding_bound(spectra.rounding_gain_error[rows], contributions).get(RESOLUTION, 0.0)
            all_bin_weights.append(fit.bin_weights.reshape(frequency.size, -1) * channel_to_motion[:, None])
        residuals.append(fit.residual.reshape(frequency.size, -1))
        noise[:, a] = fit.noise_power * abs(reading_to_motion) ** 2
        local_power = spectra.power(output.spectra, spectra.half_width)
        coherence[:, a] = np.clip(1.0 - fit.noise_power / np.maximum(local_power, 1e-300), 0.0, 1.0)
    # Upper bound of the noise power of each force: its power that is not coherent with an output.
    force_power = np.stack([spectra.power(force, spectra.half_width) for force in forces], axis=1)
    noise_bound = np.minimum(np.min(noise[:, :, None] / np.maximum(abs(value) ** 2, 1e-300), axis=1), force_power)
    bias = abs(value) * (noise_bound / np.maximum(force_power, 1e-300))[:, None]
    # Covariance of the elements at each line: covariance of the residuals of the outputs, propagated through the fits.
    residual, bin_weights = np.stack(residuals, axis=1), np.stack(all_bin_weights, axis=1)
    complex_degrees = np.maximum(degrees_of_freedom[:, 0, 0] / 2.0, 0.5)
    cross = np.einsum("naw,nbw->nab", residual, residual.conj()) / complex_degrees[:, None, None]
    elements = np.repeat(np.arange(len(names)), len(inputs))
    propagation = np.einsum("npw,nqw->npq", bin_weights, bin_weights.conj())
    covariance = np.asarray(propagation * cross[:, elements][:, :, elements])
    points = _outputs(rec, names, motion), tuple(inputs)
    bounds = {MODEL: model_error, REFERENCE_NOISE: bias, RESOLUTION: rounding}
    budget = _matrix_budget(
        rec, frequency, value, points, error, degrees_of_freedom, bounds, covariance, spectra.shared
    )
    value[_local_condition(forces, spectra.lines, half_width) > MAX_CONDITION_NUMBER] = np.nan
    warnings = (*fits.warnings, *notes)
    return _add_warnings(
        Response(frequency, value, *points, budget, coherence, label=rec.scene.name, warnings=warnings)
    )


def _local_condition(forces: ComplexArray, lines: NDArray[np.int64], half_width: int) -> Array:
    """Compute the condition number of the spectra of forces at unit power, each averaged over the bins of a fit.

    `forces`: shape (inputs, segments, bins). Returns the shape (lines,).
    """
    products = np.mean(forces[:, None] * forces[None].conj(), axis=2)
    averages = scipy.ndimage.uniform_filter1d(products, 2 * half_width + 1, axis=-1)
    return np.asarray(np.linalg.cond(_unit_power(np.moveaxis(averages[..., lines], -1, 0))[0]))


def _from_experiments(
    rec: Recording, markers: Sequence[Marker], names: Sequence[str], inputs: Sequence[Point], motion: str
) -> Response:
    """Estimate from experiments with orthogonal phases: matrix of outputs times the inverse matrix of inputs."""
    channels = [*dict.fromkeys([*names, *(point.name for point in inputs)])]
    groups: dict[int, list[Marker]] = {}
    for marker in markers:
        groups.setdefault(int(marker.fields["realisation"]), []).append(marker)
    notes, values, noises, unsettled, coherences = [], [], [], [], []
    for number, group in groups.items():
        if len(group) < len(inputs):
            was = "was" if len(group) == 1 else "were"
            notes.append(
                f"Realization {number} left out: only {len(group)} of its {len(inputs)} experiments {was} recorded."
            )
            continue
        experiments = [period_spectra(rec, channels, marker) for marker in group]
        if any(len(experiment.spectra) < 2 for experiment in experiments):
            notes += [note for experiment in experiments for note in experiment.notes]
            continue
        frequency = experiments[0].frequency
        # Degrees of freedom of one realization; the scatter between realizations is more than noise.
        noise_degrees = 2.0 * sum(len(experiment.spectra) - 1 for experiment in experiments)
        rows = _rows(rec, channels, frequency, names, inputs, motion)
        means = np.stack([experiment.spectra.mean(axis=0) for experiment in experiments], axis=2)
        amplitudes = np.einsum("acn,cne->nae", rows, means)
        outputs, forces = amplitudes[:, : len(names)], amplitudes[:, len(names) :]
        scaled = forces / np.maximum(np.linalg.norm(forces, axis=2, keepdims=True), 1e-300)
        # The condition number of the input spectra is the square of the condition number of the amplitudes.
        forces[np.linalg.cond(scaled) ** 2 > MAX_CONDITION_NUMBER] = np.nan
        inverse = np.linalg.inv(forces)
        value = outputs @ inverse
        # Weights of the channels in the residual: output minus response times force.
        residual_weights = np.einsum("acn->nac", rows[: len(names)]) - np.einsum(
            "nam,mcn->nac", value, rows[len(names) :]
        )
        noise: ComplexArray = np.zeros((frequency.size, value[0].size, value[0].size), dtype=complex)
        transient = np.zeros(value.shape)
        residual_power, output_power = np.zeros(value.shape[:2]), np.zeros(value.shape[:2])
        for e, experiment in enumerate(experiments):
            periods = len(experiment.spectra)
            residual = np.einsum("nac,rcn->ran", residual_weights, experiment.spectra - experiment.spectra.mean(axis=0))
            cross = np.einsum("ran,rbn->nab", residual, residual.conj()) / (periods * (periods - 1.0))
            residual_power += periods * np.einsum("naa->na", cross).real
            output_power += np.square(abs(outputs[:, :, e]))
            # Covariance of the matrix elements due to noise of this experiment.
            contribution = np.einsum("nab,nk,nl->nakbl", cross, inverse[:, e], inverse[:, e].conj())
            noise += contribution.reshape(noise.shape)
            # Bound of the error of each element due to the residual transient of this experiment.
            residual_change = np.einsum("nac,cn->na", abs(residual_weights), residual_transient(experiment.spectra))
            transient += residual_change[:, :, None] * abs(inverse[:, e])[:, None]
        values.append(value)
        noises.append(noise)
        unsettled.append(transient)
        coherences.append(output_power / np.maximum(output_power + residual_power, 1e-300))
    if not values:
        raise RecordingError(
            f"{rec.path}: no realization of the multisine is complete. {' '.join(notes)} Record again."
        )
    count = len(values)
    value = np.mean(values, axis=0)
    covariance = np.sum(noises, axis=0) / count**2
    error, degrees_of_freedom = np.empty(value.shape), np.empty(value.shape)
    variance_of_mean = np.sum(np.square(np.abs(np.stack(values) - value)), axis=0) / max(count * (count - 1), 1)
    for a in range(value.shape[1]):
        for k in range(value.shape[2]):
            element = a * len(inputs) + k
            noise_variance = covariance[:, element, element].real
            expected = scipy.ndimage.uniform_filter1d(noise_variance, 2 * FIT_HALF_WIDTH + 1, mode="nearest")
            variance, line_degrees = (
                (variance_of_mean[:, a, k], 2.0 * (count - 1.0)) if count > 1 else (noise_variance, noise_degrees)
            )
            # Shrink the variances toward those of neighboring lines.
            moderated, degrees_of_freedom[:, a, k] = moderate(
                variance, np.full(variance.size, line_degrees), np.maximum(expected, 1e-300), FIT_HALF_WIDTH
            )
            error[:, a, k] = np.sqrt(moderated / 2.0)
    points = _outputs(rec, names, motion), tuple(inputs)
    bounds = {UNSETTLED: np.mean(unsettled, axis=0)}
    budget = _matrix_budget(rec, frequency, value, points, error, degrees_of_freedom, bounds, covariance)
    coherence = np.mean(coherences, axis=0)
    return _add_warnings(
        Response(frequency, value, *points, budget, coherence, label=rec.scene.name, warnings=tuple(notes))
    )


@dataclass(frozen=True)
class Reciprocity:
    """Agreement of two responses that are equal by the Maxwell-Betti reciprocity theorem."""

    pair: tuple[str, str]  # positions of output and input, which are exchanged for the other response
    within: float  # share of lines at which the difference is within the sum of the expanded uncertainties
    deviation: float  # median of the relative difference of the two responses


def reciprocity(response: Response) -> tuple[Reciprocity, ...]:
    """Compare pairs of responses with exchanged output and input, which reciprocity requires to be equal."""
    places = {point.place: a for a, point in enumerate(response.outputs)}
    uncertainty, pairs = response.bound(), []
    for k, input_k in enumerate(response.inputs):
        for m, input_m in enumerate(response.inputs[:k]):
            if input_k.place not in places or input_m.place not in places:
                continue
            a, b = places[input_k.place], places[input_m.place]
            first, second = response.value[:, a, m], response.value[:, b, k]
            valid = np.isfinite(first) & np.isfinite(second)
            difference, bound = (abs(first - second)[valid], (uncertainty[:, a, m] + uncertainty[:, b, k])[valid])
            mean = np.maximum(0.5 * abs(first + second)[valid], 1e-300)
            within, deviation = float(np.mean(difference <= bound)), float(np.median(difference / mean))
            pairs.append(Reciprocity((input_k.place, input_m.place), within, deviation))
    return tuple(pairs)


def _add_warnings(response: Response) -> Response:
    """Warn of coherent inputs and of responses that are not reciprocal; reject inputs coherent at all lines."""
    n_coherent = int(np.sum(~np.isfinite(response.value).all(axis=(1, 2))))
    if n_coherent == response.frequency.size:
        raise RecordingError(COHERENT_INPUTS.format(lines=n_coherent, all=n_coherent))
    notes = [COHERENT_INPUTS.format(lines=n_coherent, all=response.frequency.size)] if n_coherent else []
    notes += [
        f"Not reciprocal: the responses between {pair.pair[0]} and {pair.pair[1]} differ by "
        f"{format_percent(pair.deviation)} (median), more than their uncertainties at "
        f"{format_percent(1.0 - pair.within)} of the lines. Check the sensors' directions, gains and locations."
        for pair in reciprocity(response)
        if pair.within < _MIN_RECIPROCAL_LINES
    ]
    return response.warn(*notes)
