"""Responses to several shakers at once: the matrix of outputs over inputs, with coherences and a reciprocity check.

Random tests are evaluated by the local rational method with one numerator for each input and a common denominator, or
by block averages: H1, and Hv by total least squares on spectra of unit power [1]_, [2]_. A multisine test consists of
one experiment with orthogonal phases for each shaker, so that the matrix of inputs can be inverted at each line [3]_.

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

from analysis.responses import random
from analysis.responses.budget import assemble_budget
from analysis.responses.estimators import Averages, leakage
from analysis.responses.local_models.local_rational import local_fit
from analysis.responses.local_models.local_spectra import SIDE
from analysis.responses.measurands import Measurand, motion_of, place
from analysis.responses.multisine import period_spectra
from analysis.responses.random_errors import MatrixErrors
from analysis.responses.scatter import moderated
from analysis.responses.spectral_lines import remainder
from analysis.responses.systematic import (
    LEAKAGE,
    MODEL,
    REFERENCE_NOISE,
    RESOLUTION,
    UNSETTLED,
    ReadingShares,
    common_scale,
    rounding_part,
)
from daq.recording.recorded_test import TestKind
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError, SceneError
from rig.results.response import Point, Response
from rig.results.uncertainty import UncertaintyBudget, stacked

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording


# Condition of the input spectra, scaled to unit power, beyond which inputs cannot be separated.
WORST_CONDITION = 1e3
# A shaker is off if the mean square of its force is below this share of the largest.
_UNUSED_SHARE = 1e-4
COHERENT_INPUTS = (
    "The inputs are coherent at {lines} of {all} lines, where their responses cannot be separated and "
    "have no value. Drive the shakers with uncorrelated noise, or with a multisine of orthogonal "
    "phases."
)


def driven_forces(rec: Recording) -> tuple[Point, ...]:
    """Return the force channels of all shakers that were driven simultaneously; at most one for a single input."""
    marker = next((each for each in rec.markers if "shakers" in each.fields and each.kind == "measure"), None)
    if marker is None:
        return ()
    forces: list[Point] = []
    for number in marker.fields["shakers"]:
        at = f"shaker {number}"
        name = next((info.name for info in rec.channels.values() if info.at == at), None)
        if name is None:
            raise RecordingError(
                f"{rec.path}: no channel measures the force of shaker {number}. Add "
                f"{{name: force{number}, at: {at}}} to the scene's channels."
            )
        bodies = (rec.scene.structure.label(body) for body in rec.scene.shakers[number - 1].bodies)
        forces.append(Point(name, "force", " and ".join(bodies)))
    stop = min(marker.stop, rec.samples)
    power = [float(np.nanvar(rec.read(point.name, marker.first_sample, stop))) for point in forces]
    return tuple(p for p, square in zip(forces, power, strict=True) if square > _UNUSED_SHARE * max(power))


def response_matrix(
    rec: Recording,
    names: Sequence[str],
    inputs: Sequence[Point],
    motion: str,
    estimator: str | None = None,
    block: float | None = None,
    overlap: float = 0.5,
    window: str = "hann",
) -> Response:
    """Estimate the response of some channels to several forces; `estimator` H1 or Hv averages blocks."""
    markers = [each for each in rec.markers if each.kind == "measure"]
    if rec.test.kind is TestKind.MULTISINE:
        return _of_experiments(rec, markers, names, inputs, motion)
    if estimator is None and block is None:
        return _of_stretches(rec, markers[0], names, inputs, motion)
    averages = input_output_spectra(rec, names, inputs, motion, block, overlap, window)
    return averages.response(rec, estimator or "H1")


@dataclass(frozen=True)
class SpectralMatrix:
    """Spectra of outputs and several inputs, averaged over blocks.

    `power`: auto and cross spectra, outputs first, corrected for the sensors, shape (n, outputs + inputs, outputs +
    inputs).
    """

    outputs: tuple[Point, ...]
    inputs: tuple[Point, ...]
    power: ComplexArray
    averages: Averages  # spectra of the channels as recorded, with their averages and resolution
    sharp: Response

    @property
    def frequency(self) -> Array:
        """Hz."""
        return self.averages.frequency

    def _parts(self) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
        o = len(self.outputs)
        return self.power[:, :o, :o], self.power[:, :o, o:], self.power[:, o:, o:]

    def condition(self) -> Array:
        """Compute the condition number of the input spectra at unit power, shape (n,); 1 for uncorrelated inputs."""
        return np.asarray(np.linalg.cond(_unit_power(self._parts()[2])[0]))

    def _inverse(self) -> ComplexArray:
        inputs = self._parts()[2].copy()
        inputs[self.condition() > WORST_CONDITION] = np.nan
        return np.asarray(np.linalg.inv(inputs))

    def residual(self) -> ComplexArray:
        """Compute the spectra of the outputs conditioned on all inputs, shape (n, outputs, outputs)."""
        xx, xf, _ = self._parts()
        return np.asarray(xx - xf @ self._inverse() @ xf.conj().swapaxes(1, 2))

    def multiple_coherence(self) -> Array:
        """Compute the share of each output's power that is coherent with all inputs, shape (n, outputs)."""
        own = np.einsum("naa->na", self._parts()[0]).real
        rest = np.einsum("naa->na", self.residual()).real
        return np.clip(1.0 - rest / np.maximum(own, 1e-300), 0.0, 1.0)

    def partial_coherence(self) -> Array:
        """Coherence of output and input, both conditioned on the other inputs, shape (n, outputs, inputs)."""
        xx, xf, ff = self._parts()
        out = np.empty(xf.shape)
        for k in range(len(self.inputs)):
            others = [m for m in range(len(self.inputs)) if m != k]
            inverse = np.linalg.inv(ff[:, others][:, :, others])
            to_x, to_f = xf[:, :, others], ff[:, [k]][:, :, others]
            cross = xf[:, :, k] - (to_x @ inverse @ to_f.conj().swapaxes(1, 2))[:, :, 0]
            own = np.einsum("naa->na", xx - to_x @ inverse @ to_x.conj().swapaxes(1, 2)).real
            force = ff[:, k, k].real - (to_f @ inverse @ to_f.conj().swapaxes(1, 2))[:, 0, 0].real
            out[:, :, k] = abs(cross) ** 2 / np.maximum(own * force[:, None], 1e-300)
        return np.clip(out, 0.0, 1.0)

    def value(self, estimator: str) -> ComplexArray:
        """Estimate the response by H1 or Hv, shape (n, outputs, inputs); NaN where the inputs are coherent."""
        if estimator not in ("H1", "Hv"):
            raise SceneError(f"estimator {estimator} for several inputs: expected H1 or Hv")
        _, xf, _ = self._parts()
        first = np.asarray(xf @ self._inverse())
        if estimator == "H1":
            return first
        o, out = len(self.outputs), np.empty_like(first)
        for a in range(o):
            rows = [a, *range(o, o + len(self.inputs))]
            unit, scale = _unit_power(self.power[:, rows][:, :, rows])
            # The combination of output and inputs with the least power is noise; its coefficients determine the
            # response.
            smallest = np.linalg.eigh(unit)[1][:, :, 0].conj() / scale
            out[:, a] = -smallest[:, 1:] / smallest[:, :1]
        return np.where(np.isfinite(first), out, np.nan)

    def response(self, rec: Recording, estimator: str = "H1") -> Response:
        """Response with its budget; error covariance after Bendat and Piersol, section 7.3."""
        value, averages = self.value(estimator), self.averages
        count = max(averages.averages - len(self.inputs), 1e-300)
        inverse, residual = self._inverse(), self.residual()
        n, o, i = value.shape
        covariance = np.einsum("nab,nlk->nakbl", residual, inverse).reshape(n, o * i, o * i) / count
        variance = np.maximum(np.einsum("npp->np", covariance).real, 0.0).reshape(n, o, i)
        own = np.einsum("naa->na", residual).real[:, :, None]
        noise = np.minimum(
            np.min(own / np.maximum(abs(value) ** 2, 1e-300), axis=1),
            np.einsum("nkk->nk", self._parts()[2]).real,
        )
        bias = np.einsum("nam,nm,nmk->nak", abs(value), noise, abs(inverse))
        error = np.sqrt(variance / 2.0)
        smeared = np.empty(value.shape)
        for a, output in enumerate(self.outputs):
            for k, force in enumerate(self.inputs):
                sharp = self.sharp[output.name, force.name]
                smeared[:, a, k] = leakage(self.frequency, value[:, a, k], error[:, a, k], sharp)
        points, degrees = (self.outputs, self.inputs), np.full(value.shape, 2.0 * count)
        causes = {REFERENCE_NOISE: bias, LEAKAGE: smeared}
        budget = _matrix_budget(
            rec, self.frequency, value, points, error, degrees, causes, MatrixErrors(covariance)
        )
        found = Response(
            self.frequency, value, *points, budget, self.multiple_coherence(),
            label=averages.label, resolution=averages.resolution, warnings=averages.warnings,
        )  # fmt: skip
        return _checked(found)


