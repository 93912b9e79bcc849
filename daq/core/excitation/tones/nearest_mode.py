"""Identification of the mode nearest to a swept tone: one mode and a residual term, updated along the sweep."""

from cmath import exp
from collections import deque

import numpy as np

from rig.core.base.arrays import Array, ComplexArray

# Minimum number of observations for the estimate of a mode, which has four unknowns.
_MIN_OBSERVATIONS = 6
# Observations older than this multiple of the memory (time constant of their weights) are discarded: their weights are
# below exp(-3) = 5 %.
_MAX_AGE_RATIO = 3.0
# Observations between two searches for a different mode, which take most of the time.
_SEARCH_INTERVAL = 4
# Frequencies of the search for a different mode, relative to the tone.
_SEARCH_FREQUENCIES = np.geomspace(0.6, 1.7, 24)
# Damping ratios of the search for a different mode.
_SEARCH_DAMPING = np.array([0.005, 0.03])
# A different mode replaces the current mode if the ratio of their residuals is below this value, so noise does not
# exchange the modes.
_MAX_RESIDUAL_RATIO = 0.7
# The search around the current mode begins with this frequency step, relative to the mode's frequency.
_INITIAL_STEP = 0.01
# Limits of the relative frequency step.
_MIN_STEP = 1e-4
_MAX_STEP = 0.03
# The frequency step is multiplied by this factor if the current frequency remains the best.
_STEP_DECREASE = 0.6
# The frequency step is multiplied by this factor if another frequency is better.
_STEP_INCREASE = 1.5
# The search changes the damping ratio by this fraction per step.
_DAMPING_STEP = 0.2
# Limits of the damping ratio.
_DAMPING_LIMITS = (0.002, 0.2)
# Below this exponent the mean of the exponential is approximated linearly, because rounding errors dominate the exact
# formula.
_MIN_EXPONENT = 1e-6
# Relative regularization (ridge) of the coefficients g and c towards zero. It has an effect only if the observations do
# not determine both.
_RIDGE = 1e-4


class NearestMode:
    """Model of the driven body: the mode nearest to the tone, and a residual term for all other modes.

    The complex envelopes X of the body's displacement and F of the force are relative to the tone's phase. Near a mode
    with pole s they obey X = c F + x and dx/dt = (s - i w) x + g F, where c is the residual term of all other modes.
    The pole, g and c are least-squares estimates from the last observations: g and c by linear regression, the pole by
    a search. The growing response identifies a mode well before the tone reaches it, and the model tracks modes that
    change with the level.

    >>> mode, s, x, force = NearestMode(), (-0.01 + 1j) * 80.0, 0j, 1.0 + 0j
    >>> for k in range(40):
    ...     w = 60.0 + k / 4
    ...     z = s - 1j * w
    ...     x = np.exp(z * 0.05) * x + np.expm1(z * 0.05) / z * -5e-4j * force
    ...     mode.add(0.05 * (k + 1), w + 0.125, x + 2e-5 * force, force, memory=2.0)
    >>> round(mode.pole.imag)
    80
    """

    def __init__(self) -> None:
        self._observations: deque[tuple[float, float, complex, complex]] = deque()
        self._count = 0
        self._step = _INITIAL_STEP
        self.pole, self.gain, self.residual_term = 0j, 0j, 0j

    def add(self, time: float, angular_frequency: float, motion: complex, force: complex, memory: float) -> None:
        """Add an observation: time in s, angular frequency of the tone in rad/s, X in m, F in N.

        `memory`: time in s after which the weight of an observation has decreased to 1 / e.
        """
        self._observations.append((time, angular_frequency, motion, force))
        while time - self._observations[0][0] >= _MAX_AGE_RATIO * memory:
            self._observations.popleft()
        self._count += 1
        if self._count < _MIN_OBSERVATIONS or len(self._observations) < _MIN_OBSERVATIONS:
            # Until a mode can be estimated, the residual term alone describes the motion.
            self.pole, self.gain, self.residual_term = (-0.02 + 1.3j) * angular_frequency, 0j, motion / force
            return
        local_poles = self._poles_around()
        poles = local_poles
        if self._count % _SEARCH_INTERVAL == 0:
            distant_poles = [
                ratio * angular_frequency * (1j - damping)
                for ratio in _SEARCH_FREQUENCIES
                for damping in _SEARCH_DAMPING
            ]
            poles = np.concatenate([local_poles, distant_poles])
        gains, residual_terms, residuals = _fit_poles(poles, np.array(self._observations), memory)
        best, best_local = int(np.argmin(residuals)), int(np.argmin(residuals[: local_poles.size]))
        if best >= local_poles.size and residuals[best] > _MAX_RESIDUAL_RATIO * residuals[best_local]:
            best = best_local
        if best >= local_poles.size:
            self._step = _INITIAL_STEP
        elif best // 3 == 1:  # the current frequency, with one of its three damping ratios
            self._step = max(_MIN_STEP, _STEP_DECREASE * self._step)
        else:
            self._step = min(_MAX_STEP, _STEP_INCREASE * self._step)
        estimates = poles, gains, residual_terms
        self.pole, self.gain, self.residual_term = (complex(values[best]) for values in estimates)

    def _poles_around(self) -> ComplexArray:
        """Return poles around the current pole, frequency by frequency; the current frequency is in the middle."""
        angular_frequency, damping = self.pole.imag, -self.pole.real / self.pole.imag
        steps = np.array([-1.0, 0.0, 1.0])
        angular_frequencies = angular_frequency * (1 + self._step * steps)
        dampings = np.clip(damping * (1 + _DAMPING_STEP * steps), *_DAMPING_LIMITS)
        return np.asarray((angular_frequencies[:, None] * (1j - dampings)).ravel())


