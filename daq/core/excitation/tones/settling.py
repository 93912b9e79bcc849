"""Detection of the steady state of a tone, from amplitudes measured in successive windows of equal length.

An observation consists of the complex amplitudes of all quantities (force and displacements) in one window.
"""

from __future__ import annotations

import math
import sys
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray

# The decay of the transient is estimated from this number of differences of successive observations.
_N_DIFFERENCES = 6
# Minimum number of observations for this estimate: two pairs of successive differences.
MIN_OBSERVATIONS = 4
# The decay factor is the ratio of successive changes. If it differs from 1 by less than this, it cannot be measured:
# the transient is longer than the observed time.
_MIN_FACTOR_DEVIATION = 1e-3
# The final amplitude is extrapolated if the magnitude of the decay factor is at most this.
_MAX_EXTRAPOLATED_FACTOR = 0.995
# If the coherence of successive changes is below this value, the changes are noise, not a decaying transient.
_MIN_COHERENCE = 0.8
# Noise is distinguished from decaying beats by comparing the scatter in both halves of this number of observations.
_NOISE_OBSERVATIONS = 24
# The observations are noise if the scatter in the second half exceeds this fraction of the scatter in the first half.
_MIN_SCATTER_RATIO = 0.75
# If the scatter is below this multiple of the tolerance, half of `_NOISE_OBSERVATIONS` is sufficient, because the
# measurement averages such small beats.
_SCATTER_FOR_HALF = 3.0
# Number of observations that must agree within the tolerance.
_N_AGREEING = 6
# Faster than `numpy.sum`, `numpy.mean` and `numpy.max` by a factor of two.
_SUM, _LARGEST = np.add.reduce, np.maximum.reduce


class TransientLaw(NamedTuple):
    """Geometric decay of the changes between successive observations, for each quantity."""

    changes: ComplexArray  # the last changes, (changes, quantities)
    magnitudes: Array  # their magnitudes
    factor: ComplexArray  # decay factor: ratio of successive changes, by least squares; (quantities,)
    coherent: NDArray[np.bool_]  # whether the changes follow the law of decay; (quantities,)

    @classmethod
    def of(cls, observations: ComplexArray) -> TransientLaw:
        """Estimate the law from observations, shape (observations, quantities)."""
        changes = observations[1:] - observations[:-1]
        magnitudes = np.abs(changes)
        cross, powers = _SUM(changes[:-1].conj() * changes[1:], axis=0), magnitudes**2
        power, later_power = (np.maximum(_SUM(part, axis=0), 1e-280) for part in (powers[:-1], powers[1:]))
        return cls(changes, magnitudes, cross / power, abs(cross) ** 2 / power / later_power > _MIN_COHERENCE)

    def remaining_change(self) -> ComplexArray:
        """Return the predicted change from the last observation to the steady state, shape (quantities,)."""
        deviation = 1.0 - self.factor
        limited = np.where(abs(deviation) < _MIN_FACTOR_DEVIATION, _MIN_FACTOR_DEVIATION, deviation)
        return self.changes[-1] * self.factor / limited

    def remaining_magnitude(self) -> Array:
        """Return an upper estimate of the magnitude of the remaining change, shape (quantities,).

        The estimate uses the larger of the last two changes.
        """
        change = np.maximum(self.magnitudes[-1], self.magnitudes[-2])
        return change * abs(self.factor) / np.maximum(abs(1.0 - self.factor), _MIN_FACTOR_DEVIATION)


