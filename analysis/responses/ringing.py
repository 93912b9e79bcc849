"""Residual free vibration of the previous step in the measurement window of a tone.

Noise in the windows may hide a transient that decays slowly and is close to the frequency of the tone. The transient
is therefore predicted from the response. Around each point, a quotient of two polynomials in frequency is fitted to
the response (Levy 1959); its poles are the poles of the neighbouring resonances.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial

from rig.arrays import Array, ComplexArray

# Number of points of a local fit with two poles, and with a single pole.
_POINTS, _FEWEST_POINTS = 7, 3
# A further pole is omitted if it explains less than this part of the response.
_LEAST_SHARE_EXPLAINED = 1e-3
# The spacing of points must be below this multiple of the distance to a pole to resolve it.
_FINE = 1.5
# A resonance at a distance of more half-widths than this beats with the tone, which is visible in the window itself.
_NEAR = 4.0
# A change below this number of standard errors, or below this part of the response, may be noise or rounding.
_NOISE_SIGMAS, _ROUNDING = 4.0, 1e-9
# The transition to the next tone takes this part of a window; the free vibration begins after it.
_TRANSITION_SHARE = 0.5


def ringing(value: ComplexArray, frequency: Array, waited: Array, lasted: Array, error: Array) -> Array:
    """Compute the largest deviation of each point of a response by residual free vibration of the previous step.

    The initial value of a free vibration at the pole s is the difference c of the pole's contributions to the two
    steady responses. It shifts the mean over a window of length L (`lasted`, s) by ``c exp(Re(s) t) |exp(l L) - 1| / |l
    L|`` after a wait t (`waited`, s), with l = s - i w. The points are in the order of measurement.

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
        explained = max(noise, _LEAST_SHARE_EXPLAINED * float(abs(value[near]).max()))
        pole, residue = _local_poles(value[near], omega[near], omega[k], explained)
        away = 1j * omega[k] - pole
        change = abs(residue) * abs(1.0 / away - 1.0 / (1j * omega[k - 1] - pole))
        least = max(noise, _ROUNDING * abs(value[k]))
        counts = (pole.real < 0.0) & (abs(away.imag) < _NEAR * abs(away.real)) & (change > least)
        counts &= abs(omega[k] - omega[k - 1]) < _FINE * abs(away)
        free = max(waited[k] - _TRANSITION_SHARE * lasted[k], 0.0)
        turns = -away[counts] * lasted[k]
        left = change[counts] * np.exp(pole[counts].real * free)
        rings[k] = np.sum(left * abs(np.expm1(turns) / turns))
    return rings


def _local_poles(
    value: ComplexArray, omega: Array, middle: float, least: float
) -> tuple[ComplexArray, ComplexArray]:
    """Estimate poles s, rad/s, and residues of a response near a point; it contains ``residue / (i w - s)``.

    The number of poles is the smallest for which the residual does not exceed `least`.
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
