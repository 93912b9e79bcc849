"""Natural frequencies, damping ratios and shapes from measured frequency responses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.modal.doubts import doubts
from analysis.modal.line_choice import in_holes, scatter, stands_out, thinned
from analysis.modal.lscf import chart, columns
from analysis.modal.modes import DETERMINED, Modes
from analysis.modal.order_selection import MOST_MODES, hidden, in_band, preferred, select
from analysis.modal.pole_errors import pole_errors, refined_pole_errors, systematic_pole_errors
from analysis.modal.pole_residue import Curves, Fit, fit, residual_terms
from analysis.modal.refinement import Refined, refined
from analysis.modal.several_references import separated
from analysis.responses.systematic import ALIASING, ROUGH
from rig.errors import RecordingError, SceneError
from rig.results.response import Response, stack

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# The smallest relative error credited to a point: keeps a handful of nearly perfect points from deciding
# alone.
LEAST_RELATIVE_ERROR = 1e-4
# What a second chart takes the relative error for: it is led by all the curve and not by its peaks alone.
_EVEN = 0.03
# Poles to start from, and those tried when one more is looked for.
_STARTS, _TRIED = 15, 40
# A misfit of so many variances is no longer noise: the curves are those of no linear structure.
_NOT_NOISE = 4.0
# How far a model may miss the curves, relative to the peaks around: tried one after the other.
_DISTRUST = (0.0, 0.01, 0.03, 0.1, 0.2, 0.4)
# Up to so many times a frequency, and down from it, belongs to its neighbourhood.
_AROUND = 1.15
# Degrees of freedom from which on a line's own error is known.
_ENOUGH = 10.0
# A largest deviation counts as so many standard deviations.
_LARGEST = 1.8


def identify(frfs: Response | Sequence[Response], count: int | None = None) -> Modes:
    """Identify the modes that a set of frequency responses of one test share.

    Poles to start from come from stabilisation charts (least-squares complex frequency domain). They are refined
    together with all residues by weighted least squares, every point weighted by its error bar; poles that noise
    would explain as well are left out, and further ones tried, until all and only those are left that the curves
    ask for. Where the best model misses the curves by more than their error bars, as it must where dampers make
    the structure nonlinear, points are weighted by what it misses. Standard deviations come from what is left.

    Parameters
    ----------
    frfs : sequence of Response
        Several responses to one reference at the same frequencies; or a `Response` to several inputs, which separates
        close and repeated modes.
    count : int, optional
        Most modes wanted. Omitted: all that the curves hold.

    Raises
    ------
    RecordingError
        If there are too few frequencies, or no mode.
    SceneError
        If the responses do not belong together.
    """
    if count is not None and not (isinstance(count, int) and count >= 1):
        raise SceneError(f"{count} modes asked for: expected at least 1")
    if (
        not isinstance(frfs, Sequence | Response)
        or not len(frfs)
        or not all(isinstance(frf, Response) for frf in frfs)
    ):
        raise SceneError(
            f"identify: got {frfs!r:.60}; expected several curves, as analysis.frfs or read_frfs gives them"
        )
    if isinstance(frfs, Response) and len(frfs.inputs) > 1:
        matrix = frfs
        return separated(
            identify(list(matrix), count),
            matrix.keys(),
            tuple(f"{point.quantity} at {point.place or point.name}" for point in matrix.inputs),
            tuple(point.place for point in matrix.outputs),
        )
    curves = _bounded(thinned([frf.to("displacement").sorted() for frf in frfs]))
    measured, sigma = _measured(curves)
    charts = [
        chart(measured.frequency, measured.value, weight)
        for weight in (
            np.ones(sigma.shape) / abs(measured.value).max(axis=1, keepdims=True),
            1.0 / np.hypot(sigma, _EVEN * abs(measured.value)),
        )
    ]
    stable, every = columns(measured.frequency, charts)
    weighted, model, error = _explained(
        measured, sigma, stable[:_STARTS], every[:_TRIED], MOST_MODES if count is None else count
    )
    weighted, model, dropped = _without_doubtful_poles(weighted, model, curves)
    joint = None if error else _refined(weighted, model, curves)
    if joint is not None:
        model = joint.model
    inside = in_band(weighted, model.poles)
    if not inside.any():
        raise RecordingError(
            "the curves hold no resonance that their noise and resolution can show; measure more densely around "
            "the resonances, longer, or over a band that holds some"
        )
    # A bound holds 95 %: two standard deviations.
    f_error, z_error = (
        np.hypot(error, 0.5 * part)
        for error, part in zip(
            pole_errors(weighted, model)
            if joint is None
            else refined_pole_errors(model.poles, joint.covariance),
            systematic_pole_errors(curves, model.poles, () if joint is None else joint.parts),
            strict=True,
        )
    )
    # Where nothing bounds the curves, they may well have their poles elsewhere.
    anywhere = inside & (2.0 * f_error >= abs(model.poles) / (2 * np.pi))
    inside &= ~anywhere
    loose: Array = np.asarray(abs(model.poles[anywhere]) / (2 * np.pi), dtype=float)
    holes = inside & in_holes(weighted.frequency, model.poles)
    inside &= ~holes
    unseen: Array = np.asarray(abs(model.poles[holes]) / (2 * np.pi), dtype=float)
    if not inside.any() and unseen.size:
        raise RecordingError(
            f"the curves hold poles ({', '.join(f'{f:.4g}' for f in unseen)} Hz) only in holes, where their lines were "
            "left out; record again without what is said to be missing there"
        )
    if not inside.any():
        raise RecordingError(
            f"the curves hold poles ({', '.join(f'{f:.4g}' for f in loose)} Hz) only where next to nothing bounds "
            "them; see `analysis frf` for what their bounds are made of"
        )
    poles, f_error, z_error = model.poles[inside], f_error[inside], z_error[inside]
    # A clock that is off moves all poles alike, which the parts of single lines determine only jointly.
    f_error = np.hypot(
        f_error, max(curve.uncertainty.clock for curve in frfs) * abs(poles) / (2 * np.pi * _LARGEST)
    )
    lower, upper = _residuals(model, inside, measured.frequency)
    result = Modes(
        frequency=np.asarray(abs(poles) / (2 * np.pi), dtype=float),
        frequency_error=f_error,
        damping=-poles.real / abs(poles),
        damping_error=z_error,
        shape_error=_shape_errors(curves, poles, model.residue[:, inside]),
        residue=model.residue[:, inside],
        responses=tuple(curve.response for curve in curves),
        chart=tuple(charts[0]),
        lower=lower,
        upper=upper,
        model_error=error,
        label=curves[0].label,
        warnings=(),
        input=curves[0].input,
        places=tuple(curve.output_at for curve in curves),
    )
    left_out = [frf.response for frf in frfs if frf.response not in result.responses]
    notes = doubts(result, curves, count, dropped, loose, unseen, left_out)
    return replace(result, warnings=(*curves[0].warnings, *notes))


def _shape_errors(curves: Sequence[Response], poles: ComplexArray, residue: ComplexArray) -> Array:
    """Find standard deviations of shapes with largest element one, from the curves' bounds at each resonance.

    What the sensor of their reference is off by all curves are off by.
    """
    frequency: Array = np.asarray(abs(poles) / (2 * np.pi), dtype=float)
    at = [_nearest(curve, frequency, np.isfinite(curve.value)) for curve in curves]
    size = np.array([abs(curve.value[lines]) for curve, lines in zip(curves, at, strict=True)])
    bound = np.array([curve.bound()[lines] for curve, lines in zip(curves, at, strict=True)])
    bound -= np.array([[curve.uncertainty.scale] for curve in curves]) * size
    top, modes = np.argmax(abs(residue), axis=0), np.arange(poles.size)
    share = abs(residue) / abs(residue[top, modes])
    error: Array = 0.5 * np.hypot(bound, share * bound[top, modes]) / size[top, modes]
    error[top, modes] = 0.0
    return error


def _nearest(curve: Response, frequency: Array, among: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Which of some lines of a curve are nearest to other frequencies."""
    lines = np.flatnonzero(among)
    return np.asarray(lines[np.argmin(abs(curve.frequency[lines] - frequency[:, None]), axis=1)])


