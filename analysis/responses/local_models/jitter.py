"""Effect of sampling jitter on the response to a hit: noise that is proportional to the slope of the signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy

from analysis.responses.local_models.local_rational import ORDER
from analysis.responses.systematic import JITTER
from rig.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from daq.recording.recording import Recording


# Coverage factor, which a normal error exceeds with a probability below 5 %, one with two components below 2 %.
_COVERAGE = 2.0
# Order of a polynomial with the curvature of the fitted quotient: the sum of the orders of its two polynomials.
_FIT_ORDER = 2 * ORDER


def jitter_factor(rec: Recording, names: Sequence[str], hits: Sequence[tuple[int, int]], size: int, side: int) -> Array:
    """Factorize the covariance of jitter errors that resemble a response to a hit; shape (rows, channels).

    A sample with a delay t has an error of t times the slope of its signal. Slopes are steepest during a hit and
    shortly after it. The errors of these samples are as smooth over the lines as the response, so that the scatter does
    not show them. Each sample is weighted by its effect on a local fit to `side` lines on either side. All channels
    have the same delay. `hits`: first and last sample of each hit; `size`: samples of the Fourier transform.
    """
    deviation = (rec.scene.converter.jitter or 0.0) * rec.rate
    factor = np.zeros((0, len(names)))
    if not deviation:
        return factor
    # Weights of a polynomial fit to neighboring lines, from the hit to their first zero.
    n_samples = size * (_FIT_ORDER + 1) // (2 * side + 1)
    weights = scipy.signal.savgol_coeffs(2 * side + 1, _FIT_ORDER)
    cosines = np.cos(2.0 * np.pi / size * np.arange(n_samples)[:, None] * np.arange(-side, side + 1))
    sample_weights = cosines @ weights
    for begin, _ in hits:
        readings = np.stack([rec.read(name, max(begin - 1, 0), begin + n_samples) for name in names])
        slopes = np.diff(readings, axis=1)
        slopes *= deviation * sample_weights[: slopes.shape[1]]
        rows = np.concatenate([factor, slopes.T / np.sqrt(len(hits))])
        factor = np.asarray(np.linalg.qr(rows, mode="r"))
    return factor


def jitter_part(factor: Array, weights: ComplexArray, power: Array) -> dict[str, Array]:
    """Compute the largest deviation of a response by jitter during and shortly after the hits.

    `weights`, shape (channels, lines): change of the response per unit of each reading and of the reference. `power`:
    power of the reference, summed over all hits.

    >>> part = jitter_part(np.array([[2.0, 1.0]]), np.array([[1.0], [-2.0]]) + 0j, np.ones(1))
    >>> {name: size.tolist() for name, size in part.items()}  # equal relative errors
    {'jitter of the sampling instants': [0.0]}
    """
    if not factor.any():
        return {}
    return {JITTER: _COVERAGE * np.linalg.norm(factor @ weights, axis=0) / np.sqrt(np.maximum(power, 1e-300))}
