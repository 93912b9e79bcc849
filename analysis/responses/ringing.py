"""What a resonance still rings of the step before, in the window of a held tone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Slopes to both sides that differ by less than this share of themselves tell the resonance near by, and points nearer
# to one another than this part of its distance.
_ALIKE, _FINE = 1.0, 0.6
# A resonance farther off than so many of its half-widths beats with the tone, which the window itself shows.
_NEAR = 4.0
# The next tone is taken up over part of a window, and the motion rings freely after it.
_TAKEN_UP = 0.5


def ringing(value: ComplexArray, frequency: Array, waited: Array, lasted: Array) -> Array:
    """How far each point of a response may be off for what rings on of the step before, at most.

    Near a pole s the response is as 1 / (i w - s), so that its logarithmic slope over w is -i / (i w - s): points
    beside one another tell how fast a transient dies away there, where noise hides it in the windows. It begins as
    the difference of the two steady motions, c, and shifts the mean over a window of length L by
    ``c exp(Re(s) t) |exp(l L) - 1| / |l L|`` after a wait t, with l = s - i w.

    Parameters
    ----------
    value : ndarray of complex, shape (n,)
        Response at one point after the other, as measured.
    frequency : ndarray, shape (n,)
        Hz.
    waited, lasted : ndarray, shape (n,)
        From the end of the window before to the begin of each, and length of each; s.

    Returns
    -------
    ndarray, shape (n,)
        0 where the points lie too far apart to tell, or no resonance is near.

    Examples
    --------
    >>> frequency = np.linspace(18.5, 19.5, 25)
    >>> value = 1.0 / (2j * np.pi * frequency - (-1.0 + 2j * np.pi * 19.0))
    >>> rings = ringing(value, frequency, np.full(25, 5.0), np.full(25, 1.0))
    >>> float((rings / abs(value))[12].round(4))
    0.0016
    """
    found = np.zeros(frequency.size)
    apart = 2.0 * np.pi * np.diff(frequency)
    if frequency.size < 3 or not apart.all() or not value.all():
        return found
    slopes = np.log(value[1:] / value[:-1]) / apart
    before, after = slopes[:-1], slopes[1:]
    inner = 0.5 * (before + after)
    slope = np.concatenate([[1.5 * before[0] - 0.5 * after[0]], inner, [1.5 * after[-1] - 0.5 * before[-1]]])
    unlike = abs(after - before) / np.maximum(abs(inner), 1e-300)
    rate = 1j / np.where(slope == 0.0, 1e-300, slope)
    told = np.concatenate([unlike[:1], unlike, unlike[-1:]]) < _ALIKE
    wide = np.maximum(np.append(abs(apart), 0.0), np.append(0.0, abs(apart)))
    told &= wide < _FINE * abs(rate)
    told &= (rate.real < 0.0) & (abs(rate.imag) < _NEAR * abs(rate.real))
    told[0] = False
    free = np.maximum(waited - _TAKEN_UP * lasted, 0.0)
    turns = (rate * lasted)[told]
    change = abs(np.diff(value, prepend=value[:1]))[told]
    found[told] = change * np.exp((rate.real * free)[told]) * abs(np.expm1(turns) / turns)
    return found