def input_output_spectra(
    rec: Recording,
    names: Sequence[str],
    inputs: Sequence[Point],
    motion: str = "displacement",
    block: float | None = None,
    overlap: float = 0.5,
    window: str = "hann",
) -> SpectralMatrix:
    """Average the spectra of a random test with several shakers; arguments as in `response_matrix`."""
    marker = next(each for each in rec.markers if each.kind == "measure")
    channels = [*dict.fromkeys([*names, *(point.name for point in inputs)])]
    averages = random.averages(rec, marker, channels, block, overlap, window=window)
    rows = np.stack(
        [each.row(rec, channels, averages.frequency) for each in _measurands(rec, names, inputs, motion)]
    )
    power = np.einsum("acn,ncd,bdn->nab", rows, averages.cross, rows.conj(), optimize=True)
    sharp = _of_stretches(rec, marker, names, inputs, motion)
    return SpectralMatrix(_outputs(rec, names, motion), tuple(inputs), power, averages, sharp)


def _unit_power(spectra: ComplexArray) -> tuple[ComplexArray, Array]:
    """Scale spectra to unit power; also return the scale, shape (n, rows)."""
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", spectra).real, 1e-300))
    return np.asarray(spectra / (scale[:, :, None] * scale[:, None])), scale


def _measurands(
    rec: Recording, names: Sequence[str], inputs: Sequence[Point], motion: str
) -> list[Measurand]:
    forces = [Measurand((point.name,), (1.0,), "force") for point in inputs]
    return [*(motion_of(rec, name, motion) for name in names), *forces]


