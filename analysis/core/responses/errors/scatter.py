"""Scatter of a mean of several channels, as a square-root factor of its covariance.

With weights w and the covariance C, a variance ``w C w*`` may be negative due to rounding if C is singular, as with
four channels and two averages. Computed from the factor, it is a sum of squares. Variances with few
degrees of freedom may be close to zero by chance. The variances are moderated by the variances of neighboring lines, as
empirical Bayes estimates [1]_.

References
----------
.. [1] G. K. Smyth, Linear models and empirical Bayes methods for assessing differential expression in microarray
   experiments, Statistical Applications in Genetics and Molecular Biology 3 (2004), article 3.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from rig.core.base.arrays import Array, ComplexArray

# Ratios of variances are limited to this value, because a variance may be zero.
_MAX_RATIO = 1e30
# Number of iterations within which Newton's method for the inverse of the trigamma function converges from below.
_ITERATIONS = 20


@dataclass(frozen=True)
class Scatter:
    """Random deviation of the channels' means at each line."""

    # factor S (rows, channels, lines), complex: channels i and j have the covariance sum of ``S_i conj(S_j)``
    rows: ComplexArray
    degrees_of_freedom: Array  # two for each complex average beyond the first; shape (lines,)

    def variance(self, weights: ComplexArray) -> Array:
        """Compute the variance of a weighted sum of the channels; weights of shape (channels, lines).

        >>> scatter = Scatter(np.array([[[3.0], [4.0]]]) + 0j, np.array([2.0]))
        >>> scatter.variance(np.array([[4.0], [-3.0]]) + 0j).tolist()
        [0.0]
        """
        return np.asarray(np.sum(np.square(np.abs(np.einsum("in,rin->rn", weights, self.rows))), axis=0))

    def local_variance(self, weights: ComplexArray, half_width: int) -> Array:
        """Average the variances over `half_width` lines on either side, with the weights of the central line."""
        last = self.degrees_of_freedom.size - 1
        total = np.zeros(last + 1)
        for step in range(-half_width, half_width + 1):
            lines = np.clip(np.arange(last + 1) + step, 0, last)
            total += Scatter(self.rows[:, :, lines], self.degrees_of_freedom).variance(weights)
        return total / (2 * half_width + 1)


def stacked(parts: list[ComplexArray]) -> ComplexArray:
    """Join the factors S of single lines, each of shape (rows, channels), padded with rows of zeros.

    >>> stacked([np.ones((1, 2)) + 0j, np.ones((3, 2)) + 0j]).shape
    (3, 2, 2)
    """
    n_rows = max(len(part) for part in parts)
    return np.stack([np.pad(part, ((0, n_rows - len(part)), (0, 0))) for part in parts], axis=2)


def moderate(variance: Array, degrees_of_freedom: Array, expected: Array, half_width: int) -> tuple[Array, Array]:
    """Moderate variances by the variances of `half_width` lines on either side; also return their degrees of freedom.

    `expected`: variances up to a common factor, such as local means. The logarithms of ``variance / expected`` scatter
    between lines because of the finite degrees of freedom and because the true ratios differ. The more similar the
    true ratios, the greater the weight of neighboring lines. All arrays have the shape (lines,).

    >>> random = np.random.default_rng(1)
    >>> variance = random.chisquare(2.0, 400) / 2.0
    >>> moderated, freedom = moderate(variance, np.full(400, 2.0), np.ones(400), 12)
    >>> f"smallest: {variance.min():.3f} and {moderated.min():.2f}, {freedom[0]:.0f} degrees of freedom"
    'smallest: 0.007 and 0.52, 50 degrees of freedom'
    """
    if variance.size < 2 or not (np.isfinite(variance).all() and np.all(expected > 0.0)):
        return variance, degrees_of_freedom
    half_degrees, width = degrees_of_freedom / 2.0, min(2 * half_width + 1, variance.size)
    logarithm = np.log(np.clip(variance / expected, 1.0 / _MAX_RATIO, _MAX_RATIO))
    logarithm += np.log(half_degrees) - scipy.special.digamma(half_degrees)
    local_mean = scipy.ndimage.uniform_filter1d(logarithm, 2 * half_width + 1, mode="nearest")
    observed_scatter = float(np.mean(np.square(logarithm - local_mean)) * width / (width - 1.0))
    # The finite degrees of freedom cause this scatter. The remaining scatter is due to different true ratios.
    chance_scatter = float(np.mean(scipy.special.polygamma(1, half_degrees)))
    max_prior_degrees = (width - 1.0) * degrees_of_freedom
    prior_degrees = (
        max_prior_degrees
        if observed_scatter <= chance_scatter
        else np.minimum(2.0 * _inverse_trigamma(observed_scatter - chance_scatter), max_prior_degrees)
    )
    total_degrees = prior_degrees + degrees_of_freedom
    moderated = (prior_degrees * expected * np.exp(local_mean) + degrees_of_freedom * variance) / total_degrees
    return np.asarray(moderated), np.asarray(total_degrees)


def _inverse_trigamma(value: float) -> float:
    """Solve ``trigamma(x) = value`` by Newton's method for its reciprocal, which is convex [1]_."""
    x = 0.5 + 1.0 / value
    for _ in range(_ITERATIONS):
        trigamma = float(scipy.special.polygamma(1, x))
        x += trigamma * (1.0 - trigamma / value) / float(scipy.special.polygamma(2, x))
    return x
