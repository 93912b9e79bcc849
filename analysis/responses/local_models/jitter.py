"""What jitter of the sampling instants does to the response to a hit: noise that is there only while the signal is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.responses.local_models.local_rational import ORDER
from analysis.responses.systematic import JITTER

if TYPE_CHECKING:
    from daq.recording.recording import Recording

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Of a normal error less than 5 % lie beyond so many standard deviations, of one with two components less than 2 %.
_AT_MOST = 2.0
# A quotient of two polynomials bends as a polynomial of the order of both does.
_BENDS = 2 * ORDER


def jitter_factor(
    rec: Recording, names: Sequence[str], hits: Sequence[tuple[int, int]], size: int, side: int
) -> Array:
    """Factor of the covariance of what jitter adds to a hit's spectra and passes for response, (rows, channels).

    A sample taken late by t is off by t times the slope of its signal. Slopes are steepest while a hit lasts and soon
    after it; what is off there is as smooth over the lines as the response is, so that no scatter shows it. As much
    counts of each sample as a fit lets through. All channels are sampled by one clock, and are late together.

    Parameters
    ----------
    names : sequence of str
        Channels.
    hits : sequence of (int, int)
        First and last sample of each; the covariance is their mean.
    size : int
        Samples that a spectrum is made of.
    side : int
        Lines to either side that a fit takes in.
    """
    deviation = (rec.scene.converter.jitter or 0.0) * rec.rate
    factor = np.zeros((0, len(names)))
    if not deviation:
        return factor
    # By the weights of a polynomial fitted to the lines nearby, from the hit to where they first end.
    reach = size * (_BENDS + 1) // (2 * side + 1)
    weights = scipy.signal.savgol_coeffs(2 * side + 1, _BENDS)
    turns = np.cos(2.0 * np.pi / size * np.arange(reach)[:, None] * np.arange(-side, side + 1))
    passed = turns @ weights
    for begin, _ in hits:
        readings = np.stack([rec.read(name, max(begin - 1, 0), begin + reach) for name in names])
        slopes = np.diff(readings, axis=1)
        slopes *= deviation * passed[: slopes.shape[1]]
        rows = np.concatenate([factor, slopes.T / np.sqrt(len(hits))])
        factor = np.asarray(np.linalg.qr(rows, mode="r"))
    return factor


def jitter_part(factor: Array, off: ComplexArray, power: Array) -> dict[str, Array]:
    """How far jitter while hits last, and soon after, can put a response off.

    Parameters
    ----------
    factor : ndarray, shape (rows, channels)
        As `jitter_factor` gives it.
    off : ndarray of complex, shape (channels, lines)
        ``u - H l`` of the weights u and l by which readings make response and reference.
    power : ndarray, shape (lines,)
        Of the reference, summed up over all hits.

    Examples
    --------
    >>> part = jitter_part(np.array([[2.0, 1.0]]), np.array([[1.0], [-2.0]]) + 0j, np.ones(1))
    >>> {name: size.tolist() for name, size in part.items()}  # what both read is off by the same
    {'jitter of the sampling instants': [0.0]}
    """
    if not factor.any():
        return {}
    return {JITTER: _AT_MOST * np.linalg.norm(factor @ off, axis=0) / np.sqrt(np.maximum(power, 1e-300))}