def _bounded(curves: Sequence[Response]) -> list[Response]:
    """Leave out responses that nothing bounds: they would weigh nothing."""
    found = [curve for curve in curves if np.isfinite(_sigma([curve])).any()]
    if not found:
        raise RecordingError(
            f"nothing bounds the responses at {', '.join(curve.response for curve in curves)}, so that they hold no "
            "modes: their readings are a few counts, or their reference may be nothing at all; record again with a "
            "converter range and sensors that suit the level"
        )
    return found


def _measured(curves: Sequence[Response]) -> tuple[Curves, Array]:
    """Values of the responses where all have one, and their standard deviations."""
    frequency = curves[0].frequency
    if any(
        curve.frequency.shape != frequency.shape or np.any(curve.frequency != frequency) for curve in curves
    ):
        raise SceneError(
            "the responses were measured at different frequencies: identify one recording at a time"
        )
    value, sigma = np.stack([curve.value for curve in curves]), _sigma(curves)
    # A line whose error nothing bounds in any response has no weight.
    known = np.isfinite(value).all(axis=0) & (frequency > 0) & np.isfinite(sigma).any(axis=0)
    if known.sum() < 8:
        raise RecordingError(
            f"{known.sum()} frequencies are too few for modes: measure at least 8, with several in each "
            "resonance"
        )
    for curve, row in zip(curves, value[:, known], strict=True):
        if not np.any(abs(row) > 0):
            raise RecordingError(f"{curve.response} does not respond at all: choose other channels")
    sigma = sigma[:, known]
    shared = max(curve.uncertainty.shared for curve in curves)
    resolution = max(curve.resolution for curve in curves)
    return Curves(frequency[known], value[:, known], 1.0 / sigma, shared, resolution), sigma


