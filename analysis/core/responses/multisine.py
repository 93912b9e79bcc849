"""Multisine with random phases: best linear approximation, with noise and nonlinear distortion separated.

A *realization* is a measurement of several periods with one set of random phases. *Distortion* is the difference
between the response of a nonlinear structure and its best linear approximation. With several inputs, a realization
consists of as many *experiments*, with mutually orthogonal phases. The matrix of inputs is then invertible at each line
[1]_, which separates the contributions of the inputs.

References
----------
.. [1] R. Pintelon, J. Schoukens, System Identification: A Frequency Domain Approach, 2nd ed., Wiley 2012, sections 2.7
   and 4.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from analysis.core.recordings.slices import read_slices
from analysis.core.responses.checks.channel_changes import Parts
from analysis.core.responses.checks.clean_segments import describe_flaws, find_flaws
from analysis.core.responses.checks.several_inputs import MAX_CONDITION_NUMBER
from analysis.core.responses.errors.scatter import Scatter
from analysis.core.responses.errors.systematic import (
    power_in_counts,
    quantization_steps,
    reproducible_rounding,
    tone_gain_error,
)
from analysis.core.responses.estimator import Estimator, Request
from analysis.core.responses.local_models.local_spectra import FIT_HALF_WIDTH
from analysis.core.responses.measurands import force_of, motion_channel_at, motion_of, reference_of
from analysis.core.responses.spectral_lines import Lines, residual_transient
from daq.core.recording.markers import Marker
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError
from rig.core.results.response import Response

NONLINEAR = (
    "The structure is nonlinear: the curve is the best linear approximation for this level and kind of excitation, and "
    "its uncertainty is valid only for them. Use stepped sine for the response to steady tones."
)
ONE_REALIZATION = (
    "One realization: the distortion by dampers cannot be separated from the response and is not in the uncertainty. "
    "Measure several realizations (test: realisations)."
)
LIFTED = (
    "Dampers may leave the floor at this level. The realizations scatter no more than noise, but the uncertainty does "
    "not include distortion that is equal in every realization. Use stepped sine for the response to steady tones."
)
# Assumed crest factor of a sum of tones, limited by the sum of their amplitudes.
_CREST_FACTOR = 4.0
# A structure is nonlinear if at least this share of the lines is distorted.
_MIN_DISTORTED_LINES = 0.2
# Smallest ratio of a distorted line's scatter over realizations to that of noise, transients and rounding, beyond
# chance: rounding of few counts exceeds its estimate, which assumes many counts, at 20 % of the lines.
_NOISE_RATIO = 3.0
# At a distorted line, the scatter of realizations is at least this fraction of the mean.
_MEAN_RATIO = 2e-3


def best_linear_approximation(request: Request) -> Lines:
    """Average the amplitudes of each channel over periods, then over realizations.

    Before the second average, each realization is rotated by the phase of its own reference, or separated into the
    amplitudes due to each input. The scatter between periods is noise. The scatter between realizations also contains
    nonlinear distortion [1]_.
    """
    rec, names, forces = request.rec, request.channels, [point.name for point in request.inputs]
    inputs = [force_of(name) for name in forces] or [reference_of(rec, request.reference)]
    realizations, notes = _realizations(rec, names, request.measured, len(inputs))
    if request.progress is not None:
        request.progress(len(request.measured), len(request.measured))
    complete = [spectra for realization in realizations for spectra in realization]
    if not complete:
        raise RecordingError(f"{rec.path}: no realization has two usable periods. {' '.join(notes)} Record again.")
    count, frequency = len(realizations), complete[0].frequency
    input_weights = np.stack([each.row(rec, names, frequency) for each in inputs])
    means, noises, transients, gains = [], [], [], []
    for realization in realizations:
        experiment_means = np.stack([spectra.spectra.mean(axis=0) for spectra in realization])
        factors = _separation(np.einsum("kcn,ecn->nke", input_weights, experiment_means))
        sizes = abs(factors) if len(inputs) > 1 else np.ones(factors.shape)
        means.append(_by_input(experiment_means, factors).sum(axis=0))
        for e, spectra in enumerate(realization):
            periods = len(spectra.spectra)
            deviations = spectra.spectra - experiment_means[e]
            noises.append(_by_input(deviations, factors[:, [e]]) / np.sqrt(periods * (periods - 1.0)))
        residuals = np.stack([residual_transient(spectra.spectra) for spectra in realization])
        transients.append(_by_input(residuals, sizes).sum(axis=0))
        gains.append(_by_input(np.ones(residuals.shape), sizes).sum(axis=0))
    realization_means = np.stack(means)
    mean_spectrum = realization_means.mean(axis=0)
    noise = Scatter(
        np.asarray(np.concatenate(noises) / count, dtype=complex),
        np.full(frequency.size, 2.0 * sum(len(spectra.spectra) - 1 for spectra in complete)),
    )
    unsettled = np.mean(transients, axis=0)
    steps = quantization_steps(rec, names)
    samples_per_period = rec.rate / (frequency[1] - frequency[0]) if frequency.size > 1 else rec.rate / frequency[0]
    # Rounding resembles noise of 1/12 count². At a line, 95 % of its amplitudes are below steps / sqrt(samples)
    # (Rayleigh distribution). The part of the rounding error that repeats in every period does not appear in the
    # scatter.
    noise_power = np.mean([spectra.samples.var(axis=0, ddof=1).mean(axis=1) for spectra in complete], axis=0)
    reproducible = reproducible_rounding(noise_power / np.where(steps > 0.0, steps, 1.0) ** 2)
    by_input: Array = np.abs(mean_spectrum).reshape(len(inputs), len(names), -1)
    amplitude: Array = np.hypot.reduce(by_input, axis=0) / np.sqrt(len(inputs))
    # In the worst case, the reading at a resonance is a single tone with the power of all lines.
    gain_error = np.minimum(tone_gain_error(power_in_counts(rec, names, np.sum(amplitude**2, axis=1) / 2.0)), 0.5)
    rounding = reproducible[:, None] * (steps[:, None] / np.sqrt(samples_per_period) + gain_error[:, None] * amplitude)
    rounding = np.tile(rounding, (len(inputs), 1)) * np.mean(gains, axis=0)
    noise_only = Lines(
        tuple(names), frequency, mean_spectrum, noise, rec.scene.name, tuple(notes), unsettled,
        n_neighbors=FIT_HALF_WIDTH, n_rotated=count, resolution=rounding, inputs=tuple(forces),
    )  # fmt: skip
    if count == 1:
        return noise_only if rec.scene.is_linear else replace(noise_only, warnings=(*notes, ONE_REALIZATION))
    deviations = (realization_means - mean_spectrum) / np.sqrt(count * (count - 1.0))
    scatter = Scatter(deviations, np.full(frequency.size, 2.0 * (count - 1.0)))
    with_distortion = replace(noise_only, scatter=scatter, noise=noise)
    if _is_distorted(with_distortion, noise_only):
        return replace(with_distortion, warnings=(*notes, NONLINEAR))
    if not rec.scene.is_linear:
        of_force = request.reference if not forces else ""
        return replace(with_distortion, warnings=(*notes, _undistorted_warning(rec, with_distortion, of_force)))
    return with_distortion


def _realizations(
    rec: Recording, names: Sequence[str], markers: Sequence[Marker], n_inputs: int
) -> tuple[list[list["PeriodSpectra"]], list[str]]:
    """Return the experiments (one for each input) of complete realizations, and notes on incomplete realizations."""
    groups: dict[int, list[Marker]] = {}
    for number, marker in enumerate(markers):
        groups.setdefault(number if n_inputs == 1 else int(marker.fields["realisation"]), []).append(marker)
    complete, notes = [], []
    for number, group in groups.items():
        if len(group) < n_inputs:
            was = "was" if len(group) == 1 else "were"
            notes.append(
                f"Realization {number} omitted: only {len(group)} of its {n_inputs} experiments {was} recorded."
            )
            continue
        spectra = [period_spectra(rec, names, marker) for marker in group]
        notes += [note for experiment in spectra for note in experiment.notes]
        if all(len(experiment.spectra) for experiment in spectra):
            complete.append(spectra)
    return complete, notes


def _separation(forces: ComplexArray) -> ComplexArray:
    """Return the factors with which a sum of experiments is due to one input; NaN where inputs are coherent.

    `forces`: amplitudes of the inputs in the experiments, shape (lines, inputs, experiments). Shape of the result:
    (lines, experiments, inputs). With one input, this is the conjugate phase factor of the force.
    """
    unit = forces / np.maximum(np.linalg.norm(forces, axis=2, keepdims=True), 1e-300)
    if unit.shape[1] == 1:
        return unit.conj()
    # The condition number of the input spectra is the square of the condition number of the amplitudes.
    unit[~(np.linalg.cond(unit) ** 2 <= MAX_CONDITION_NUMBER)] = np.nan
    return np.linalg.inv(unit)


def _by_input(values: NDArray[Any], factors: NDArray[Any]) -> NDArray[Any]:
    """Multiply (rows, channels, lines) by factors, (lines, rows or 1, inputs); shape (rows, inputs channels, lines)."""
    products = values[:, None] * np.moveaxis(factors, 0, 2)[:, :, None]
    return products.reshape(len(values), -1, values.shape[2])


def _undistorted_warning(rec: Recording, averages: Lines, reference: str) -> str:
    """Return the warning for a test without detected distortion, with the force at which a tone lifts a damper off."""
    lifting_forces = [(np.inf, np.nan)]
    force: Array = np.zeros(averages.frequency.size)
    if reference == "force":
        row = reference_of(rec, "force").row(rec, averages.channels, averages.frequency)
        force = np.abs(np.sum(row * averages.mean, axis=0))
    for body in {damper.body for damper in rec.scene.dampers if damper.impacts}:
        info = motion_channel_at(rec, f"body {body}")
        if info is not None and reference == "force":
            output, reference_force = motion_of(rec, info.name, "acceleration"), reference_of(rec, "force")
            accelerance = np.nan_to_num(abs(averages.frf(rec, output, reference_force).value))
            amplitudes = accelerance * force
            # Peak value of a sum of tones with random phases.
            peak_acceleration = min(_CREST_FACTOR * np.sqrt(np.sum(np.square(amplitudes)) / 2.0), amplitudes.sum())
            if peak_acceleration > rec.scene.gravity:
                return LIFTED
            resonance = int(np.argmax(accelerance))
            lifting_forces.append((rec.scene.gravity / accelerance[resonance], averages.frequency[resonance]))
    smallest_force, frequency = min(lifting_forces)
    tones = f"of more than {smallest_force:.2g} N at {frequency:.4g} Hz"
    if np.isinf(smallest_force):
        tones = "of a higher level"
    if not any(damper.impacts for damper in rec.scene.dampers):
        return (
            "No nonlinear distortion is detected at this level, but joints may act under steady tones of a higher "
            "level. Use stepped sine for the response to such tones."
        )
    return (
        "No nonlinear distortion is detected at this level, but dampers can move: steady tones "
        f"{tones} lift a damper. Use stepped sine for the response to such tones."
    )


@dataclass(frozen=True)
class PeriodSpectra:
    """Amplitudes of each clean period of a multisine."""

    frequency: Array  # Hz, shape (lines,)
    spectra: ComplexArray  # amplitudes as recorded, shape (periods, channels, lines)
    samples: Array  # shape (periods, channels, samples)
    notes: tuple[str, ...]


def period_spectra(rec: Recording, names: Sequence[str], marker: Marker) -> PeriodSpectra:
    """Transform the periods without overload or lost samples; the result has no periods if there are fewer than two."""
    number = marker.fields["realisation"]
    period_samples, periods = int(marker.fields["period"]), int(marker.fields["periods"])
    first_line, last_line = marker.fields["lines"]
    lines = np.arange(int(first_line), int(last_line) + 1)
    frequency = lines * rec.rate / period_samples
    starts = marker.first_sample + period_samples * np.arange(periods)
    intervals = [(start, start + period_samples) for start in starts.tolist()]
    all_flaws = [find_flaws(rec, names, *interval) for interval in intervals]
    clean = [
        interval
        for interval, period_flaws in zip(intervals, all_flaws, strict=True)
        if not period_flaws and interval[1] <= rec.samples
    ]
    notes = []
    if marker.fields.get("settled") is False:
        notes.append(
            f"Realization {number} was measured before steady state. Choose a level at which the motion is periodic, "
            "such as a lower one."
        )
    if len(clean) < periods:
        reasons = describe_flaws(rec, [flaw for period_flaws in all_flaws for flaw in period_flaws])
        reasons = reasons or "the recording ends"
        notes.append(f"{periods - len(clean)} of {periods} periods of realization {number} omitted: {reasons}.")
    if len(clean) < 2:
        notes.append(f"Realization {number} omitted: fewer than two of its periods are usable.")
        no_samples = np.zeros((0, len(names), 0))
        return PeriodSpectra(frequency, no_samples.astype(complex), no_samples, tuple(notes))
    samples = np.stack(list(read_slices(rec, names, clean)))
    numbers = np.array([(first - marker.first_sample) // period_samples for first, _ in clean])
    without_drift = _without_drift(samples, numbers)
    spectra = fft.rfft(without_drift, axis=2)[:, :, lines] * (2.0 / period_samples)
    return PeriodSpectra(frequency, spectra, samples, tuple(notes))


def _without_drift(periods: Array, numbers: NDArray[np.int64]) -> Array:
    """Subtract the linear drift of the mean from each period; shape (periods, channels, samples).

    A bias that settles slowly is an error of every line. Noise may hide its changes from period to period.
    `numbers`: positions of the periods within the realization.
    """
    drifts = np.gradient(periods.mean(axis=2), numbers, axis=0, edge_order=2 if len(numbers) > 2 else 1)
    return np.asarray(periods - drifts[:, :, None] * np.linspace(-0.5, 0.5, periods.shape[2]))


def _is_distorted(measured: Lines, noise: Lines) -> bool:
    """Return whether realizations scatter more than expected from noise, residual transients and rounding."""
    scatter, expected = (np.linalg.norm(lines.scatter.rows, axis=0) for lines in (measured, noise))
    limits = [limit for limit in (measured.residual_transient, measured.resolution) if limit is not None]
    distorted = scatter > _NOISE_RATIO * (expected + np.sum(limits, axis=0))
    distorted &= scatter > _MEAN_RATIO * abs(measured.mean)
    return bool(np.max(distorted.mean(axis=1)) > _MIN_DISTORTED_LINES)


def _compute(request: Request) -> list[Response]:
    """Estimate the best linear approximation of all realizations."""
    return request.compute([best_linear_approximation(request)])


def _parts(request: Request) -> list[Parts]:
    """Return the periods of all realizations, which have equal lengths and lines."""
    first, *_ = (marker.fields for marker in request.measured)
    period, resolution = int(first["period"]), request.rec.rate / int(first["period"])
    starts = [marker.first_sample + period * np.arange(int(marker.fields["periods"])) for marker in request.measured]
    low, high = (int(line) * resolution for line in first["lines"])
    return [Parts(np.concatenate(starts), period, low, high, is_steady=True)]


ESTIMATOR = Estimator(_compute, "whole periods of a multisine are averaged", "whole periods", parts=_parts)
