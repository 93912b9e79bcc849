"""Local rational method: a response without leakage from the spectra of whole segments of a recording.

Around every line the response is a quotient of two polynomials of low order. The transients at the two ends of a
segment, which cause leakage, are another quotient with the same denominator. All polynomials are fitted to the
neighboring lines by least squares [1]_. No window widens the peaks, the response need not decay within the segment,
and the residuals of the fit determine the error bars.

The transfer function of sensor, amplifier and coupling is known and is not fitted. The transients of slow high-pass
filters vary too strongly near zero frequency for polynomials of low order, and are separate terms of the fit. The
denominator is omitted at lines where the noise exceeds its effect. The model error is estimated by another fit with
polynomials of the next higher order.

References
----------
.. [1] T. McKelvey, G. Guérin, Non-parametric frequency response estimation using a local rational model, 16th IFAC
   Symposium on System Identification, 2012.
.. [2] J. A. Hausman, Specification tests in econometrics, Econometrica 46 (1978) 1251-1271.
.. [3] G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978) 461-464.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
import scipy
from numpy.typing import NDArray

from rig.arrays import Array, ComplexArray

Lines = NDArray[np.int64]
Result = TypeVar("Result", "LocalFit", "_Unknown")

# Order of the polynomials of the numerator, the denominator and the transients. A fit of the next higher order gives
# the model error.
ORDER = 2
# Weight of the regularization towards small coefficients, and smallest magnitude of a denominator.
_REGULARIZATION = 1e-10
# Value that replaces zero power in a denominator.
_ZERO_POWER = 1e-300
#: 95th percentile of the noise power of a line, relative to its mean (two degrees of freedom).
POWER_RATIO_95 = 3.0
# Largest number of elements of the systems of equations that are solved at a time; their arrays fit into the cache.
_MAX_ELEMENTS = 1 << 16


@dataclass(frozen=True)
class Reading:
    """Reading of a channel in some segments."""

    # spectra of segments brought to equal length, without a window; complex, shape (segments, bins)
    spectra: ComplexArray
    response: ComplexArray  # response of the channel to the quantity that it measures; complex, shape (bins,)
    # spectra of the transients of its high-pass filters, ``1 / (s - pole)``; complex, shape (poles, bins)
    slow: ComplexArray


class LocalFit(NamedTuple):
    """Result of the local fits, each at all lines."""

    value: ComplexArray  # response; NaN at lines without excitation; complex, shape (lines,)
    variance: Array  # variance of either quadrature component; shape (lines,)
    # part of the response power without transients that the fit assigns to the reference; shape (lines,)
    coherence: Array
    degrees: Array  # degrees of freedom of the variance; shape (lines,)
    # variance of either quadrature component for noise of unit power in the reference at each line. In a peak
    # that is narrower than the range of a fit, the poles follow this noise and the residuals do not show it;
    # shape (lines,)
    noise_gain: Array
    # part of the reference power that is independent of all other terms of the fit. It is small for a tone
    # that sweeps evenly, because its spectrum resembles a transient, and large for noise; shape (lines,)
    independent: Array
    noise: Array  # power of the residual, in the squared unit of the reading; shape (lines,)
    # error of the value per unit error of each bin of the reading; shape (lines, segments, width)
    influence: ComplexArray
    residual: ComplexArray  # residual of the reading; shape (lines, segments, width)
    curve: ComplexArray  # fitted reading per unit of the reference; shape (lines, 1, width)
    first: Lines  # first bin of each fit; shape (lines,)
    criterion: Array  # Schwarz's criterion, for the comparison of orders [3]_; shape (lines,)
    # model error of the polynomials: the change by a fit of the next higher order, at the line or as root mean
    # square around it, less the change by noise [2]_; shape (lines,)
    model_error: Array


def local_fit(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    lines: Lines,
    side: int,
    used: float = 1.0,
    others: ComplexArray | None = None,
) -> LocalFit:
    """Fit the response at some lines, with `side` lines on either side.

    `ends`: phase of the first sample of each segment, if the transients at beginning and end are separate terms. It is
    1 at all bins if they are a single term, and 0 if the rig was at rest. `used`: measured part of the samples. The
    remaining samples are zero padding, which correlates neighboring lines. `others`, shape (inputs, segments, bins):
    true spectra of other inputs, each with its own numerator and the common denominator.

    >>> random = np.random.default_rng(1)
    >>> bins = np.arange(200)
    >>> force = random.standard_normal((1, 200)) + 1j * random.standard_normal((1, 200))
    >>> pole = 1j * (bins - 100.0) + 2.0
    >>> reading = Reading(force / pole + 5.0 / pole, np.ones(200), np.zeros((0, 200)))
    >>> fit = local_fit(reading, force, np.zeros((1, 200)), np.array([100, 103]), 12)
    >>> np.allclose(fit.value, 1.0 / pole[[100, 103]])
    True
    """
    fits = []
    for order, poles in ((ORDER, 0), (ORDER, ORDER), (ORDER + 1, ORDER + 1)):
        inputs = 1 if others is None else 1 + len(others)
        unknowns = inputs * (order + 1) + poles + 2 * len(reference) * (order + 1 + len(reading.slow))
        step = max(1, _MAX_ELEMENTS // ((2 * side + 1) * unknowns))
        parts = [
            _fit(reading, reference, ends, lines[at : at + step], side, used, order, poles, others)
            for at in range(0, lines.size, step)
        ]
        fits.append(LocalFit(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True))))
    polynomial, rational, higher_order = fits
    prefers_polynomial = polynomial.criterion < rational.criterion
    best = _select(prefers_polynomial, polynomial, rational)
    # The lower order is contained in the higher, so the variance of the difference is the difference of the
    # variances.
    change = abs(higher_order.value - best.value) ** 2
    noise = 2.0 * np.maximum(higher_order.variance - best.variance, 0.0)
    n_lines = max(1, side // max(1, int(np.median(np.diff(lines)))) if lines.size > 1 else 1)
    local_mean = scipy.ndimage.uniform_filter1d(change - noise, n_lines, mode="nearest")
    # A peak of one or two lines has a model error only at these lines. Noise exceeds this limit in 5 % of lines.
    at_line = change - POWER_RATIO_95 * noise
    return best._replace(model_error=np.sqrt(np.maximum(np.maximum(local_mean, at_line), 0.0)))


def _fit(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    lines: Lines,
    side: int,
    used: float,
    order: int,
    poles: int,
    others: ComplexArray | None,
) -> LocalFit:
    """Fit polynomials of one order, without the model error.

    `order`: of numerator and transients; `poles`: order of the denominator; other arguments as in `local_fit`.
    """
    segments, width = len(reference), 2 * side + 1
    # Segments with separate transients at their beginning and end.
    begins = [s for s in range(segments) if np.any(ends[s]) and not np.all(ends[s] == 1.0)]
    first = np.clip(lines - side, 0, reference.shape[1] - width)
    bins = first[:, None] + np.arange(width)
    offset = ((bins - lines[:, None]) / side)[:, None, :]
    output, reference_input, phase = (
        np.moveaxis(spectra[:, bins], 1, 0) for spectra in (reading.spectra, reference, ends)
    )
    channel = reading.response[bins][:, None, :]
    reference_input = reference_input * channel
    output_rms, input_rms = (np.maximum(_rms(spectra), _ZERO_POWER) for spectra in (output, reference_input))
    output, reference_input = output / output_rms, reference_input / input_rms
    powers = np.stack([offset**k for k in range(order + 1)], axis=-1)
    transients = [powers]
    transients += [((decay := slow[bins][:, None, :]) / _rms(decay))[..., None] for slow in reading.slow]
    transient = np.concatenate(transients, axis=-1)
    if begins:
        # The columns are zero if a segment has no separate transient at its beginning; the regularization omits them.
        at_start = np.where(np.isin(np.arange(segments), begins)[:, None], phase, 0.0)[..., None]
        transient = np.concatenate(
            [np.broadcast_to(transient, (*output.shape, transient.shape[-1])), at_start * transient], axis=-1
        )
    shared = [reference_input[..., None] * powers]
    for other in () if others is None else others:
        local_input = np.moveaxis(other[:, bins], 1, 0) * channel
        shared.append((local_input / np.maximum(_rms(local_input), _ZERO_POWER))[..., None] * powers)
    terms = _Terms(np.concatenate(shared, axis=-1), transient, offset[..., None] ** np.arange(1, poles + 1))
    # Multiplication by the denominator makes the problem linear, but it also weights the noise and fits poles to it.
    # A Gauss-Newton step corrects both.
    unknown, influence = _solve(terms, output, output)
    model, denominator = terms.quotient(unknown)
    residual = output - model
    if poles:
        divisor = denominator[..., None]
        linearized = terms._replace(shared=terms.shared / divisor, transient=terms.transient / divisor)
        step, influence = _solve(linearized, model / denominator, residual)
        stepped = _Unknown(*(np.add(*pair) for pair in zip(unknown, step, strict=True)))
        stepped_residual = output - terms.quotient(stepped)[0]
        is_improved = _power(stepped_residual) < _power(residual)
        unknown = _select(is_improved, stepped, unknown)
        residual = np.where(is_improved[:, None, None], stepped_residual, residual)
    # Response at all lines of the fit: the model for a unit reference.
    reference_only = unknown._replace(numerator=unknown.numerator[:, : order + 1])
    curve = terms._replace(shared=powers).response(reference_only)
    noise_gain = _power(influence * curve * channel) / 2.0
    # Part of the unit reference power that is independent of all other columns. With the columns of the numerator
    # alone, the constant would have the variance of a polynomial fit.
    polynomial = np.linalg.inv(np.swapaxes(powers[:, 0], 1, 2) @ powers[:, 0])[:, 0, 0] / segments
    variance, residual_power = _power(influence), _power(residual)
    independent = np.minimum(polynomial / np.maximum(variance, _ZERO_POWER), 1.0)
    excitation = np.where(input_rms > _ZERO_POWER, input_rms, np.nan)[:, 0, 0]
    scale = output_rms[:, 0, 0] / excitation
    constant = unknown.numerator[:, 0]
    # Zero padding correlates neighboring lines and reduces the degrees of freedom.
    equations = segments * width
    unknowns = terms.shared.shape[-1] + poles + (segments + len(begins)) * (order + 1 + len(reading.slow))
    n_free = max(used * equations - unknowns, 0.5)
    noise = residual_power / n_free
    # Noise contributes to the magnitude of the estimate even if the true response is zero.
    explained = np.maximum(np.square(abs(constant)) - noise * variance, 0.0) * independent * equations
    penalty = unknowns * np.log(2 * used * equations)
    criterion = used * equations * np.log(np.maximum(residual_power, _ZERO_POWER)) + penalty
    return LocalFit(
        value=constant * scale,
        variance=0.5 * noise * variance * scale**2,
        coherence=explained / np.maximum(explained + residual_power, _ZERO_POWER),
        degrees=np.full(lines.size, 2.0 * n_free),
        noise_gain=noise_gain * (scale / excitation) ** 2,
        independent=independent,
        noise=noise * output_rms[:, 0, 0] ** 2,
        influence=influence / np.where(input_rms > _ZERO_POWER, input_rms, np.inf),
        residual=residual * output_rms,
        curve=curve * channel * (output_rms / input_rms),
        first=np.asarray(first),
        criterion=criterion,
        model_error=np.zeros(lines.size),
    )


class _Unknown(NamedTuple):
    """Coefficients of the polynomials at each line."""

    numerator: ComplexArray  # shape (lines, order + 1)
    denominator: ComplexArray  # without its constant, which is 1; shape (lines, poles)
    transients: ComplexArray  # shape (lines, segments, terms)


class _Terms(NamedTuple):
    """Known columns of the linear system, at the lines around each line."""

    # reference times powers of the frequency distance, for the common numerator of all segments; shape
    # (lines, segments, width, order + 1)
    shared: ComplexArray | Array
    # columns of each segment's transients; shape (lines, segments or 1, width, terms)
    transient: ComplexArray | Array
    powers: Array  # columns of the denominator; shape (lines, 1, width, poles)

    def response(self, unknown: _Unknown) -> ComplexArray:
        """Compute the quotient of the two polynomials; shape (lines, segments or 1, width)."""
        return self._numerator(unknown.numerator) / self._denominator(unknown.denominator)

    def quotient(self, unknown: _Unknown) -> tuple[ComplexArray, ComplexArray]:
        """Compute the model of the lines and its denominator."""
        denominator = self._denominator(unknown.denominator)
        transients = (self.transient @ unknown.transients[..., None])[..., 0]
        return self._numerator(unknown.numerator) / denominator + transients / denominator, denominator

    def _numerator(self, numerator: ComplexArray) -> ComplexArray:
        return np.asarray((self.shared @ numerator[:, None, :, None])[..., 0])

    def _denominator(self, denominator: ComplexArray) -> ComplexArray:
        value = 1.0 + (self.powers @ denominator[:, None, :, None])[..., 0]
        # A pole exactly on a line is not a pole of a damped structure.
        return np.where(abs(value) > _REGULARIZATION, value, _REGULARIZATION)


def _solve(terms: _Terms, model: ComplexArray, right: ComplexArray) -> tuple[_Unknown, ComplexArray]:
    """Solve by least squares; also return the weight of each right-hand side in the first unknown.

    The first unknown is the constant of the numerator: the response at the line itself, where the denominator is 1.
    The transients of each segment are eliminated by projection onto the orthogonal complement of their columns. The
    common unknowns are then estimated from the projected equations.

    If a lower order suffices, denominator, numerator and transient have an arbitrary common factor. A weak
    regularization towards small coefficients determines it without effect on the response at the line.
    `model`, multiplied by the denominator, and `right` have the shape (lines, segments, width).
    """
    lines, segments, width = right.shape
    count = terms.transient.shape[-1]
    q, r = np.linalg.qr(_regularize(terms.transient))
    adjoint = np.conj(np.swapaxes(q, 2, 3))
    shared = np.concatenate([terms.shared, -model[..., None] * terms.powers], axis=-1)
    system = np.concatenate([shared, right[..., None]], axis=-1)
    projection = adjoint[..., :width] @ system
    orthogonal = -(q @ projection)
    orthogonal[..., :width, :] += system
    unknowns = shared.shape[-1]
    equations = orthogonal.reshape(lines, -1, unknowns + 1)
    q, r_shared = np.linalg.qr(_regularize(equations[..., :unknowns]))
    adjoint = np.conj(np.swapaxes(q[:, : equations.shape[1]], 1, 2))
    solved = np.linalg.solve(r_shared, adjoint @ equations[..., unknowns:])
    transients = np.linalg.solve(r, projection[..., unknowns:] - projection[..., :unknowns] @ solved[:, None])[..., 0]
    first_unit = np.broadcast_to(np.eye(unknowns, 1), (lines, unknowns, 1))
    first_row = np.swapaxes(np.linalg.solve(np.swapaxes(r_shared, 1, 2), first_unit), 1, 2)
    influence = (first_row @ adjoint).reshape(lines, segments, width + count)[..., :width]
    numerators = terms.shared.shape[-1]
    return _Unknown(solved[:, :numerators, 0], solved[:, numerators:, 0], transients), influence


def _select(lines: NDArray[np.bool_], first: Result, second: Result) -> Result:
    """Combine two results: the arrays of the first at the selected `lines`, of the second at all others."""
    pairs = zip(first, second, strict=True)
    return type(first)(*(np.where(lines.reshape(-1, *[1] * (pair[0].ndim - 1)), *pair) for pair in pairs))


def _regularize(system: ComplexArray | Array) -> ComplexArray:
    """Add the equations of a weak regularization towards small unknowns."""
    unknowns = system.shape[-1]
    weak = np.broadcast_to(_REGULARIZATION * np.eye(unknowns), (*system.shape[:-2], unknowns, unknowns))
    return np.concatenate([system, weak], axis=-2)


def _power(spectra: ComplexArray) -> Array:
    """Return the sum of squares of each line, shape (lines,)."""
    return np.asarray(np.sum(abs(spectra) ** 2, axis=(1, 2)))


def _rms(spectra: ComplexArray) -> Array:
    """Return the root mean square of each line, shape (lines, 1, 1)."""
    return np.sqrt(np.mean(abs(spectra) ** 2, axis=(1, 2), keepdims=True))