class Settling:
    """Detector of the steady state.

    The free decay of a mode adds a transient to the amplitudes. Between successive observations the transient, and
    therefore also the change of the amplitude, is multiplied by the same complex factor rho. With rho estimated from
    the last changes, the remaining change is change * rho / (1 - rho). A comparison of two observations would not
    suffice: a 13 Hz mode with a damping ratio of 0.5 % changes by only 4 % of its remaining transient in 0.1 s.

    Changes that do not follow this law are noise. The amplitude then counts as steady when two halves of the
    latest observations agree within their scatter and the scatter does not decrease. `tolerance` is the permitted
    remaining relative change of any amplitude; `settled` states whether the latest observations are steady.

    >>> detector = Settling(1e-3)
    >>> for k in range(40):
    ...     detector.add(np.array([1.0 - 0.5 * 0.8**k + 0j]))
    ...     if detector.settled:
    ...         break
    >>> k, bool(0.5 * 0.8**k < 1e-3)
    (30, True)
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        # Latest observations since the restart, in order of time.
        self._observations: ComplexArray = np.zeros((0, 0), dtype=complex)
        self.count = 0
        # Predicted final amplitudes of the first quantity.
        self._predictions: list[complex] = []
        self._law: TransientLaw | None = None
        self._was_steady = False
        self.settled = False

    def restart(self) -> None:
        """Discard all observations: the drive has changed."""
        self.count = 0
        self._predictions.clear()
        self._law = None
        self._was_steady = self.settled = False

    @property
    def latest(self) -> complex:
        """Amplitude of the first quantity in the latest observation."""
        return self._observations[-1, 0]

    @property
    def is_rising(self) -> bool:
        """Whether the first quantity increased in the latest observation."""
        return self.count > 1 and bool(abs(self._observations[-1, 0]) > abs(self._observations[-2, 0]))

    def add(self, amplitudes: ComplexArray) -> None:
        """Add the next observation: complex amplitudes, shape (quantities,)."""
        stored = self._observations[len(self._observations) - min(self.count, _NOISE_OBSERVATIONS) :]
        self._observations = np.concatenate([stored, amplitudes[None]]) if self.count else amplitudes[None]
        self.count += 1
        if self.count < MIN_OBSERVATIONS:
            self._predictions.extend(amplitudes[:1])
            return
        self._law = TransientLaw.of(self._observations[-_N_DIFFERENCES - 1 :])
        self._predictions.extend(self._predict_final(self._law)[:1])
        # Two successive observations must be steady, because one observation may pass by chance at the turning point of
        # a beat.
        is_steady = self._is_steady(self._law)
        self.settled, self._was_steady = is_steady and self._was_steady, is_steady

    def predicted_final(self) -> complex:
        """Predicted amplitude of the first quantity in the steady state."""
        return self._predictions[-1]

    def prediction_change(self) -> float:
        """Relative range of `predicted_final` over the last three observations."""
        magnitudes = [float(abs(prediction)) for prediction in self._predictions[-3:]]
        return (max(magnitudes) - min(magnitudes)) / max(magnitudes[-1], sys.float_info.min)

    def phase_change(self) -> float:
        """Phase change of the first quantity's transient between observations, rad.

        The result is infinite if no law was determined.
        """
        if self._law is None or not self._law.coherent[0]:
            return np.inf
        return max(float(abs(np.angle(self._law.factor[0]))), 1e-9)  # never 0, because it is a divisor

    def standard_error(self) -> float:
        """Relative standard error of `predicted_final`, from the scatter of the observations.

        0 with fewer than `_NOISE_OBSERVATIONS` observations.
        """
        if self.count < _NOISE_OBSERVATIONS:
            return 0.0
        latest = self._observations[-_NOISE_OBSERVATIONS // 2 :, 0]
        variance = float(_SUM(abs(latest - _mean(latest)) ** 2)) / len(latest)
        return math.sqrt(variance / len(latest)) / max(float(abs(latest[-1])), sys.float_info.min)

    def _predict_final(self, law: TransientLaw) -> ComplexArray:
        """Return the predicted amplitudes in the steady state, shape (quantities,); see `predicted_final`."""
        # The prediction is that of the first quantity; without force control and motion channels, there are no
        # quantities.
        if all(law.coherent[:1]) and all(abs(law.factor[:1]) < _MAX_EXTRAPOLATED_FACTOR):
            return self._observations[-1] + law.remaining_change()
        return _mean(self._observations[-_NOISE_OBSERVATIONS // 2 :])

    def _is_steady(self, law: TransientLaw) -> bool:
        """Return whether all quantities are steady in the latest observation."""
        limit = self.tolerance * self._magnitude()
        steady = law.coherent & (law.remaining_magnitude() < limit)
        # The following tests take more computing time.
        if not all(steady) and self.count >= _N_AGREEING:
            steady |= self._agree_within_tolerance(law, limit)
        # Noise is tested when every quantity that follows the law is steady.
        if not all(steady) and self.count >= _NOISE_OBSERVATIONS // 2 and all(steady | ~law.coherent):
            noise = self._is_noise(_NOISE_OBSERVATIONS // 2, _SCATTER_FOR_HALF * self.tolerance)
            if self.count >= _NOISE_OBSERVATIONS:
                noise |= self._is_noise(_NOISE_OBSERVATIONS, np.inf)
            steady |= ~law.coherent & noise
        return all(steady)

    def _magnitude(self) -> Array:
        """Amplitudes of the latest observation, at least the smallest positive number, so that they can be divisors."""
        return np.maximum(abs(self._observations[-1]), sys.float_info.min)

    def _agree_within_tolerance(self, law: TransientLaw, limit: Array) -> NDArray[np.bool_]:
        """Return whether the latest observations agree within the tolerance, with a steady mean; (quantities,).

        This test is for beating modes, whose changes have no common decay factor. Changes that follow the law must
        agree within 1 % of the tolerance. In a transient with a time constant of up to thirty observations, the means
        of the two halves differ by at least 10 % of the remaining change; the limit of the drift follows from this.
        `limit`: tolerance in the unit of each quantity.
        """
        latest = self._observations[-_N_AGREEING:]
        spread = _LARGEST(abs(latest - _mean(latest)), axis=0)
        agrees: NDArray[np.bool_] = spread < np.where(law.coherent, 0.01 * limit, limit)
        if any(agrees):
            drift = abs(_mean(latest[_N_AGREEING // 2 :]) - _mean(latest[: _N_AGREEING // 2]))
            agrees &= drift < 0.1 * limit
        return agrees

    def _is_noise(self, count: int, max_scatter: float) -> NDArray[np.bool_]:
        """Return whether the latest `count` observations scatter like noise about a constant mean; (quantities,).

        Decaying beats scatter less in the second half. `max_scatter`: largest standard deviation, relative to the
        amplitude.
        """
        half = count // 2
        halves = self._observations[-count:-half], self._observations[-half:]
        means = [_mean(part) for part in halves]
        scatter_before, scatter_after = (
            np.sqrt(_SUM(abs(part - mean) ** 2, axis=0) / half) for part, mean in zip(halves, means, strict=True)
        )
        error, magnitude = np.hypot(scatter_before, scatter_after) / np.sqrt(half), self._magnitude()
        agree = abs(means[1] - means[0]) < np.maximum(2.0 * error, self.tolerance * magnitude)
        return (
            agree
            & (scatter_after > _MIN_SCATTER_RATIO * scatter_before)
            & (np.maximum(scatter_before, scatter_after) < max_scatter * magnitude)
        )


def _mean(observations: ComplexArray) -> ComplexArray:
    mean: ComplexArray = _SUM(observations, axis=0) / len(observations)
    return mean