def _outputs(rec: Recording, names: Sequence[str], motion: str) -> tuple[Point, ...]:
    return tuple(Point(name, motion, place(rec, name)) for name in names)


def _matrix_budget(
    rec: Recording, frequency: Array, value: ComplexArray, points: tuple[Sequence[Point], Sequence[Point]],
    error: Array, degrees: Array, causes: dict[str, Array], errors: MatrixErrors | None, shared: float = 1.0,
) -> UncertaintyBudget:  # fmt: skip
    """Assemble the budget of each matrix element from the gains of its output and input channels."""
    budgets = []
    for a, output in enumerate(points[0]):
        for k, force in enumerate(points[1]):
            shares = _element(output.name, force.name, frequency, output.quantity, value[:, a, k])
            limits = {name: size[:, a, k] for name, size in causes.items()}
            scale = common_scale(rec, [output.name], [force.name])
            budgets.append(
                assemble_budget(
                    rec, shares, error[:, a, k], degrees[:, a, k], limits, shared=shared, scale=scale
                )
            )
    return replace(stacked(budgets, value.shape), errors=errors)


def _element(output: str, force: str, frequency: Array, motion: str, value: ComplexArray) -> ReadingShares:
    """Return the shares of the two channels of an element of the matrix."""
    zero = np.zeros(frequency.size, dtype=complex)
    shares = np.stack([value, zero]), np.stack([zero, zero + 1.0])
    return ReadingShares([output, force], frequency, motion, value, *shares)


