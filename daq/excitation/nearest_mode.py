"""Response of the driven body to the force near the tone: one mode and a residual term, tracked along a sweep."""

from __future__ import annotations

from cmath import exp
from collections import deque

import numpy as np

from rig.arrays import Array, ComplexArray

# Minimum number of observations for the estimate of a mode.
_FEWEST = 6
# Age, in memory times, above which observations have no weight.
_FADED = 3.0
# Interval of the search for a different mode, in observations; its frequencies relative to the tone; its damping
# ratios; and the ratio of residuals below which the different mode becomes the nearest mode.
_SEARCH_INTERVAL = 4
_SEARCH_FREQUENCIES = np.geomspace(0.6, 1.7, 24)
_SEARCH_DAMPING = np.array([0.005, 0.03])
_BETTER = 0.7
# Search around the present mode: the relative frequency step is adapted; the damping ratio changes by 20 %.
_STEP, _SHORTEST, _LONGEST = 0.01, 1e-4, 0.03
_SHORTER, _LONGER = 0.6, 1.5
_DAMPING_STEP, _DAMPING = 0.2, (0.002, 0.2)
# Below this exponent the mean of the exponential is linear; the exact formula would suffer from rounding.
_SMALL = 1e-6
# Regularization of both coefficients towards zero, if force and motion do not separate them.
_RIDGE = 1e-4


class NearestMode:
    """Model of the driven body: the mode nearest to the tone, and a residual term for all other modes.

    The envelopes X of the body's displacement and F of the force, both relative to the tone's phase, obey X = c F
    + x and dx/dt = (s - i w) x + g F near a mode with pole s; c is the residual term of all other modes.
    Frequency, damping ratio, g and c are least-squares estimates from the last observations: g and c are linear,
    and the pole is searched. The growing response identifies a mode well before the tone reaches it, and the
    model tracks modes that change with the level.

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
        self._step = _STEP
        self.pole, self.gain, self.rest = 0j, 0j, 0j

    def add(self, time: float, turn: float, motion: complex, force: complex, memory: float) -> None:
        """Add an observation: time in s, angular frequency of the tone in rad/s, X in m, F in N; memory in s."""
        self._observations.append((time, turn, motion, force))
        while time - self._observations[0][0] >= _FADED * memory:
            self._observations.popleft()
        self._count += 1
        if self._count < _FEWEST or len(self._observations) < _FEWEST:
            self.pole, self.gain, self.rest = (-0.02 + 1.3j) * turn, 0j, motion / force
            return
        local = self._around()
        poles = local
        if self._count % _SEARCH_INTERVAL == 0:
            far = [
                ratio * turn * (1j - damping) for ratio in _SEARCH_FREQUENCIES for damping in _SEARCH_DAMPING
            ]
            poles = np.concatenate([local, far])
        gains, rests, residuals = _explain(poles, np.array(self._observations), memory)
        best, best_local = int(np.argmin(residuals)), int(np.argmin(residuals[: local.size]))
        if best >= local.size and residuals[best] > _BETTER * residuals[best_local]:
            best = best_local
        if best >= local.size:
            self._step = _STEP
        elif best // 3 == 1:
            self._step = max(_SHORTEST, _SHORTER * self._step)
        else:
            self._step = min(_LONGEST, _LONGER * self._step)
        self.pole, self.gain, self.rest = complex(poles[best]), complex(gains[best]), complex(rests[best])

    def _around(self) -> ComplexArray:
        """Return poles around the present pole, frequency by frequency; the present frequency is in the middle."""
        turn, damping = self.pole.imag, -self.pole.real / self.pole.imag
        steps = np.array([-1.0, 0.0, 1.0])
        turns = turn * (1 + self._step * steps)
        dampings = np.clip(damping * (1 + _DAMPING_STEP * steps), *_DAMPING)
        return np.asarray((turns[:, None] * (1j - dampings)).ravel())


def _explain(
    poles: ComplexArray, observations: ComplexArray, memory: float
) -> tuple[ComplexArray, ComplexArray, Array]:
    """Estimate g, c and the residual for each pole, from the steps between observations."""
    time, turn, motion, force = observations.T
    time, turn = time.real, turn.real
    step = np.diff(time)
    power = abs(force) ** 2
    root = np.exp((time[1:] - time[-1]) / (2 * memory)) / np.sqrt(power[1:] + power[:-1] + 1e-300)
    decay = (poles[:, None] - 0.5j * (turn[1:] + turn[:-1])) * step
    decayed = np.exp(decay)
    small = abs(decay) < _SMALL
    mean = np.where(small, 1 + decay / 2, (decayed - 1) / np.where(small, 1, decay))
    force, motion, earlier = force[1:] * root, motion[1:] * root, (force[:-1] * root, motion[:-1] * root)
    by_gain = mean * (step / 2 * (force + earlier[0]))
    by_rest = force - decayed * earlier[0]
    response = motion - decayed * earlier[1]

    dot = np.vecdot
    gain_gain, rest_rest = ((1 + _RIDGE) * dot(term, term).real for term in (by_gain, by_rest))
    cross, gain_response, rest_response = (
        dot(by_gain, by_rest),
        dot(by_gain, response),
        dot(by_rest, response),
    )
    both = gain_gain * rest_rest - abs(cross) ** 2
    gain = (rest_rest * gain_response - cross * rest_response) / both
    rest = (gain_gain * rest_response - cross.conj() * gain_response) / both
    residual = dot(response, response).real - (gain.conj() * gain_response + rest.conj() * rest_response).real
    return gain, rest, residual


def integral(decay: complex) -> complex:
    """Return the mean of e^(decay u) for u from 0 to 1.

    >>> integral(0.0)
    1.0
    """
    return 1 + decay / 2 if abs(decay) < _SMALL else (exp(decay) - 1) / decay