def _explained(
    measured: Curves, sigma: Array, stable: ComplexArray, every: ComplexArray, most: int
) -> tuple[Curves, Fit, float]:
    """Best model, the curves with the weights it was fitted with, and its relative error beyond noise."""
    size = _neighbourhood(measured)
    tried: list[tuple[Curves, Fit]] = []
    for error in _DISTRUST:
        curves = replace(measured, weight=1.0 / np.hypot(sigma, error * size))
        model = select(curves, stable, every, most)
        if tried:
            # Poles that only together explain much may be lost one by one: start from those identified before, too.
            model = preferred(curves, model, select(curves, tried[-1][1].poles, every, most))
        tried.append((curves, model))
        if tried[-1][1].misfit < _NOT_NOISE * curves.degrees(tried[-1][1].poles.size):
            break
    # By the peaks around, a peak of a line or two explains itself: distrust may lose it.
    narrow = [
        int((in_band(curves, model.poles) & hidden(curves, model.poles)).sum()) for curves, model in tried
    ]
    curves, model = tried[int(np.argmax(narrow)) if max(narrow) > narrow[-1] else -1]
    # What weighs nothing is not fitted, and where nothing is read nothing can be missed.
    scale = curves.weight * size
    relative = np.divide(model.rest, scale, out=np.zeros_like(model.rest), where=scale > 0.0)
    missed = np.linalg.norm(relative) / np.sqrt(curves.degrees(model.poles.size))
    # Modes far outside the band bend a curve by a little more than their residual terms: that is as linear.
    return curves, model, float(missed) if len(tried) > 1 and missed > LEAST_RELATIVE_ERROR else 0.0


def _neighbourhood(measured: Curves) -> Array:
    """Largest value around each point: what is nonlinear is as large as the peaks, not as what is left between."""
    f, size = measured.frequency, np.abs(measured.value)
    low, high = np.searchsorted(f, f / _AROUND), np.searchsorted(f, f * _AROUND, side="right")
    return np.stack([size[:, a:b].max(axis=1) for a, b in zip(low, high, strict=True)], axis=1)


def _without_doubtful_poles(
    curves: Curves, model: Fit, frfs: Sequence[Response]
) -> tuple[Curves, Fit, list[float]]:
    """Leave out poles that are no modes; say where they were, in Hz.

    Those whose damping is undetermined, and those that exceed no curve's systematic uncertainty, which does not
    scatter, as remaining transients and images make such bumps. A peak narrower than the resolution is a mode
    all the same: no curve of it could show more.
    """
    dropped: list[float] = []
    while model.poles.size:
        _, z_error = pole_errors(curves, model)
        damping = z_error * abs(model.poles) / -model.poles.real
        doubt = np.where(
            in_band(curves, model.poles), np.maximum(damping, DETERMINED * _buried(model, frfs)), 0.0
        )
        for k in np.flatnonzero(hidden(curves, model.poles)):
            line = int(np.argmin(abs(curves.frequency - abs(model.poles[k]) / (2 * np.pi))))
            doubt[k] = 0.0 if any(stands_out(abs(row), line) for row in curves.value) else np.inf
        worst = int(np.argmax(doubt))
        if doubt[worst] < DETERMINED:
            break
        dropped.append(abs(model.poles[worst]) / (2 * np.pi))
        model = fit(curves, np.delete(model.poles, worst))
    return curves, model, dropped


