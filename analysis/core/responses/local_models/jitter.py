"""Effect of sampling jitter on the response to an impact: noise that is proportional to the slope of the signal."""

from collections.abc import Sequence

import numpy as np
import scipy

from analysis.core.responses.errors.systematic import JITTER
from analysis.core.responses.local_models.local_rational import ORDER
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.uncertainty import COVERAGE_FACTOR

# Order of a polynomial that is as flexible as the fitted ratio of two polynomials: the sum of their orders.
_FIT_ORDER = 2 * ORDER


def jitter_factor(
    rec: Recording, names: Sequence[str], impacts: Sequence[tuple[int, int]], size: int, half_width: int
) -> Array:
    """Compute the square-root factor of the covariance of jitter errors that resemble a response to an impact.

    A sample with a delay t has an error of t times the slope of its signal. Slopes are steepest during an impact and
    shortly after it. Errors of these samples are as smooth over the lines as the response, so the scatter does not show
    them. Each sample is weighted by its effect on a local fit to `half_width` bins on either side of a line. All
    channels have the same delay. `impacts`: first and last sample of each impact; `size`: samples of the Fourier
    transform. The result has the shape (rows, channels).
    """
    deviation_samples = (rec.scene.converter.jitter or 0.0) * rec.rate
    factor = np.zeros((0, len(names)))
    if not deviation_samples:
        return factor
    # A polynomial fit weights the samples: from the impact, weights fall to zero in this number of samples.
    n_samples = size * (_FIT_ORDER + 1) // (2 * half_width + 1)
    weights = scipy.signal.savgol_coeffs(2 * half_width + 1, _FIT_ORDER)
    cosines = np.cos(2.0 * np.pi / size * np.arange(n_samples)[:, None] * np.arange(-half_width, half_width + 1))
    sample_weights = cosines @ weights
    for begin, _ in impacts:
        readings = np.stack([rec.read(name, max(begin - 1, 0), begin + n_samples) for name in names])
        slopes = np.diff(readings, axis=1)
        slopes *= deviation_samples * sample_weights[: slopes.shape[1]]
        rows = np.concatenate([factor, slopes.T / np.sqrt(len(impacts))])
        factor = np.asarray(np.linalg.qr(rows, mode="r"))
    return factor


def jitter_limit(factor: Array, weights: ComplexArray, power: Array) -> dict[str, Array]:
    """Compute the maximum error of a response due to jitter during and shortly after the impacts.

    `weights`, shape (channels, lines): change of the response per unit change of each reading, for a reference of 1.
    `power`: power of the reference, summed over all impacts.

    >>> part = jitter_limit(np.array([[2.0, 1.0]]), np.array([[1.0], [-2.0]]) + 0j, np.ones(1))
    >>> {name: size.tolist() for name, size in part.items()}  # equal relative errors
    {'jitter of the sampling instants': [0.0]}
    """
    if not factor.any():
        return {}
    return {JITTER: COVERAGE_FACTOR * np.linalg.norm(factor @ weights, axis=0) / np.sqrt(np.maximum(power, 1e-300))}
