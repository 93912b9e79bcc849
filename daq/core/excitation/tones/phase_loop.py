"""Control of the phase between a displacement and a force by the frequency of the tone: a phase-locked loop.

At constant force the phase obeys e' = -d sin e - (w - w0(|X|)) with the decay rate d: a plant of first order at every
amplitude, also where the resonance curve overhangs. With a coil spring, the phase follows the frequency immediately;
the loop then has no proportional part. (S. Peter, R. I. Leine, Mech. Syst. Signal Process. 96 (2017) 139; tuning by the
SIMC rules for a plant of first order with dead time: S. Skogestad, J. Process Control 13 (2003) 291.)
"""

import math

import numpy as np

from daq.core.excitation.tones.phase_plant import LoopSettings

# Number of windows in each of two successive groups whose phase deviations are compared.
_COMPARED_ERRORS = 25
_BEFORE, _LATEST = slice(_COMPARED_ERRORS), slice(_COMPARED_ERRORS, None)
# The loop is slowed down if the scatter in the later group is above this fraction of the scatter in the earlier group:
# a coil spring or another mode adds dynamics to the force.
_MIN_DECAY = 0.7
_MAX_SLOWNESS = 16.0
# The frequency changes by at most this fraction from window to window: a wrong phase must not leave the resonance.
_MAX_CHANGE_RATIO = 0.02


class PhaseLoop:
    """PI control of the angular frequency by the deviation of the phase.

    `frequency`: first frequency [Hz]; `lowest`, `highest`: limits of the frequency [Hz]; `phase`: required phase of the
    displacement relative to the force [rad]; `tolerance`: permitted deviation of the phase [rad]; `settings`: initial
    settings; the loop is slowed down where the phase scatters.

    >>> loop = PhaseLoop(10.3, 5.0, 20.0, -math.pi / 2, 0.02, LoopSettings(0.4, 1.0, 1.0))
    >>> omega, error = 2 * math.pi * 10.3, 0.0
    >>> for _ in range(200):
    ...     error += 0.2 * (-0.4 * math.sin(error) - (omega - 2 * math.pi * 10.0))
    ...     omega = 2 * math.pi * loop.next_frequency(error - math.pi / 2, 0.2, 0.3)
    >>> round(omega / 2 / math.pi, 4)
    10.0
    """

    def __init__(
        self,
        frequency: float,
        lowest: float,
        highest: float,
        phase: float,
        tolerance: float,
        settings: LoopSettings,
    ) -> None:
        self.phase, self._tolerance, self.settings = phase, tolerance, settings
        self._errors: list[float] = []
        self._omega, self._integral = 2.0 * math.pi * frequency, 2.0 * math.pi * frequency
        self._lowest, self._highest = 2.0 * math.pi * lowest, 2.0 * math.pi * highest

    def error(self, phase: float) -> float:
        """Return the deviation of a phase [rad] from -pi to pi."""
        return math.remainder(phase - self.phase, 2.0 * math.pi)

    def next_frequency(self, phase: float, window: float, dead_time: float) -> float:
        """Compute the next frequency [Hz] from the phase in the last window; `window`, `dead_time`: s."""
        error = self.error(phase)
        self._errors.append(error)
        if len(self._errors) == 2 * _COMPARED_ERRORS:
            before, latest = (_scatter(self._errors[part]) for part in (_BEFORE, _LATEST))
            if latest > max(_MIN_DECAY * before, self._tolerance):
                slowness = min(2.0 * self.settings.slowness, _MAX_SLOWNESS)
                self.settings = self.settings._replace(slowness=slowness)
            self._errors.clear()
        slope_rate, proportional, _ = self.settings
        correction = error / (2.0 * dead_time)
        self._integral += window * max(slope_rate, proportional / (8.0 * dead_time)) * correction
        requested = self._integral + proportional * correction
        change = max(-_MAX_CHANGE_RATIO, min(_MAX_CHANGE_RATIO, requested / self._omega - 1.0))
        self._omega = max(self._lowest, min(self._highest, self._omega * (1.0 + change)))
        # The part of the frequency beyond a limit is not integrated, so the integral does not wind up.
        self._integral += self._omega - requested
        return self._omega / (2.0 * math.pi)


def _scatter(errors: list[float]) -> float:
    """Return the standard deviation about a straight line, so a slow decay does not count as scatter."""
    place = np.arange(len(errors))
    return float(np.std(errors - np.polyval(np.polyfit(place, errors, 1), place)))