def _refined(weighted: Curves, model: Fit, frfs: Sequence[Response]) -> Refined | None:
    """Weigh all responses by their covariance; None where they say no more than the size of their errors."""
    if any(frf.uncertainty.errors is None for frf in frfs):
        return None
    lines = np.searchsorted(frfs[0].frequency, weighted.frequency)
    curves = [frf.at(lines) for frf in frfs]
    errors = stack(curves).covariance()
    size = np.stack([abs(frf.value) for frf in curves])
    rough = np.hypot(0.5 * _off(curves, ROUGH), LEAST_RELATIVE_ERROR * size)
    if not (np.isfinite(errors.lines).all() and np.isfinite(rough).all()):
        return None
    return refined(weighted, model, errors, rough)


def _buried(model: Fit, frfs: Sequence[Response]) -> Array:
    """How far a curve may be off at each pole over the height of its peak, in the curve where that is least."""
    frequency: Array = np.asarray(abs(model.poles) / (2 * np.pi), dtype=float)
    off = [
        part[_nearest(frf, frequency, np.isfinite(frf.value + part))]
        for frf, part in zip(frfs, _off(frfs, (*ROUGH, ALIASING)), strict=True)
    ]
    height = abs(model.residue) / -model.poles.real
    return np.asarray(np.min(off / np.maximum(height, 1e-300), axis=0))


def _residuals(model: Fit, inside: NDArray[np.bool_], frequency: Array) -> tuple[Array, Array]:
    """Add up what modes outside the band do inside, fitted ones too."""
    s = 2j * np.pi * frequency
    rest = np.zeros((model.residue.shape[0], s.size), dtype=complex)
    for p, residue in zip(model.poles[~inside], model.residue[:, ~inside].T, strict=True):
        rest += residue[:, None] / (s - p) + residue.conj()[:, None] / (s - p.conjugate())
    terms = np.stack(residual_terms(s), axis=1)
    size = abs(terms).max(axis=0)
    columns_, wanted = (np.concatenate([each.real, each.imag]) for each in (terms / size, rest.T))
    more = np.linalg.lstsq(columns_, wanted, rcond=None)[0].T / size
    return model.lower + more[:, 0], model.upper + more[:, 1:]


def _sigma(curves: Sequence[Response]) -> Array:
    size = np.stack([abs(curve.value) for curve in curves])
    error = np.stack([curve.error for curve in curves])
    for row, curve in zip(error, curves, strict=True):
        finite = np.isfinite(row)
        if not finite.all():
            row[~finite] = scatter(curve.value)[~finite]
        if not curve.degrees.any():
            # What a file says of its errors leaves out what else bounds its lines, which scatter shows.
            row[:] = np.maximum(row, scatter(curve.value))
        row[:] = np.maximum(row, _usual(row, curve.degrees))
    # What differs from line to line bends a curve as noise does; what is smooth looks like no mode.
    error = np.hypot(error, 0.5 * _off(curves, ROUGH))
    top = np.nanmax(size, axis=1, keepdims=True)
    return np.hypot(error, LEAST_RELATIVE_ERROR * np.maximum(size, 1e-6 * top))


def _usual(error: Array, degrees: Array) -> Array:
    """Median of errors over so many neighbours as have enough degrees of freedom together; 0 where each has by itself.

    Errors estimated from few parts are sometimes nearly zero by chance: such lines would decide alone.
    """
    own = float(np.median(degrees))
    if not 0.0 < own < _ENOUGH:
        return np.zeros(error.size)
    return np.asarray(
        scipy.ndimage.median_filter(error, min(1 + 2 * int(_ENOUGH / own), error.size), mode="nearest")
    )


def _off(curves: Sequence[Response], names: Sequence[str]) -> Array:
    """How far each line may be off by some systematic parts; infinite where one is not known."""
    parts = [[curve.limits.get(name, np.zeros(curve.value.size)) for name in names] for curve in curves]
    return np.asarray(np.nan_to_num(np.linalg.norm(parts, axis=1), nan=np.inf, posinf=np.inf))
