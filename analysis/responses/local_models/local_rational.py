"""Local rational method: a response without leakage from the spectra of whole stretches of a recording.

Around every line the response is a quotient of two polynomials of low order. The transients at the two ends of a
stretch, which cause leakage, are another quotient with the same denominator. All polynomials are fitted to the
neighbouring lines by least squares [1]_. No window widens the peaks, the response need not decay within the stretch,
and the residuals of the fit determine the error bars.

The transfer function of sensor, amplifier and coupling is known and is not fitted. The transients of slow high-pass
filters vary too strongly near zero frequency for polynomials of low order, and are separate terms of the fit. The
denominator is omitted where the noise exceeds its effect. The model error is estimated by another fit with
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
_FAINT, _NOTHING = 1e-10, 1e-300
#: The noise power is below this multiple of its mean in 95 % of lines.
LARGEST = 3.0
# Elements of the systems of equations that are solved at a time, which limits memory.
_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Reading:
    """Reading of a channel in some stretches."""

    # spectra of stretches brought to equal length, without a window; complex, shape (stretches, bins)
    spectra: ComplexArray
    response: ComplexArray  # response of the channel to the quantity that it measures; complex, shape (bins,)
    # spectra of the transients of its high-pass filters, ``1 / (s - pole)``; complex, shape (poles, bins)
    slow: ComplexArray


class LocalFit(NamedTuple):
    """Result of the local fits, each at all lines."""

    value: ComplexArray  # response; NaN at lines without excitation; complex, shape (lines,)
    variance: Array  # variance of either quadrature component; shape (lines,)
    # share of the response power without transients that the fit assigns to the reference; shape (lines,)
    coherence: Array
    degrees: Array  # degrees of freedom of the variance; shape (lines,)
    # variance of either quadrature component for noise of unit power in the reference at each line. In a peak
    # that is narrower than the range of a fit, the poles follow this noise and the residuals do not show it;
    # shape (lines,)
    through: Array
    # share of the reference power that no other term of the fit can explain. The share is small for a tone
    # that sweeps evenly, because its spectrum resembles a transient, and large for noise; shape (lines,)
    apart: Array
    noise: Array  # power of the residual, in the squared unit of the reading; shape (lines,)
    # error of the value per unit error of each bin of the reading; shape (lines, stretches, width)
    influence: ComplexArray
    residual: ComplexArray  # residual of the reading; shape (lines, stretches, width)
    curve: ComplexArray  # fitted reading per unit of the reference; shape (lines, 1, width)
    first: Lines  # first bin of each fit; shape (lines,)
    criterion: Array  # Schwarz's criterion, for the comparison of orders [3]_; shape (lines,)
    # model error of the polynomials: the change by a fit of the next higher order, at the line or as root mean
    # square around it, less the change that noise explains [2]_; shape (lines,)
    missed: Array


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

    `ends`: phase of the first sample of each stretch, if the transients at beginning and end are separate terms; 1 at
    all bins if they are a single term, and 0 if the rig was at rest. `used`: measured share of the samples; the
    remainder is zero padding, which correlates neighbouring lines. `others`, shape (inputs, stretches, bins): true
    spectra of other inputs, each with its own numerator and the common denominator.

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
        step = max(1, _AT_ONCE // ((2 * side + 1) * unknowns))
        parts = [
            _fit(reading, reference, ends, lines[at : at + step], side, used, order, poles, others)
            for at in range(0, lines.size, step)
        ]
        fits.append(LocalFit(*(np.concatenate(each) for each in zip(*parts, strict=True))))
    plain, rational, more = fits
    simple = plain.criterion < rational.criterion
    best = _selected(simple, plain, rational)
    # The lower order is contained in the higher, so the variance of the difference is the difference of the
    # variances.
    change, noise = abs(more.value - best.value) ** 2, 2.0 * np.maximum(more.variance - best.variance, 0.0)
    near = max(1, side // max(1, int(np.median(np.diff(lines)))) if lines.size > 1 else 1)
    around = scipy.ndimage.uniform_filter1d(change - noise, near, mode="nearest")
    # The model error at a peak of one or two lines is limited to these lines; noise exceeds this limit in 5 % of
    # lines.
    missed = np.sqrt(np.maximum(np.maximum(around, change - LARGEST * noise), 0.0))
    return best._replace(missed=missed)


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
    """Fit polynomials of one order, without the model error."""
    stretches, width = len(reference), 2 * side + 1
    begins = [s for s in range(stretches) if np.any(ends[s]) and not np.all(ends[s] == 1.0)]
    first = np.clip(lines - side, 0, reference.shape[1] - width)
    near = first[:, None] + np.arange(width)
    at = ((near - lines[:, None]) / side)[:, None, :]
    x, f, e = (np.moveaxis(each[:, near], 1, 0) for each in (reading.spectra, reference, ends))
    response_near = reading.response[near][:, None, :]
    f = f * response_near
    size, drive = (np.maximum(_rms(each), _NOTHING) for each in (x, f))
    x, f = x / size, f / drive
    powers = np.stack([at**k for k in range(order + 1)], axis=-1)
    transients = [powers]
    transients += [((each := slow[near][:, None, :]) / _rms(each))[..., None] for slow in reading.slow]
    own = np.concatenate(transients, axis=-1)
    if begins:
        # The columns are zero if a stretch has no separate transient at its beginning; the regularization omits them.
        begun = np.where(np.isin(np.arange(stretches), begins)[:, None], e, 0.0)[..., None]
        own = np.concatenate([np.broadcast_to(own, (*x.shape, own.shape[-1])), begun * own], axis=-1)
    shared = [f[..., None] * powers]
    for other in () if others is None else others:
        near_other = np.moveaxis(other[:, near], 1, 0) * response_near
        shared.append((near_other / np.maximum(_rms(near_other), _NOTHING))[..., None] * powers)
    terms = _Terms(np.concatenate(shared, axis=-1), own, at[..., None] ** np.arange(1, poles + 1))
    # Multiplication by the denominator makes the problem linear, but it also weights the noise and fits poles to it.
    # A Gauss-Newton step corrects both.
    unknown, influence = _solved(terms, x, x)
    model, below = terms.quotient(unknown)
    left = x - model
    if poles:
        slope = terms._replace(shared=terms.shared / below[..., None], own=terms.own / below[..., None])
        change, influence = _solved(slope, model / below, left)
        stepped = _Unknown(*(np.add(*each) for each in zip(unknown, change, strict=True)))
        changed = x - terms.quotient(stepped)[0]
        better = _power(changed) < _power(left)
        unknown = _selected(better, stepped, unknown)
        left = np.where(better[:, None, None], changed, left)
    # Response at all lines of the fit: the model for a unit reference.
    of_reference = unknown._replace(numerator=unknown.numerator[:, : order + 1])
    curve = terms._replace(shared=powers).response(of_reference)
    through = _power(influence * curve * response_near) / 2.0
    # Share of the unit reference power that is independent of all other columns. With the columns of the numerator
    # alone, the constant would have the variance of a polynomial fit.
    scatter = np.linalg.inv(np.swapaxes(powers[:, 0], 1, 2) @ powers[:, 0])[:, 0, 0] / stretches
    spread, rest = _power(influence), _power(left)
    apart = np.minimum(scatter / np.maximum(spread, _NOTHING), 1.0)
    driven = np.where(drive > _NOTHING, drive, np.nan)[:, 0, 0]
    scale = size[:, 0, 0] / driven
    constant = unknown.numerator[:, 0]
    # Zero padding correlates neighbouring lines and reduces the degrees of freedom.
    equations = stretches * width
    unknowns = terms.shared.shape[-1] + poles + (stretches + len(begins)) * (order + 1 + len(reading.slow))
    free = max(used * equations - unknowns, 0.5)
    noise = rest / free
    # Noise contributes to the magnitude of the estimate even if the true response is zero.
    explained = np.maximum(np.square(abs(constant)) - noise * spread, 0.0) * apart * equations
    criterion = used * equations * np.log(np.maximum(rest, _NOTHING)) + unknowns * np.log(
        2 * used * equations
    )
    return LocalFit(
        value=constant * scale,
        variance=0.5 * noise * spread * scale**2,
        coherence=explained / np.maximum(explained + rest, _NOTHING),
        degrees=np.full(lines.size, 2.0 * free),
        through=through * (scale / driven) ** 2,
        apart=apart,
        noise=noise * size[:, 0, 0] ** 2,
        influence=influence / np.where(drive > _NOTHING, drive, np.inf),
        residual=left * size,
        curve=curve * response_near * (size / drive),
        first=np.asarray(first),
        criterion=criterion,
        missed=np.zeros(lines.size),
    )


class _Unknown(NamedTuple):
    """Coefficients of the polynomials at each line."""

    numerator: ComplexArray  # shape (lines, order + 1)
    denominator: ComplexArray  # without its constant, which is 1; shape (lines, poles)
    transients: ComplexArray  # shape (lines, stretches, terms)


class _Terms(NamedTuple):
    """Known columns of the linear system, at the lines around each line."""

    # reference times powers of the frequency distance, for the common numerator of all stretches; shape
    # (lines, stretches, width, order + 1)
    shared: ComplexArray | Array
    # columns of each stretch's transients; shape (lines, stretches or 1, width, terms)
    own: ComplexArray | Array
    powers: Array  # columns of the denominator; shape (lines, 1, width, poles)

    def response(self, unknown: _Unknown) -> ComplexArray:
        """Compute the quotient of the two polynomials; shape (lines, stretches or 1, width)."""
        return self._above(unknown.numerator) / self._below(unknown.denominator)

    def quotient(self, unknown: _Unknown) -> tuple[ComplexArray, ComplexArray]:
        """Compute the model of the lines and its denominator."""
        below = self._below(unknown.denominator)
        transients = (self.own @ unknown.transients[..., None])[..., 0]
        return self._above(unknown.numerator) / below + transients / below, below

    def _above(self, numerator: ComplexArray) -> ComplexArray:
        return np.asarray((self.shared @ numerator[:, None, :, None])[..., 0])

    def _below(self, denominator: ComplexArray) -> ComplexArray:
        below = 1.0 + (self.powers @ denominator[:, None, :, None])[..., 0]
        # A pole exactly on a line is not a pole of a damped structure.
        return np.where(abs(below) > _FAINT, below, _FAINT)


def _solved(terms: _Terms, model: ComplexArray, right: ComplexArray) -> tuple[_Unknown, ComplexArray]:
    """Solve by least squares; also return the weight of each right-hand side in the first unknown.

    The first unknown is the constant of the numerator: the response at the line itself, where the denominator is 1.
    The transients of each stretch are eliminated by projection onto the orthogonal complement of their columns; the
    common unknowns are then estimated from the remainder.

    If a lower order suffices, denominator, numerator and transient have an arbitrary common factor. A weak
    regularization towards small coefficients determines it without effect on the response at the line.
    `model`, multiplied by the denominator, and `right` have the shape (lines, stretches, width).
    """
    lines, stretches, width = right.shape
    count = terms.own.shape[-1]
    q, r = np.linalg.qr(_wishing(terms.own))
    adjoint = np.conj(np.swapaxes(q, 2, 3))
    shared = np.concatenate([terms.shared, -model[..., None] * terms.powers], axis=-1)
    both = np.concatenate([shared, right[..., None]], axis=-1)
    along = adjoint[..., :width] @ both
    apart = -(q @ along)
    apart[..., :width, :] += both
    unknowns = shared.shape[-1]
    free = apart.reshape(lines, -1, unknowns + 1)
    q, r_shared = np.linalg.qr(_wishing(free[..., :unknowns]))
    adjoint = np.conj(np.swapaxes(q[:, : free.shape[1]], 1, 2))
    found = np.linalg.solve(r_shared, adjoint @ free[..., unknowns:])
    transients = np.linalg.solve(r, along[..., unknowns:] - along[..., :unknowns] @ found[:, None])[..., 0]
    first = np.broadcast_to(np.eye(unknowns, 1), (lines, unknowns, 1))
    row = np.swapaxes(np.linalg.solve(np.swapaxes(r_shared, 1, 2), first), 1, 2)
    influence = (row @ adjoint).reshape(lines, stretches, width + count)[..., :width]
    numerators = terms.shared.shape[-1]
    return _Unknown(found[:, :numerators, 0], found[:, numerators:, 0], transients), influence


def _selected(lines: NDArray[np.bool_], one: Result, other: Result) -> Result:
    """Take the arrays of one result at some lines, and those of another elsewhere."""
    pairs = zip(one, other, strict=True)
    return type(one)(*(np.where(lines.reshape(-1, *[1] * (pair[0].ndim - 1)), *pair) for pair in pairs))


def _wishing(system: ComplexArray | Array) -> ComplexArray:
    """Add the equations of a weak regularization towards small unknowns."""
    unknowns = system.shape[-1]
    wish = np.broadcast_to(_FAINT * np.eye(unknowns), (*system.shape[:-2], unknowns, unknowns))
    return np.concatenate([system, wish], axis=-2)


def _power(each: ComplexArray) -> Array:
    return np.asarray(np.sum(abs(each) ** 2, axis=(1, 2)))


def _rms(each: ComplexArray) -> Array:
    return np.sqrt(np.mean(abs(each) ** 2, axis=(1, 2), keepdims=True))
