"""Residual free vibration of the previous step in the window of a held tone.

Noise in the windows hides a transient that decays slowly and hardly beats with the tone. The response itself gives its
rate: around each point it is fitted by a quotient of two polynomials in frequency (Levy 1959), whose poles are those
of the resonances nearby.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Points of a local fit of up to two poles, and of one of a single pole.
_POINTS, _FEWEST_POINTS = 7, 3
# What a pole more would explain of less than this part of the response dies away as the rest does.
_ALIKE = 1e-3
# A pole nearer to a point than its step over this is lost between points.
_FINE = 1.5
# A resonance farther off than so many of its half-widths beats with the tone, which the window itself shows.
_NEAR = 4.0
# A change by less than so many standard errors, or than this part of the response, may be noise or rounding.
_NOISE_SIGMAS, _ROUNDING = 4.0, 1e-9
# The next tone is taken up over part of a window, and the motion rings freely after it.
_TAKEN_UP = 0.5


def ringing(value: ComplexArray, frequency: Array, waited: Array, lasted: Array, error: Array) -> Array:
    """Largest deviation of each point of a response by the residual free vibration of the previous step.

    A free vibration at the pole s begins as the difference c of the pole's shares in the two steady motions. It shifts
    the mean over a window of length L by ``c exp(Re(s) t) |exp(l L) - 1| / |l L|`` after a wait t, with l = s - i w.

    Parameters
    ----------
    value : ndarray of complex, shape (n,)
        Response at one point after the other, as measured.
    frequency : ndarray, shape (n,)
        Hz.
    waited, lasted : ndarray, shape (n,)
        From the end of the window before to the begin of each, and length of each; s.
    error : ndarray, shape (n,)
        Standard deviation of `value`.

    Returns
    -------
    ndarray, shape (n,)
        0 where the points lie too far apart to resolve a resonance, or none is near.

    Examples
    --------
    >>> frequency = np.linspace(18.5, 19.5, 25)
    >>> value = 1.0 / (2j * np.pi * frequency - (-1.0 + 2j * np.pi * 19.0))
    >>> rings = ringing(value, frequency, np.full(25, 5.0), np.full(25, 1.0), np.zeros(25))
    >>> float((rings / abs(value))[12].round(4))
    0.0018
    """
    rings = np.zeros(frequency.size)
    omega = 2.0 * np.pi * frequency
    points = _POINTS if frequency.size >= _POINTS else _FEWEST_POINTS
    if frequency.size < points or not np.diff(omega).all():
        return rings
    for k in range(1, frequency.size):
        first = min(max(k - points // 2, 0), frequency.size - points)
        near = slice(first, first + points)
        if not (np.isfinite(value[near]).all() and value[near].any()):
            continue
        noise = _NOISE_SIGMAS * float(np.nan_to_num(error[k]))
        explained = max(noise, _ALIKE * float(abs(value[near]).max()))
        pole, residue = _local_poles(value[near], omega[near], omega[k], explained)
        away = 1j * omega[k] - pole
        change = abs(residue) * abs(1.0 / away - 1.0 / (1j * omega[k - 1] - pole))
        least = max(noise, _ROUNDING * abs(value[k]))
        counts = (pole.real < 0.0) & (abs(away.imag) < _NEAR * abs(away.real)) & (change > least)
        counts &= abs(omega[k] - omega[k - 1]) < _FINE * abs(away)
        free = max(waited[k] - _TAKEN_UP * lasted[k], 0.0)
        turns = -away[counts] * lasted[k]
        left = change[counts] * np.exp(pole[counts].real * free)
        rings[k] = np.sum(left * abs(np.expm1(turns) / turns))
    return rings


def _local_poles(
    value: ComplexArray, omega: Array, middle: float, least: float
) -> tuple[ComplexArray, ComplexArray]:
    """Poles s, rad/s, and residues of a response near a point: it contains ``residue / (i w - s)``.

    There are as few poles as leave no more than `least` of it.
    """
    half, size = 0.5 * np.ptp(omega), float(abs(value).max())
    at, read = (omega - middle) / half, value / size
    roots, share = np.zeros((2, 0), dtype=complex)
    for poles in range(1, 1 + (len(value) - 1) // 3):
        powers = at[:, None] ** np.arange(poles + 1)
        terms = np.concatenate([powers, -read[:, None] * powers[:, 1:]], axis=1)
        found = np.linalg.lstsq(terms, read, rcond=None)[0]
        above, below = found[: poles + 1], np.append(1.0, found[poles + 1 :])
        roots = polynomial.polyroots(below)
        share = polynomial.polyval(roots, above) / polynomial.polyval(roots, polynomial.polyder(below))
        left = polynomial.polyval(at, above) - read * polynomial.polyval(at, below)
        if np.sqrt(np.mean(np.square(np.abs(left)))) * size <= least:
            break
    return np.asarray(1j * (middle + half * roots)), np.asarray(1j * half * size * share)
