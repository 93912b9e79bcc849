"""Local rational method: a response without leakage from the spectra of whole stretches of a recording.

Around every line the response is a quotient of two low polynomials, and what the two ends of a stretch add to its
spectrum (the transients, which are what leaks) is another one with the same denominator. All are fitted by least
squares to the lines nearby [1]_; no window smears the curve, nothing needs to have died away, and what the fit
leaves over gives the error bars.

What sensor, amplifier and coupling do to the reading is known and is not fitted: the response passes through it, and
the transients of its slow high-passes, which bend too much near zero frequency for low polynomials, are terms of
their own. Where noise hides what a denominator could tell, there is none. How far low polynomials miss the curve is
told by another fit with polynomials of one order more.

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
from numpy.typing import NDArray
from scipy import ndimage

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


def local_fit(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    lines: Lines,
    side: int,
    used: float = 1.0,
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
        _fits(reading, reference, ends, lines, side, used, order, poles)
        for order, poles in ((ORDER, 0), (ORDER, ORDER), (ORDER + 1, ORDER + 1))
    )
    best = _Fits(
        *(np.where(plain.criterion < rational.criterion, *each) for each in zip(plain, rational, strict=True))
    )
    # The variance of the difference is the difference of the variances, as the lower order is part of the higher.
    change, noise = abs(more.value - best.value) ** 2, 2.0 * np.maximum(more.variance - best.variance, 0.0)
    near = max(1, side // max(1, int(np.median(np.diff(lines)))) if lines.size > 1 else 1)
    around = ndimage.uniform_filter1d(change - noise, near, mode="nearest")
    # A peak of a line or two is missed there and nowhere else; noise changes a line by more than that in 5 % of lines.
    missed = np.sqrt(np.maximum(np.maximum(around, change - LARGEST * noise), 0.0))
    return LocalFit(
        best.value, best.variance, best.coherence, best.degrees, missed, best.through, best.apart, best.noise
    )


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


def _fits(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    lines: Lines,
    side: int,
    used: float,
    order: int,
    poles: int,
) -> _Fits:
    count = len(reference)
    begins = [s for s in range(count) if np.any(ends[s]) and not np.all(ends[s] == 1.0)]
    unknowns = order + 1 + poles + (count + len(begins)) * (order + 1 + len(reading.slow))
    equations = count * (2 * side + 1)
    step = max(1, _AT_ONCE // (equations * unknowns))
    parts = [
        _fit(reading, reference, ends, begins, lines[first : first + step], side, order, poles)
        for first in range(0, lines.size, step)
    ]
    found = _Solution(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    # Zeros in front of a stretch make neighbouring lines depend on each other: they count for less.
    free = max(used * equations - unknowns, 0.5)
    noise = found.left / free
    # Noise makes even a response that is none some size.
    told = np.maximum(found.power - noise * found.spread, 0.0) * found.apart * equations
    criterion = used * equations * np.log(np.maximum(found.left, _NOTHING)) + unknowns * np.log(
        2 * used * equations
    )
    return _Fits(
        value=found.value,
        variance=0.5 * noise * found.spread * found.scale**2,
        coherence=told / np.maximum(told + found.left, _NOTHING),
        degrees=np.full(lines.size, 2.0 * free),
        through=found.through,
        apart=found.apart,
        noise=noise * found.size**2,
        criterion=criterion,
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


def _fit(
    reading: Reading,
    reference: ComplexArray,
    ends: ComplexArray,
    begins: list[int],
    lines: Lines,
    side: int,
    order: int,
    poles: int,
) -> _Solution:
    stretches, width = len(reference), 2 * side + 1
    first = np.clip(lines - side, 0, reference.shape[1] - width)
    near = first[:, None] + np.arange(width)
    at = ((near - lines[:, None]) / side)[:, None, :]
    x, f, e = (np.moveaxis(each[:, near], 1, 0) for each in (reading.spectra, reference, ends))
    told_by = reading.response[near][:, None, :]
    f = f * told_by
    size, drive = (np.maximum(_rms(each), _NOTHING) for each in (x, f))
    x, f = x / size, f / drive
    columns = [f * at**k for k in range(order + 1)]
    transients = [at**k for k in range(order + 1)]
    transients += [(each := slow[near][:, None, :]) / _rms(each) for slow in reading.slow]
    for s in range(stretches):
        own = np.zeros((1, stretches, 1))
        own[0, s] = 1.0
        columns += [np.broadcast_to(own * each, x.shape) for each in transients]
        if s in begins:
            columns += [own * e * each for each in transients]
    above = np.stack(columns, axis=-1).reshape(lines.size, stretches * width, -1)
    # Without a denominator there are none.
    powers = np.empty((*above.shape[:2], poles))
    for k in range(poles):
        powers[..., k] = np.broadcast_to(at ** (k + 1), x.shape).reshape(above.shape[:2])
    right = x.reshape(lines.size, -1)
    # Multiplied by the denominator the problem is linear, but what is noise is weighted, too, and fitted by poles of
    # its own: a step of Gauss and Newton sets both right.
    unknown, influence = _solved(np.concatenate([above, -right[..., None] * powers], axis=2), right)
    left = right - _quotient(above, powers, unknown)[0]
    if poles:
        model, below = _quotient(above, powers, unknown)
        slope = np.concatenate([above, -model[..., None] * powers], axis=2) / below[..., None]
        change, influence = _solved(slope, left)
        changed = right - _quotient(above, powers, unknown + change)[0]
        better = _power(changed) < _power(left)
        unknown, left = unknown + change * better[:, None], np.where(better[:, None], changed, left)
    # The response at all lines of the fit: its model of a reference of one.
    ones = [np.broadcast_to(at**k, x.shape).reshape(right.shape) for k in range(order + 1)]
    curve = _quotient(
        np.stack(ones, axis=-1), powers, np.delete(unknown, np.s_[order + 1 : above.shape[2]], axis=1)
    )[0]
    through = _power(influence * curve * np.broadcast_to(told_by, x.shape).reshape(right.shape)) / 2.0
    # Of the reference's power, a mean square of one at each line, that part is independent of all columns which are
    # not its own: with these alone the constant would scatter as that of a polynomial.
    own = np.stack([at[:, 0] ** k for k in range(order + 1)], axis=-1)
    scatter = np.linalg.inv(np.swapaxes(own, 1, 2) @ own)[:, 0, 0] / stretches
    spread = _power(influence)
    driven = np.where(drive > _NOTHING, drive, np.nan)[:, 0, 0]
    scale = size[:, 0, 0] / driven
    return _Solution(
        value=unknown[:, 0] * scale,
        scale=scale,
        power=np.square(abs(unknown[:, 0])),
        spread=spread,
        left=_power(left),
        through=through * (scale / driven) ** 2,
        apart=np.minimum(scatter / np.maximum(spread, _NOTHING), 1.0),
        size=size[:, 0, 0],
    )


def _quotient(above: ComplexArray, powers: Array, unknown: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Model of the lines and its denominator."""
    count = above.shape[2]
    below = 1.0 + (powers @ unknown[:, count:, None])[..., 0]
    # A pole on a line is no pole of a structure.
    below = np.where(abs(below) > _FAINT, below, _FAINT)
    return (above @ unknown[:, :count, None])[..., 0] / below, below


def _solved(system: ComplexArray, right: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Solve by least squares; and how much each equation's right side weighs in the first unknown.

    That is the numerator's constant: the response at the line itself, where the denominator is one.

    Where lower orders do, denominator, numerator and transient have a factor in common, which could be anything: a
    faint wish for small coefficients settles it, and leaves the response at the line as it is.
    """
    lines, equations, unknowns = system.shape
    wish = np.broadcast_to(_FAINT * np.eye(unknowns), (lines, unknowns, unknowns))
    q, r = np.linalg.qr(np.concatenate([system, wish], axis=1))
    adjoint = np.conj(np.swapaxes(q[:, :equations], 1, 2))
    first = np.broadcast_to(np.eye(unknowns, 1), (lines, unknowns, 1))
    row: ComplexArray = np.swapaxes(np.linalg.solve(np.swapaxes(r, 1, 2), first), 1, 2)
    return np.linalg.solve(r, adjoint @ right[..., None])[..., 0], (row @ adjoint)[:, 0]


def _power(each: ComplexArray) -> Array:
    return np.sum(abs(each) ** 2, axis=1)


def _rms(each: ComplexArray) -> Array:
    return np.sqrt(np.mean(abs(each) ** 2, axis=(1, 2), keepdims=True))
