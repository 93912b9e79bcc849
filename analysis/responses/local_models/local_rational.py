"""Local rational method: a response without leakage from the spectra of whole stretches of a recording.

Around every line the response is a quotient of two low polynomials, and what the two ends of a stretch add to its
spectrum (the transients, which are what leaks) is another one with the same denominator. All are fitted by least
squares to the lines nearby [1]_; no window smears the curve, nothing needs to have died away, and what the fit
leaves over gives the error bars.

What sensor, amplifier and coupling do to the reading is known and is not fitted: the response passes through it, and
the transients of its slow high-passes, which bend too much near zero frequency for low polynomials, are terms of
their own. Where noise hides what a denominator could resolve, there is none. How far low polynomials miss the curve is
estimated by another fit with polynomials of one order more.

References
----------
.. [1] T. McKelvey, G. Guérin, Non-parametric frequency response estimation using a local rational model, 16th IFAC
   Symposium on System Identification, 2012.
.. [2] J. A. Hausman, Specification tests in econometrics, Econometrica 46 (1978) 1251-1271.
.. [3] G. Schwarz, Estimating the dimension of a model, Annals of Statistics 6 (1978) 461-464.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Lines = NDArray[np.int64]

# Order of the polynomials, of the response above and below and of the transients; one more to see what it misses.
ORDER = 2
_FAINT, _NOTHING = 1e-10, 1e-300
#: The power of noise is below so many times its mean in 95 % of lines.
LARGEST = 3.0
# Elements of the systems of equations solved at a time.
_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Reading:
    """What a channel read of some stretches."""

    spectra: ComplexArray
    """Spectra of stretches brought to equal length, without a window; complex, shape (stretches, bins)."""
    response: ComplexArray
    """Of the channel to what it measures; complex, shape (bins,)."""
    slow: ComplexArray
    """Spectra of the transients of its high-passes, ``1 / (s - pole)``; complex, shape (poles, bins)."""


@dataclass(frozen=True)
class LocalFit:
    """A response line by line."""

    value: ComplexArray
    """Response at each line; NaN where nothing was driven; complex, shape (lines,)."""
    variance: Array
    """Of either quadrature component; shape (lines,)."""
    coherence: Array
    """Share of the response's power that the fit gives to the reference, of what it does not give to transients; shape
    (lines,)."""
    degrees: Array
    """Degrees of freedom behind the variance; shape (lines,)."""
    missed: Array
    """How far the polynomials miss the curve at each line: what one order more changes there, or as root mean square
    around it, beyond the noise by which two such fits differ [2]_; shape (lines,)."""
    through: Array
    """Variance of either quadrature component for noise in the reference of power one at each line. In a peak narrower
    than what a fit takes in, poles follow that noise, and what is left over knows nothing of it; shape (lines,)."""
    apart: Array
    """Share of the reference's power that nothing else in the fit could explain: a tone that passes evenly looks much
    like a transient, and noise does not; shape (lines,)."""
    noise: Array
    """Power of what is left over at a line, in the square of what is read; shape (lines,)."""
    influence: ComplexArray
    """Error of the value for one of each bin read; shape (lines, stretches, width)."""
    residual: ComplexArray
    """What is left over of the reading; shape (lines, stretches, width)."""
    curve: ComplexArray
    """Reading per unit of the reference as fitted; shape (lines, 1, width)."""
    first: Lines
    """First bin that each fit takes in; shape (lines,)."""


def local_fit(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    lines: Lines,
    side: int,
    used: float = 1.0,
    others: ComplexArray | None = None,
) -> LocalFit:
    """Fit the response at some lines.

    Parameters
    ----------
    reading : Reading
        Of the response.
    reference : ndarray of complex, shape (stretches, bins)
        True spectra of the reference.
    ends : ndarray of complex, shape (stretches, bins)
        Phase of the instant at which each stretch begins, where its transient does not join that of its end: 1
        throughout where it does, 0 where the rig was at rest.
    lines : ndarray of int, shape (lines,)
        Bins at which to fit.
    side : int
        Lines to either side that a fit takes in.
    used : float
        Share of the samples behind the spectra that was measured, the rest being zeros: neighbouring lines then
        depend on each other, and count for less.
    others : ndarray of complex, shape (inputs, stretches, bins), optional
        True spectra of other inputs: each has a numerator of its own, with the common denominator.

    Examples
    --------
    >>> random = np.random.default_rng(1)
    >>> bins = np.arange(200)
    >>> force = random.standard_normal((1, 200)) + 1j * random.standard_normal((1, 200))
    >>> pole = 1j * (bins - 100.0) + 2.0
    >>> reading = Reading(force / pole + 5.0 / pole, np.ones(200), np.zeros((0, 200)))
    >>> fit = local_fit(reading, force, np.zeros((1, 200)), np.array([100, 103]), 12)
    >>> np.allclose(fit.value, 1.0 / pole[[100, 103]])
    True
    """
    plain, rational, more = (
        _fits(reading, reference, ends, lines, side, used, order, poles, others)
        for order, poles in ((ORDER, 0), (ORDER, ORDER), (ORDER + 1, ORDER + 1))
    )
    simple = plain.criterion < rational.criterion
    best = _Fits(
        *(
            np.where(simple.reshape(-1, *[1] * (each[0].ndim - 1)), *each)
            for each in zip(plain, rational, strict=True)
        )
    )
    # The variance of the difference is the difference of the variances, as the lower order is part of the higher.
    change, noise = abs(more.value - best.value) ** 2, 2.0 * np.maximum(more.variance - best.variance, 0.0)
    near = max(1, side // max(1, int(np.median(np.diff(lines)))) if lines.size > 1 else 1)
    around = scipy.ndimage.uniform_filter1d(change - noise, near, mode="nearest")
    # A peak of a line or two is missed there and nowhere else; noise changes a line by more than that in 5 % of lines.
    missed = np.sqrt(np.maximum(np.maximum(around, change - LARGEST * noise), 0.0))
    return LocalFit(
        best.value, best.variance, best.coherence, best.degrees, missed, best.through, best.apart, best.noise,
        best.influence, best.residual, best.curve, _first(lines, side, reference.shape[1]),
    )  # fmt: skip


class _Fits(NamedTuple):
    """Fits of one order, each of shape (lines,)."""

    value: ComplexArray
    variance: Array
    coherence: Array
    degrees: Array
    through: Array
    apart: Array
    noise: Array
    criterion: Array
    """Schwarz's, for orders to be compared [3]_."""
    influence: ComplexArray
    residual: ComplexArray
    curve: ComplexArray


