"""Error of a stepped-sine response due to *ringing*: residual free vibration of the previous dwell.

A *window* is the interval in which the amplitude of a tone is measured. Noise may hide a slowly decaying transient in
the window, especially if its frequency is close to that of the tone. The transient is therefore predicted from the
response. Around each point, a ratio of two polynomials in frequency is fitted to the response (E. C. Levy, IRE
Transactions on Automatic Control 4 (1959) 37-43); the poles of this ratio are the poles of the neighboring resonances.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.polynomial import polynomial

from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import COVERAGE_FACTOR

# Number of points of a local fit with two poles: more than its unknowns, and few enough to stay near the resonance.
_POINTS_TWO_POLES = 7
# Number of points of a local fit with a single pole: the minimum.
_POINTS_ONE_POLE = 3
# A fit needs a second pole if the residual with one pole is at least this fraction of the response.
_MIN_RESIDUAL_RATIO = 1e-3
# Points resolve a pole if their spacing is at most this multiple of the distance of the point from the pole.
_MAX_SPACING_RATIO = 1.5
# A resonance is considered if its distance from the tone is at most this value, in half-widths of the resonance.
# Ringing of a more distant resonance beats with the tone, which is visible in the window.
_MAX_HALF_WIDTHS = 4.0
# A change of a response between points may be noise up to this number of standard uncertainties.
_NOISE_SIGMAS = 4.0
# A change may be numerical rounding up to this fraction of the response.
_ROUNDING_RATIO = 1e-9
# The transition to the next tone lasts this fraction of the window; the ringing begins after it.
_TRANSITION_RATIO = 0.5


class LinePoles(NamedTuple):
    """A line of a response with poles near it."""

    line: int
    poles: ComplexArray  # rad/s, (poles,)
    residues: ComplexArray  # (poles,)
    noise: float  # error of the fit


def ringing(value: ComplexArray, frequency: Array, near: Iterable[LinePoles], wait_s: Array, window_s: Array) -> Array:
    """Compute the maximum error of each point of a response due to ringing.

    The initial amplitude c of the free vibration at a pole s is the difference of the pole's contributions to the two
    steady responses. After a wait t (`wait_s`) this vibration shifts the mean over a window of length L (`window_s`) by
    ``c exp(Re(s) t) |exp(l L) - 1| / |l L|``, with l = s - i w. The points are in the order of measurement. `near`:
    result of `poles_near_lines`. All arrays have the shape (points,).

    >>> frequency = np.linspace(18.5, 19.5, 25)
    >>> value = 1.0 / (2j * np.pi * frequency - (-1.0 + 2j * np.pi * 19.0))
    >>> near = poles_near_lines(value, frequency, np.zeros(25))
    >>> rings = ringing(value, frequency, near, np.full(25, 5.0), np.full(25, 1.0))
    >>> float((rings / abs(value))[12].round(4))
    0.0018
    """
    deviation, omega = np.zeros(frequency.size), 2.0 * np.pi * frequency
    for k, pole, residue, noise in near:
        distance = 1j * omega[k] - pole
        change = abs(residue) * abs(1.0 / distance - 1.0 / (1j * omega[k - 1] - pole))
        is_significant = change > max(noise, _ROUNDING_RATIO * abs(value[k]))
        relevant = is_significant & (k > 0)
        wait = max(wait_s[k] - _TRANSITION_RATIO * window_s[k], 0.0)
        exponent = -distance[relevant] * window_s[k]
        amplitude = change[relevant] * np.exp(pole[relevant].real * wait)
        deviation[k] = np.sum(amplitude * abs(np.expm1(exponent) / exponent))
    return deviation


def hidden_transient(
    value: ComplexArray, frequency: Array, near: Iterable[LinePoles], window_s: Array, error: Array, accepted: float
) -> Array:
    """Compute the largest error of each point of a response due to a transient that noise hides.

    A transient ``c exp(l t)`` shifts the mean over the window by c m, where m is the mean of the exponential. Noise in
    the window limits the standard uncertainty of c, by least squares, to `error` / s, where s is the standard deviation
    of the exponential. `error`: standard uncertainty of each point; `accepted`: largest relative transient after the
    wait; other arguments as in `ringing`.

    >>> frequency = np.linspace(18.5, 19.5, 25)
    >>> value = 1.0 / (2j * np.pi * frequency - (-1.0 + 2j * np.pi * 19.0))
    >>> near = poles_near_lines(value, frequency, np.full(25, 1e-5))
    >>> hidden = hidden_transient(value, frequency, near, np.ones(25), np.full(25, 1e-5), 1e-3)
    >>> [round(float(error), 6) for error in hidden[[0, 12]]]
    [2e-05, 7e-05]
    """
    hidden, omega = COVERAGE_FACTOR * error, 2.0 * np.pi * frequency
    for k, pole, *_ in near:
        exponent = (pole - 1j * omega[k]) * window_s[k]
        mean = abs(np.expm1(exponent) / exponent)
        mean_square = np.expm1(2.0 * exponent.real) / (2.0 * exponent.real)
        variance = np.maximum(mean_square - mean**2, _ROUNDING_RATIO * mean_square)
        hidden[k] *= np.max(mean / np.sqrt(variance), initial=1.0)
    return np.fmin(hidden, accepted * abs(value))


def poles_near_lines(value: ComplexArray, frequency: Array, error: Array) -> list[LinePoles]:
    """Fit the poles near each line of a response; `error`: standard uncertainty of each point.

    Only lines with poles near them are returned. All arrays have the shape (points,), in the order of measurement.
    """
    omega, near = 2.0 * np.pi * frequency, list[LinePoles]()
    n_points = _POINTS_TWO_POLES if omega.size >= _POINTS_TWO_POLES else _POINTS_ONE_POLE
    if omega.size < n_points or not np.diff(omega).all():
        return near
    for k in range(omega.size):
        first = min(max(k - n_points // 2, 0), omega.size - n_points)
        neighborhood = slice(first, first + n_points)
        if not (np.isfinite(value[neighborhood]).all() and value[neighborhood].any()):
            continue
        noise = _NOISE_SIGMAS * float(np.nan_to_num(error[k]))
        max_residual = max(noise, _MIN_RESIDUAL_RATIO * float(abs(value[neighborhood]).max()))
        pole, residue = _local_poles(value[neighborhood], omega[neighborhood], omega[k], max_residual)
        distance = 1j * omega[k] - pole
        is_near = abs(distance.imag) < _MAX_HALF_WIDTHS * abs(distance.real)
        is_resolved = abs(omega[k] - omega[max(k - 1, 0)]) < _MAX_SPACING_RATIO * abs(distance)
        relevant = (pole.real < 0.0) & is_near & is_resolved
        if relevant.any():
            near.append(LinePoles(k, pole[relevant], residue[relevant], noise))
    return near


def _local_poles(
    value: ComplexArray, omega: Array, center: float, max_residual: float
) -> tuple[ComplexArray, ComplexArray]:
    """Estimate the fewest poles s [rad/s] and residues of ``residue / (i w - s)`` that leave at most `max_residual`."""
    # Frequency offset and response, normalized to 1.
    half_range, scale = 0.5 * np.ptp(omega), float(abs(value).max())
    offset, normalized = (omega - center) / half_range, value / scale
    roots, residues = np.zeros((2, 0), dtype=complex)
    for poles in range(1, 1 + (len(value) - 1) // 3):
        powers = offset[:, None] ** np.arange(poles + 1)
        terms = np.concatenate([powers, -normalized[:, None] * powers[:, 1:]], axis=1)
        coefficients = np.linalg.lstsq(terms, normalized, rcond=None)[0]
        numerator, denominator = coefficients[: poles + 1], np.append(1.0, coefficients[poles + 1 :])
        roots = polynomial.polyroots(denominator)
        residues = polynomial.polyval(roots, numerator) / polynomial.polyval(roots, polynomial.polyder(denominator))
        residual = polynomial.polyval(offset, numerator) - normalized * polynomial.polyval(offset, denominator)
        if np.sqrt(np.mean(np.square(np.abs(residual)))) * scale <= max_residual:
            break
    return np.asarray(1j * (center + half_range * roots)), np.asarray(1j * half_range * scale * residues)
