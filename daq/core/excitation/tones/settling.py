"""Detection of the steady state of a tone, from amplitudes measured in successive windows of equal length.

An observation consists of the complex amplitudes of all quantities (force and displacements) in one window.
"""

import cmath
import math
import sys
from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import ComplexArray
from rig.core.numerics.jit import unfused_kernel

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
# Number of observations for which memory is allocated at once.
_NEW_ROWS = 3 * _NOISE_OBSERVATIONS
# Half of `_NOISE_OBSERVATIONS` is sufficient to accept scatter as noise if it is below this multiple of the tolerance:
# if such scatter is a small beat, the measurement averages it.
_SCATTER_FOR_HALF = 3.0
# Number of observations that must agree within the tolerance.
_N_AGREEING = 6
# Lower limits of divisors: sum of squared changes, and amplitude.
_MIN_POWER, _SMALLEST = 1e-280, sys.float_info.min


class TransientLaw(NamedTuple):
    """Geometric decay of the changes between successive observations of one quantity."""

    change: complex  # the last change
    largest: float  # the larger magnitude of the last two changes
    factor: complex  # decay factor: ratio of successive changes, by least squares
    coherent: bool  # whether the changes follow the law of decay


@unfused_kernel
def _transient_law(values: ComplexArray) -> TransientLaw:
    """Estimate the law from observations of one quantity."""
    first = max(0, values.size - _N_DIFFERENCES - 1)
    cross, power, later_power = 0.0j, 0.0, 0.0
    change = values[first + 1] - values[first]
    magnitude = largest = abs(change)
    for row in range(first + 2, values.size):
        next_change = values[row] - values[row - 1]
        next_magnitude = abs(next_change)
        cross += change.conjugate() * next_change
        power += magnitude**2
        later_power += next_magnitude**2
        change, magnitude, largest = next_change, next_magnitude, max(magnitude, next_magnitude)
    power, later_power = max(power, _MIN_POWER), max(later_power, _MIN_POWER)
    coherent = abs(cross) ** 2 / power / later_power > _MIN_COHERENCE
    return TransientLaw(change, largest, cross / power, coherent)


@unfused_kernel
def _mean(values: ComplexArray) -> complex:
    """Return the mean of observations of one quantity."""
    total = 0.0j
    for value in values:
        total += value
    return total / values.size