def _fit_poles(
    poles: ComplexArray, observations: ComplexArray, memory: float
) -> tuple[ComplexArray, ComplexArray, Array]:
    """Return estimates of g and c, and the squared residual, for each pole; shape (poles,) each.

    `observations`: time, angular frequency, motion and force; shape (observations, 4). `memory`: s.
    """
    time, angular_frequency, motion, force = observations.T
    time, angular_frequency = time.real, angular_frequency.real
    step = np.diff(time)
    power = abs(force) ** 2
    weight = np.exp((time[1:] - time[-1]) / (2 * memory)) / np.sqrt(power[1:] + power[:-1] + 1e-300)
    exponent = (poles[:, None] - 0.5j * (angular_frequency[1:] + angular_frequency[:-1])) * step
    decay_factor = np.exp(exponent)
    is_small = abs(exponent) < _MIN_EXPONENT
    mean = np.where(is_small, 1 + exponent / 2, (decay_factor - 1) / np.where(is_small, 1, exponent))
    previous_force, previous_motion = force[:-1] * weight, motion[:-1] * weight
    force, motion = force[1:] * weight, motion[1:] * weight
    gain_column = mean * (step / 2 * (force + previous_force))
    residual_column = force - decay_factor * previous_force
    response = motion - decay_factor * previous_motion

    dot = np.vecdot
    gain_gain, residual_residual = ((1 + _RIDGE) * dot(term, term).real for term in (gain_column, residual_column))
    cross, gain_response = dot(gain_column, residual_column), dot(gain_column, response)
    residual_response = dot(residual_column, response)
    determinant = gain_gain * residual_residual - abs(cross) ** 2
    gain = (residual_residual * gain_response - cross * residual_response) / determinant
    residual_term = (gain_gain * residual_response - cross.conj() * gain_response) / determinant
    residual = (
        dot(response, response).real - (gain.conj() * gain_response + residual_term.conj() * residual_response).real
    )
    return gain, residual_term, residual


def mean_exponential(exponent: complex) -> complex:
    """Return the mean of e^(exponent u) for u from 0 to 1.

    >>> mean_exponential(0.0)
    1.0
    """
    return 1 + exponent / 2 if abs(exponent) < _MIN_EXPONENT else (exp(exponent) - 1) / exponent