def _fits(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    lines: Lines,
    side: int,
    used: float,
    order: int,
    poles: int,
    others: ComplexArray | None,
) -> _Fits:
    count = len(reference)
    begins = [s for s in range(count) if np.any(ends[s]) and not np.all(ends[s] == 1.0)]
    inputs = 1 if others is None else 1 + len(others)
    unknowns = inputs * (order + 1) + poles + (count + len(begins)) * (order + 1 + len(reading.slow))
    equations = count * (2 * side + 1)
    step = max(1, _AT_ONCE // (equations * (unknowns // count)))
    parts = [
        _fit(reading, reference, ends, begins, lines[first : first + step], side, order, poles, others)
        for first in range(0, lines.size, step)
    ]
    found = _Solution(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    # Zeros in front of a stretch make neighbouring lines depend on each other: they count for less.
    free = max(used * equations - unknowns, 0.5)
    noise = found.left / free
    # Noise makes even a response that is none some size.
    explained = np.maximum(found.power - noise * found.spread, 0.0) * found.apart * equations
    criterion = used * equations * np.log(np.maximum(found.left, _NOTHING)) + unknowns * np.log(
        2 * used * equations
    )
    return _Fits(
        value=found.value,
        variance=0.5 * noise * found.spread * found.scale**2,
        coherence=explained / np.maximum(explained + found.left, _NOTHING),
        degrees=np.full(lines.size, 2.0 * free),
        through=found.through,
        apart=found.apart,
        noise=noise * found.size**2,
        criterion=criterion,
        influence=found.influence,
        residual=found.residual,
        curve=found.curve,
    )


class _Solution(NamedTuple):
    """Least squares of readings and references that both have a mean square of one, at some lines."""

    value: ComplexArray
    scale: Array
    """Of the reading over that of the reference: the unit of the value."""
    power: Array
    """Square of the value without that scale."""
    spread: Array
    """Variance of the value without that scale, for noise of one."""
    left: Array
    """Sum of squares of what is left over of the reading."""
    through: Array
    apart: Array
    size: Array
    """Root of the mean square of what was read."""
    influence: ComplexArray
    """These three as `LocalFit` has them, with all scales."""
    residual: ComplexArray
    curve: ComplexArray


def _fit(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    begins: list[int],
    lines: Lines,
    side: int,
    order: int,
    poles: int,
    others: ComplexArray | None,
) -> _Solution:
    stretches, width = len(reference), 2 * side + 1
    near = _first(lines, side, reference.shape[1])[:, None] + np.arange(width)
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
        # Where a stretch has no beginning of its own the columns are zero, and the faint wish leaves them out.
        begun = np.where(np.isin(np.arange(stretches), begins)[:, None], e, 0.0)[..., None]
        own = np.concatenate([np.broadcast_to(own, (*x.shape, own.shape[-1])), begun * own], axis=-1)
    shared = [f[..., None] * powers]
    for other in () if others is None else others:
        near_other = np.moveaxis(other[:, near], 1, 0) * response_near
        shared.append((near_other / np.maximum(_rms(near_other), _NOTHING))[..., None] * powers)
    terms = _Terms(np.concatenate(shared, axis=-1), own, at[..., None] ** np.arange(1, poles + 1))
    # Multiplied by the denominator the problem is linear, but what is noise is weighted, too, and fitted by poles of
    # its own: a step of Gauss and Newton sets both right.
    unknown, influence = _solved(terms, x, x)
    model, below = terms.quotient(unknown)
    left = x - model
    if poles:
        slope = terms._replace(shared=terms.shared / below[..., None], own=terms.own / below[..., None])
        change, influence = _solved(slope, model / below, left)
        stepped = _Unknown(*(np.add(*each) for each in zip(unknown, change, strict=True)))
        changed = x - terms.quotient(stepped)[0]
        better = _power(changed) < _power(left)
        unknown = unknown.where(better, stepped)
        left = np.where(better[:, None, None], changed, left)
    # The response at all lines of the fit: its model of a reference of one.
    first = unknown._replace(numerator=unknown.numerator[:, : order + 1])
    curve = terms._replace(shared=powers).response(first)
    through = _power(influence * curve * response_near) / 2.0
    # Of the reference's power, a mean square of one at each line, that part is independent of all columns which are
    # not its own: with these alone the constant would scatter as that of a polynomial.
    scatter = np.linalg.inv(np.swapaxes(powers[:, 0], 1, 2) @ powers[:, 0])[:, 0, 0] / stretches
    spread = _power(influence)
    driven = np.where(drive > _NOTHING, drive, np.nan)[:, 0, 0]
    scale = size[:, 0, 0] / driven
    constant = unknown.numerator[:, 0]
    return _Solution(
        value=constant * scale,
        scale=scale,
        power=np.square(abs(constant)),
        spread=spread,
        left=_power(left),
        through=through * (scale / driven) ** 2,
        apart=np.minimum(scatter / np.maximum(spread, _NOTHING), 1.0),
        size=size[:, 0, 0],
        influence=influence / np.where(drive > _NOTHING, drive, np.inf),
        residual=left * size,
        curve=curve * response_near * (size / drive),
    )


def _first(lines: Lines, side: int, bins: int) -> Lines:
    """First bins that fits at some lines take in."""
    return np.asarray(np.clip(lines - side, 0, bins - 2 * side - 1))


class _Unknown(NamedTuple):
    """Coefficients at each line."""

    numerator: ComplexArray
    """Shape (lines, order + 1)."""
    denominator: ComplexArray
    """But for its constant, which is one; shape (lines, poles)."""
    transients: ComplexArray
    """Shape (lines, stretches, terms)."""

    def where(self, lines: NDArray[np.bool_], other: _Unknown) -> _Unknown:
        """Take those of another at some lines."""
        return _Unknown(
            *(
                np.where(lines.reshape(-1, *[1] * (mine.ndim - 1)), theirs, mine)
                for mine, theirs in zip(self, other, strict=True)
            )
        )


class _Terms(NamedTuple):
    """Columns that are known, at the lines around each line."""

    shared: ComplexArray | Array
    """Reference times powers of the distance, of one numerator for all stretches: shape (lines, stretches, width,
    order + 1)."""
    own: ComplexArray | Array
    """Of each stretch's transients: shape (lines, stretches or 1, width, terms)."""
    powers: Array
    """Of the denominator: shape (lines, 1, width, poles)."""

    def response(self, unknown: _Unknown) -> ComplexArray:
        """Quotient of the two polynomials; shape (lines, stretches or 1, width)."""
        return self._above(unknown.numerator) / self._below(unknown.denominator)

    def quotient(self, unknown: _Unknown) -> tuple[ComplexArray, ComplexArray]:
        """Model of the lines and its denominator."""
        below = self._below(unknown.denominator)
        transients = (self.own @ unknown.transients[..., None])[..., 0]
        return self._above(unknown.numerator) / below + transients / below, below

    def _above(self, numerator: ComplexArray) -> ComplexArray:
        return np.asarray((self.shared @ numerator[:, None, :, None])[..., 0])

    def _below(self, denominator: ComplexArray) -> ComplexArray:
        below = 1.0 + (self.powers @ denominator[:, None, :, None])[..., 0]
        # A pole on a line is no pole of a structure.
        return np.where(abs(below) > _FAINT, below, _FAINT)


def _solved(terms: _Terms, model: ComplexArray, right: ComplexArray) -> tuple[_Unknown, ComplexArray]:
    """Solve by least squares; and how much each equation's right side weighs in the first unknown.

    That is the numerator's constant: the response at the line itself, where the denominator is one.

    Transients are those of one stretch and of no other: each stretch is freed of its own (the projection onto what
    is at right angles to their columns), and what all share is solved for in what is left.

    Where lower orders do, denominator, numerator and transient have a factor in common, which could be anything: a
    faint wish for small coefficients settles it, and leaves the response at the line as it is.

    Parameters
    ----------
    model : ndarray of complex, shape (lines, stretches, width)
        What the denominator multiplies.
    right : ndarray of complex, shape (lines, stretches, width)
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


def _wishing(system: ComplexArray | Array) -> ComplexArray:
    """Add the equations of a faint wish for small unknowns."""
    unknowns = system.shape[-1]
    wish = np.broadcast_to(_FAINT * np.eye(unknowns), (*system.shape[:-2], unknowns, unknowns))
    return np.concatenate([system, wish], axis=-2)


def _power(each: ComplexArray) -> Array:
    return np.asarray(np.sum(abs(each) ** 2, axis=(1, 2)))


def _rms(each: ComplexArray) -> Array:
    return np.sqrt(np.mean(abs(each) ** 2, axis=(1, 2), keepdims=True))