@unfused_kernel
def _final_amplitude(values: ComplexArray, law: TransientLaw) -> complex:
    """Return the predicted amplitude of a quantity in the steady state."""
    if not (law.coherent and abs(law.factor) < _MAX_EXTRAPOLATED_FACTOR):
        return _mean(values[-_NOISE_OBSERVATIONS // 2 :])
    deviation = 1.0 - law.factor
    if abs(deviation) < _MIN_FACTOR_DEVIATION:
        deviation = complex(_MIN_FACTOR_DEVIATION)
    return values[-1] + law.change * law.factor / deviation


@unfused_kernel
def _is_steady(values: ComplexArray, law: TransientLaw, tolerance: float) -> bool:
    """Return whether a quantity is steady in its latest observation."""
    # At least the smallest number, so that it can be a divisor.
    magnitude = max(abs(values[-1]), _SMALLEST)
    limit = tolerance * magnitude
    if law.coherent:
        # An upper estimate of the remaining change, which uses the larger of the last two changes.
        remaining = law.largest * abs(law.factor) / max(abs(1.0 - law.factor), _MIN_FACTOR_DEVIATION)
        return remaining < limit or _agree_within_tolerance(values, 0.01 * limit, 0.1 * limit)
    return (
        _agree_within_tolerance(values, limit, 0.1 * limit)
        or _is_noise(values, _NOISE_OBSERVATIONS // 2, _SCATTER_FOR_HALF * limit, limit)
        or _is_noise(values, _NOISE_OBSERVATIONS, np.inf, limit)
    )


@unfused_kernel
def _agree_within_tolerance(values: ComplexArray, max_spread: float, max_drift: float) -> bool:
    """Return whether the latest observations of a quantity agree within the tolerance, with a steady mean.

    This test is for beating modes, whose changes have no common decay factor. Changes that follow the law must agree
    within 1 % of the tolerance. In a transient with a time constant of up to thirty observations, the means of the two
    halves differ by at least 10 % of the remaining change; the limit of the drift follows from this. Both limits are in
    the unit of the quantity.
    """
    if values.size < _N_AGREEING:
        return False
    latest = values[-_N_AGREEING:]
    mean = _mean(latest)
    for value in latest:
        if not abs(value - mean) < max_spread:
            return False
    return abs(_mean(latest[_N_AGREEING // 2 :]) - _mean(latest[: _N_AGREEING // 2])) < max_drift


@unfused_kernel
def _scatter(values: ComplexArray, mean: complex) -> float:
    """Return the standard deviation of observations of one quantity."""
    total = 0.0
    for value in values:
        total += abs(value - mean) ** 2
    return math.sqrt(total / values.size)


@unfused_kernel
def _is_noise(values: ComplexArray, count: int, max_scatter: float, min_difference: float) -> bool:
    """Return whether the latest `count` observations of a quantity scatter like noise about a constant mean.

    Decaying beats scatter less in the second half. `max_scatter`: largest standard deviation; `min_difference`: the
    means of both halves may differ by this in any case; both in the unit of the quantity.
    """
    if values.size < count:
        return False
    half = count // 2
    before, after = values[-count:-half], values[-half:]
    mean_before, mean_after = _mean(before), _mean(after)
    scatter_before, scatter_after = _scatter(before, mean_before), _scatter(after, mean_after)
    error = math.hypot(scatter_before, scatter_after) / math.sqrt(half)
    return (
        abs(mean_after - mean_before) < max(2.0 * error, min_difference)
        and scatter_after > _MIN_SCATTER_RATIO * scatter_before
        and max(scatter_before, scatter_after) < max_scatter
    )


@unfused_kernel
def _evaluate(observations: ComplexArray, tolerance: float) -> tuple[bool, bool, complex, complex]:
    """Return whether all quantities are steady, and results for the first quantity.

    These are whether its changes follow the law, the decay factor, and the predicted final amplitude.
    """
    values = observations[:, 0]
    law = _transient_law(values)
    steady = _is_steady(values, law, tolerance)
    for number in range(1, observations.shape[1]):
        values = observations[:, number]
        steady = steady and _is_steady(values, _transient_law(values), tolerance)
    return steady, law.coherent, law.factor, _final_amplitude(observations[:, 0], law)


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
        # Latest observations since the restart, in order of time: the last of the stored rows.
        self._observations: ComplexArray = np.zeros((0, 0), dtype=complex)
        self._stored, self._stored_rows = self._observations, 0
        self.count = 0
        # Predicted final amplitudes of the first quantity.
        self._predictions: list[complex] = []
        # Decay factor of the first quantity's changes, and whether they follow the law.
        self._factor, self._is_coherent = 0.0j, False
        self._was_steady = False
        self.settled = False

    def restart(self) -> None:
        """Discard all observations: the drive has changed."""
        self.count = 0
        self._predictions.clear()
        self._is_coherent = False
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
        if self._stored_rows == len(self._stored):
            new_rows = np.empty((_NEW_ROWS, amplitudes.size), dtype=complex)
            self._stored_rows = len(self._observations)
            self._stored = np.concatenate([self._observations, new_rows]) if self._stored_rows else new_rows
        self._stored[self._stored_rows] = amplitudes
        self._stored_rows += 1
        self.count += 1
        latest = min(self.count, _NOISE_OBSERVATIONS)
        self._observations = self._stored[self._stored_rows - latest : self._stored_rows]
        if self.count < MIN_OBSERVATIONS or not amplitudes.size:
            # Without force control and motion channels there is no quantity.
            self._predictions.extend(amplitudes[:1])
            is_steady = self.count >= MIN_OBSERVATIONS
        else:
            is_steady, self._is_coherent, self._factor, prediction = _evaluate(self._observations, self.tolerance)
            self._predictions.append(prediction)
        # Two successive observations must be steady, because one observation may pass by chance at the turning point of
        # a beat.
        self.settled, self._was_steady = is_steady and self._was_steady, is_steady

    def predicted_final(self) -> complex:
        """Predicted amplitude of the first quantity in the steady state."""
        return self._predictions[-1]

    def prediction_change(self) -> float:
        """Relative range of `predicted_final` over the last three observations."""
        magnitudes = [float(abs(prediction)) for prediction in self._predictions[-3:]]
        return (max(magnitudes) - min(magnitudes)) / max(magnitudes[-1], _SMALLEST)

    def phase_change(self) -> float:
        """Phase change of the first quantity's transient between observations [rad].

        The result is infinite if no law was determined.
        """
        if not self._is_coherent:
            return math.inf
        return max(abs(cmath.phase(self._factor)), 1e-9)  # never 0, because it is a divisor

    def standard_error(self) -> float:
        """Relative standard uncertainty of `predicted_final`, from the scatter of the observations.

        0 with fewer than `_NOISE_OBSERVATIONS` observations.
        """
        if self.count < _NOISE_OBSERVATIONS:
            return 0.0
        latest = self._observations[-_NOISE_OBSERVATIONS // 2 :, 0]
        return float(np.std(latest)) / math.sqrt(latest.size) / max(float(abs(latest[-1])), _SMALLEST)
