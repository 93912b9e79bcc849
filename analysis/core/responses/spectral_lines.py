"""Averages of a periodic test: the mean amplitude of every channel at every line, with its uncertainty.

A *line* is a frequency of the excitation. The measurement of a line consists of *parts*, such as the periods of a
multisine. The *scatter* of their amplitudes determines the uncertainty of the mean.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.responses.errors.budget import Quotient
from analysis.core.responses.errors.random_errors import MeanErrors, SharedErrors
from analysis.core.responses.errors.ringing import hidden_transient, poles_near_lines, ringing
from analysis.core.responses.errors.scatter import Scatter, moderate
from analysis.core.responses.errors.systematic import RESOLUTION, UNSETTLED
from analysis.core.responses.measurands import Measurand, reject_zero_reference
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response
from rig.core.results.uncertainty import circle_factor

# Transients are assumed to decay equally at this number of neighboring lines.
_COMMON_DECAY_LINES = 5
# Two parts do not determine the decay of a transient; this decay factor from part to part is then assumed.
_ASSUMED_DECAY = 0.5
# Largest decay factor from part to part: slower decay cannot be distinguished from a steady amplitude.
_MAX_DECAY = 0.99
# Probability that noise in the reference is below the assumed largest noise.
_REFERENCE_CONFIDENCE = 0.999
# The noise of the parts is estimated from their differences if there are at least this number of lines.
_MIN_LINES = 8
# Width of the median filter that smooths the noise of the parts, in lines.
_MEDIAN_LINES = 31
# Number of successive parts into which many are averaged, to estimate the decay of a transient.
_AVERAGED_PARTS = 4
# Residual transients are multiplied by this factor, because their estimates have an error of up to 5 %.
_TRANSIENT_FACTOR = 1.05


@dataclass(frozen=True)
class Lines:
    """Amplitudes of the recorded channels at the frequencies of a periodic excitation."""

    # names, in the order of the rows; with several inputs, the rows of each input follow one another
    channels: tuple[str, ...]
    frequency: Array  # Hz, in the order measured; shape (n,)
    # complex amplitude as recorded, (channels, n); of several inputs, due to each alone, (inputs channels, n)
    mean: ComplexArray
    scatter: Scatter  # random deviation of the mean
    label: str = ""  # for legends
    warnings: tuple[str, ...] = field(default=())  # in full sentences
    # maximum error of each mean due to residual transients; shape (channels, n)
    residual_transient: Array | None = None
    # flags of lines at which steady state was not reached; shape (n,). None for a multisine
    unsteady: NDArray[np.bool_] | None = None
    # frequencies of discarded measurements [Hz]
    omitted: Array = field(default_factory=lambda: np.empty(0))
    # number of lines on either side that moderate the noise of each line, for lines with few averages
    n_neighbors: int = 0
    noise: Scatter | None = None  # contribution of noise alone to `scatter`; None: all scatter is noise
    # number of averaged measurements, rotated by the phase of the reference, whose noise is aligned, too
    n_rotated: int = 1
    # maximum error of each mean due to rounding to counts; shape (channels, n)
    resolution: Array | None = None
    # waits before the windows, and lengths of the windows of successive tones [s], each of shape (n,)
    timing: tuple[Array, Array] | None = None
    accepted_transient: float = 0.0  # largest relative transient of feedback at the start of a window
    inputs: tuple[str, ...] = ()  # channels of several inputs, in the order of the rows

    def frf(
        self, rec: Recording, numerator: Measurand, denominator: Measurand, others: Sequence[Measurand] = ()
    ) -> Response:
        """Divide the mean of the response by the mean of the reference; propagate their covariance to first order.

        `others`: other inputs.
        """
        quotient = Quotient(rec, numerator, denominator, others, self.frequency)
        names, response_weights, reference_weights = (
            quotient.names,
            quotient.response_weights,
            quotient.reference_weights,
        )
        mean, scatter, noise, residual_transient, resolution = self._rows_of(names, denominator)
        x, f = np.sum(response_weights * mean, axis=0), np.sum(reference_weights * mean, axis=0)
        reject_zero_reference(rec, denominator, f)
        value = x / f
        # d(x/f) = (dx - value df) / f, and both are sums over the same channels.
        change = quotient.change_per_reading(value)
        explained, variances = [abs(x) ** 2], []
        for other in others:
            other_mean, other_scatter, *_ = self._rows_of(names, other)
            other_weights = other.row(rec, names, self.frequency)
            other_x, other_f = (np.sum(row * other_mean, axis=0) for row in (response_weights, other_weights))
            change = change - other_x / other_f * other_weights
            explained.append(abs(other_x) ** 2)
            variances.append(other_scatter)
        weights = change / f
        variance, degrees_of_freedom = scatter.variance(weights), scatter.degrees_of_freedom
        if self.n_neighbors:
            expected = noise.local_variance(weights, self.n_neighbors)
            variance, degrees_of_freedom = moderate(variance, degrees_of_freedom, expected, self.n_neighbors)
        error = np.sqrt(variance / 2.0)
        limits: dict[str, Array] = {}
        reference_limits = [self._reference_noise(reference_weights, noise) / abs(f)]
        # Residual transients and rounding add up in the worst case.
        unsettled = None if residual_transient is None else _TRANSIENT_FACTOR * residual_transient
        for name, limit in ((RESOLUTION, resolution), (UNSETTLED, unsettled)):
            if limit is not None:
                limits[name] = np.sum(abs(weights) * limit, axis=0)
                reference_limits.append(np.sum(abs(reference_weights / f) * limit, axis=0))
        if self.timing is not None:
            near = poles_near_lines(value, self.frequency, error)
            free_vibration = ringing(value, self.frequency, near, *self.timing)
            limits[UNSETTLED] = np.maximum(limits.get(UNSETTLED, 0.0), free_vibration)
            if self.accepted_transient:
                limits[UNSETTLED] += hidden_transient(
                    value, self.frequency, near, self.timing[1], error, self.accepted_transient
                )
        with np.errstate(invalid="ignore", divide="ignore"):
            averages = 1.0 + scatter.degrees_of_freedom / 2.0
            unexplained = variance / abs(value) ** 2
            if others:
                unexplained = sum(each.variance(change) for each in (scatter, *variances)) / sum(explained)
            coherence = 1.0 / (1.0 + averages * unexplained)
        return quotient.response(
            quotient.contributions(value, mean / f), error, degrees_of_freedom, limits, reference_limits,
            SharedErrors.of(MeanErrors(self.scatter.rows, np.einsum("cn,rcn->nr", weights, scatter.rows))),
            coherence=coherence, label=self.label, warnings=self.warnings, unsteady=self.unsteady,
            amplitude=None if self.unsteady is None else abs(f), omitted=self.omitted,
        )  # fmt: skip

    def _rows_of(
        self, names: Sequence[str], reference: Measurand
    ) -> tuple[ComplexArray, Scatter, Scatter, Array | None, Array | None]:
        """Return mean, scatter, noise, residual transient and resolution of channels, due to one reference."""
        first = self.inputs.index(reference.channels[0]) * len(self.channels) if self.inputs else 0
        rows = [first + self.channels.index(name) for name in names]
        scatter, noise = (
            Scatter(each.rows[:, rows], each.degrees_of_freedom)
            for each in (self.scatter, self.scatter if self.noise is None else self.noise)
        )
        transient, resolution = (
            None if limit is None else limit[rows] for limit in (self.residual_transient, self.resolution)
        )
        return self.mean[rows], scatter, noise, transient, resolution

    def _reference_noise(self, reference_weights: ComplexArray, noise: Scatter) -> Array:
        """Compute the largest amplitude of noise in the reference at each line; shape (n,).

        Lines with a smaller reference are excluded as not excited, because noise exceeds this amplitude only at one
        line in a thousand. `noise` is the scatter of the periods, because realizations that are rotated by the phase of
        their own reference scatter only in amplitude.
        """
        variance = np.nan_to_num(noise.local_variance(reference_weights, self.n_neighbors))
        degrees_of_freedom = noise.degrees_of_freedom * (2 * self.n_neighbors + 1)
        return np.asarray(
            np.sqrt(self.n_rotated * variance / 2.0) * circle_factor(_REFERENCE_CONFIDENCE, degrees_of_freedom)
        )


def _noise_of_changes(changes: ComplexArray) -> Array:
    """Estimate the noise power in the `changes` between parts of a test, summed over the changes; (channels, lines)."""
    # Noise differs from line to line, while transients are smooth; the median excludes transients of single modes.
    count, _, lines = changes.shape
    if lines < _MIN_LINES:
        return np.zeros(changes.shape[1:])
    # Second differences of noise have six times its power. Last divisor: median over mean of a gamma distribution.
    power = np.sum(abs(np.diff(changes, 2, axis=2)) ** 2, axis=0) / 6.0 / (1.0 - 1.0 / (3.0 * count))
    median_power = scipy.ndimage.median_filter(power, (1, min(_MEDIAN_LINES, lines - 2)), mode="nearest")
    return np.pad(median_power, ((0, 0), (1, 1)), mode="edge")


def _sum_of_neighbors(values: NDArray[Any]) -> NDArray[Any]:
    """Sum values, shape (rows, lines), over `_COMMON_DECAY_LINES` lines around each line."""
    half_width = _COMMON_DECAY_LINES // 2
    padded = np.pad(values, ((0, 0), (half_width, half_width)))
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, _COMMON_DECAY_LINES, axis=1).sum(axis=-1))


def residual_transient(successive: ComplexArray) -> Array:
    """Estimate the maximum error of a mean amplitude due to a decaying transient, shape (channels, lines).

    `successive`: amplitudes of successive parts of the test, shape (parts, channels, lines). From part to part, a
    transient is multiplied by a constant complex factor r. With the initial value c it shifts the mean of P parts by
    ``c (1 - r^P) / (P (1 - r))``. The change from part k to the next is ``c r^k (r - 1)``, from which r and c are
    estimated. Many parts are first averaged to a few, because noise would otherwise hide r.

    >>> amplitudes = 1.0 + 0.1 * 0.8 ** np.arange(5.0)[:, None, None] + 0j
    >>> float(round(residual_transient(amplitudes)[0, 0] / (abs(amplitudes.mean()) - 1.0), 6))
    1.0
    """
    if len(successive) >= 2 * _AVERAGED_PARTS:
        successive = np.stack([part.mean(axis=0) for part in np.array_split(successive, _AVERAGED_PARTS)])
    count = len(successive)
    changes = np.diff(successive, axis=0)
    decay_factor = np.full(successive.shape[1:], _ASSUMED_DECAY, dtype=complex)
    if count > 2:
        power = _sum_of_neighbors(np.sum(abs(changes[:-1]) ** 2, axis=0))
        product = _sum_of_neighbors(np.sum(changes[:-1].conj() * changes[1:], axis=0))
        decay_factor = product / np.maximum(power, 1e-300)
        decay_factor *= np.minimum(1.0, _MAX_DECAY / np.maximum(abs(decay_factor), 1e-300))
    decay_power = np.sum([abs(decay_factor) ** (2 * k) for k in range(count - 1)], axis=0)
    power = np.maximum(np.sum(abs(changes) ** 2, axis=0) - _noise_of_changes(changes), 0.0)
    initial = np.sqrt(power / decay_power) / abs(1.0 - decay_factor)
    return np.asarray(initial * abs(1.0 - decay_factor**count) / (count * abs(1.0 - decay_factor)))