def _of_stretches(
    rec: Recording, marker: Marker, names: Sequence[str], inputs: Sequence[Point], motion: str
) -> Response:
    """Estimate by the local rational method with one numerator for each input."""
    channels = tuple(dict.fromkeys([*names, *(point.name for point in inputs)]))
    whole = random.whole(rec, marker, channels)
    spectra, _, _, notes = whole.prepared(rec, channels, [point.name for point in inputs])
    at = spectra.frequency[spectra.lines]
    forces = np.stack([spectra.spectrum(rec, Measurand((point.name,), (1.0,), "force")) for point in inputs])
    shape = at.size, len(names), len(inputs)
    value = np.empty(shape, dtype=complex)
    error, degrees, missed, rounding = (np.empty(shape) for _ in range(4))
    coherence, noise = np.empty(shape[:2]), np.empty(shape[:2])
    side = min(spectra.side, (spectra.frequency.size - 1) // 2)
    residuals, influences = [], []
    for a, name in enumerate(names):
        upper = motion_of(rec, name, motion).row(rec, [name], at)[0]
        turned = upper * rec.channels[name].response(at)
        reading = spectra.reading(rec, name)
        for k in range(len(inputs)):
            others = np.delete(forces, k, axis=0)
            fit = local_fit(reading, forces[k], spectra.ends, spectra.lines, side, spectra.used, others)
            value[:, a, k] = fit.value * turned
            error[:, a, k] = np.sqrt(fit.variance) * abs(turned)
            missed[:, a, k] = fit.missed * abs(turned)
            degrees[:, a, k] = fit.degrees
            rows = [spectra.channels.index(each) for each in (name, inputs[k].name)]
            shares = _element(name, inputs[k].name, at, motion, value[:, a, k])
            rounding[:, a, k] = rounding_part(spectra.gain[rows], shares).get(RESOLUTION, 0.0)
            influences.append(fit.influence.reshape(at.size, -1) * turned[:, None])
        residuals.append(fit.residual.reshape(at.size, -1))
        noise[:, a] = fit.noise * abs(upper) ** 2
        near = _mean_square(reading.spectra, spectra.side)[spectra.lines]
        coherence[:, a] = np.clip(1.0 - fit.noise / np.maximum(near, 1e-300), 0.0, 1.0)
    # Upper limit of the noise power of each force: the power that outputs and inputs do not share.
    n_lines = np.stack([_mean_square(each, spectra.side)[spectra.lines] for each in forces], axis=1)
    most = np.minimum(np.min(noise[:, :, None] / np.maximum(abs(value) ** 2, 1e-300), axis=1), n_lines)
    bias = abs(value) * (most / np.maximum(n_lines, 1e-300))[:, None]
    # Covariance of the residuals of the outputs, propagated through the fits to the elements at each line.
    residual, influence = np.stack(residuals, axis=1), np.stack(influences, axis=1)
    free = np.maximum(degrees[:, 0, 0] / 2.0, 0.5)
    cross = np.einsum("naw,nbw->nab", residual, residual.conj()) / free[:, None, None]
    elements = np.repeat(np.arange(len(names)), len(inputs))
    through = np.einsum("npw,nqw->npq", influence, influence.conj())
    covariance = np.asarray(through * cross[:, elements][:, :, elements])
    points = _outputs(rec, names, motion), tuple(inputs)
    causes = {MODEL: missed, REFERENCE_NOISE: bias, RESOLUTION: rounding}
    budget = _matrix_budget(
        rec, at, value, points, error, degrees, causes, MatrixErrors(covariance), spectra.shared
    )
    warnings = (*whole.warnings, *notes)
    return _checked(Response(at, value, *points, budget, coherence, label=rec.scene.name, warnings=warnings))


def _mean_square(spectra: ComplexArray, side: int) -> Array:
    """Average the power of spectra over stretches, and over `side` bins on either side; shape (bins,)."""
    width = 2 * side + 1
    return np.convolve(np.mean(abs(spectra) ** 2, axis=0), np.full(width, 1.0 / width), "same")


def _of_experiments(
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
            notes.append(f"Realisation {number} left out: {len(group)} of {len(inputs)} experiments.")
            continue
        experiments = [period_spectra(rec, channels, marker) for marker in group]
        if any(len(each.spectra) < 2 for each in experiments):
            notes += [note for each in experiments for note in each.notes]
            continue
        found = experiments
        frequency = found[0].frequency
        rows = np.stack(
            [each.row(rec, channels, frequency) for each in _measurands(rec, names, inputs, motion)]
        )
        means = np.stack([each.spectra.mean(axis=0) for each in found], axis=2)
        both = np.einsum("acn,cne->nae", rows, means)
        outputs, forces = both[:, : len(names)], both[:, len(names) :]
        scaled = forces / np.maximum(np.linalg.norm(forces, axis=2, keepdims=True), 1e-300)
        forces[np.linalg.cond(scaled) ** 2 > WORST_CONDITION] = np.nan
        inverse = np.linalg.inv(forces)
        value = outputs @ inverse
        off = np.einsum("acn->nac", rows[: len(names)]) - np.einsum("nam,mcn->nac", value, rows[len(names) :])
        noise: ComplexArray = np.zeros((frequency.size, value[0].size, value[0].size), dtype=complex)
        moving = np.zeros(value.shape)
        rests, powers = np.zeros(value.shape[:2]), np.zeros(value.shape[:2])
        for e, each in enumerate(found):
            periods = len(each.spectra)
            rest = np.einsum("nac,rcn->ran", off, each.spectra - each.spectra.mean(axis=0))
            cross = np.einsum("ran,rbn->nab", rest, rest.conj()) / (periods * (periods - 1.0))
            rests += periods * np.einsum("naa->na", cross).real
            powers += np.square(abs(outputs[:, :, e]))
            own = np.einsum("nab,nk,nl->nakbl", cross, inverse[:, e], inverse[:, e].conj())
            noise += own.reshape(noise.shape)
            change = np.einsum("nac,cn->na", abs(off), remainder(each.spectra))
            moving += change[:, :, None] * abs(inverse[:, e])[:, None]
        values.append(value)
        noises.append(noise)
        unsettled.append(moving)
        coherences.append(powers / np.maximum(powers + rests, 1e-300))
    if not values:
        raise RecordingError(f"{rec.path}: no realisation of the multisine is complete. {' '.join(notes)}")
    count = len(values)
    value = np.mean(values, axis=0)
    covariance = np.sum(noises, axis=0) / count**2
    free = 2.0 * count * len(inputs) * (len(found[0].spectra) - 1)
    error, degrees = np.empty(value.shape), np.empty(value.shape)
    seen = np.sum(np.square(np.abs(np.stack(values) - value)), axis=0) / max(count * (count - 1), 1)
    for a in range(value.shape[1]):
        for k in range(value.shape[2]):
            own = covariance[:, a * len(inputs) + k, a * len(inputs) + k].real
            side = np.convolve(own, np.full(2 * SIDE + 1, 1.0 / (2 * SIDE + 1)), "same")
            variance, known = (seen[:, a, k], 2.0 * (count - 1.0)) if count > 1 else (own, free)
            moderate, freedom = moderated(variance, np.full(own.size, known), np.maximum(side, 1e-300), SIDE)
            error[:, a, k], degrees[:, a, k] = np.sqrt(moderate / 2.0), freedom
    points = _outputs(rec, names, motion), tuple(inputs)
    causes = {UNSETTLED: np.mean(unsettled, axis=0)}
    budget = _matrix_budget(rec, frequency, value, points, error, degrees, causes, MatrixErrors(covariance))
    coherence = np.mean(coherences, axis=0)
    return _checked(
        Response(frequency, value, *points, budget, coherence, label=rec.scene.name, warnings=tuple(notes))
    )


@dataclass(frozen=True)
class Reciprocity:
    """Agreement of two responses that are equal by the Maxwell-Betti reciprocity theorem."""

    pair: tuple[str, str]  # positions of output and input, which are exchanged for the other response
    within: float  # share of lines at which the difference is within the bounds
    deviation: float  # median of their relative difference


def reciprocity(response: Response) -> tuple[Reciprocity, ...]:
    """Compare pairs of responses with exchanged output and input, which reciprocity requires to be equal."""
    places = {point.place: a for a, point in enumerate(response.outputs)}
    bound, found = response.bound(), []
    for k, one in enumerate(response.inputs):
        for m, two in enumerate(response.inputs[:k]):
            if one.place not in places or two.place not in places:
                continue
            a, b = places[one.place], places[two.place]
            first, second = response.value[:, a, m], response.value[:, b, k]
            known = np.isfinite(first) & np.isfinite(second)
            away, allowed = abs(first - second)[known], (bound[:, a, m] + bound[:, b, k])[known]
            size = np.maximum(0.5 * abs(first + second)[known], 1e-300)
            within, deviation = float(np.mean(away <= allowed)), float(np.median(away / size))
            found.append(Reciprocity((one.place, two.place), within, deviation))
    return tuple(found)


def _checked(response: Response) -> Response:
    """Warn of coherent inputs and of responses that are not reciprocal."""
    lost = int(np.sum(~np.isfinite(response.value).all(axis=(1, 2))))
    notes = [COHERENT_INPUTS.format(lines=lost, all=response.frequency.size)] if lost else []
    notes += [
        f"Not reciprocal: the responses between {each.pair[0]} and {each.pair[1]} differ by {each.deviation:.1%} "
        f"(median), more than their bounds at {1.0 - each.within:.0%} of the lines. Check the sensors' directions, "
        "gains and places."
        for each in reciprocity(response)
        if each.within < 0.8
    ]
    return response.warn(*notes)
