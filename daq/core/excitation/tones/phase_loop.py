"""Control of the phase between a displacement and a force by the frequency of the tone: a phase-locked loop.

At constant force the phase obeys e' = -d sin e - (w - w0(|X|)) with the decay rate d: a plant of first order at every
amplitude, also where the resonance curve overhangs. With a coil spring, the phase follows the frequency immediately;
the loop then has no proportional part. (S. Peter, R. I. Leine, Mech. Syst. Signal Process. 96 (2017) 139; tuning by the
SIMC rules for a plant of first order with dead time: S. Skogestad, J. Process Control 13 (2003) 291.)

The settings of the loop follow from the linear structure with its shaker, whose dynamics change the force. At the
frequency w, a small modulation of the frequency with the angular frequency v adds sidebands at w + v and w - v. The
phase of an amplitude H then changes by the mean of H(w + v) / H(w) and the conjugate of H(w - v) / H(w), multiplied by
the phase modulation of the drive. With a coil spring, the force nearly vanishes at a resonance of the structure. The
sidebands of the force do not vanish; they are largest where the structure resonates on the spring.
"""

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from daq.core.excitation.tones.steady_tone import WINDOW_S
from rig.core.base.arrays import Array, ComplexArray
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import force_per_drive, riding_response

# Number of windows in each of two successive groups whose phase deviations are compared.
_COMPARED_ERRORS = 25
# The loop is slowed down if the scatter in the later group is above this fraction of the scatter in the earlier group:
# a coil spring or another mode adds dynamics to the force.
_MIN_DECAY = 0.7
# The frequency changes by at most this fraction from window to window: a wrong phase must not leave the resonance.
_MAX_CHANGE_RATIO = 0.02
# Largest factor by which the loop amplifies errors: the SIMC rules give 1.6 for a plant of first order.
_MAX_SENSITIVITY = 2.5
# Factors on the length of the windows that are tried; a loop is slowed down to the last of them.
_SLOWNESSES = (1.0, 2.0, 4.0, 8.0, 16.0)
# Numbers of frequencies at which the phase of the structure and the loop are evaluated.
_FREQUENCIES, _MODULATIONS = 2001, 400


class LoopSettings(NamedTuple):
    """Settings of a `PhaseLoop`."""

    slope_rate: float  # inverse of the slope of the phase over angular frequency [1/s]
    proportional: float  # weight of the proportional part
    slowness: float  # factor on the length of the windows


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
        self, frequency: float, lowest: float, highest: float, phase: float, tolerance: float, settings: LoopSettings
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
            before, latest = map(_scatter, np.split(np.array(self._errors), 2))
            if latest > max(_MIN_DECAY * before, self._tolerance):
                slowness = min(2.0 * self.settings.slowness, _SLOWNESSES[-1])
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


def _scatter(errors: Array) -> float:
    """Return the standard deviation about a straight line, so a slow decay does not count as scatter."""
    place = np.arange(errors.size)
    return float(np.std(errors - np.polyval(np.polyfit(place, errors, 1), place)))


def loop_settings(scene: Scene, latency: float) -> LoopSettings:
    """Return the settings of the fastest stable loop; `latency`: latency of the readings [s]."""
    modulation = np.geomspace(1e-2, np.pi / WINDOW_S, _MODULATIONS)
    plant = _plant(scene, modulation)
    slope_rate = 1.0 / float(abs(plant[0]))
    for slowness, proportional in product(_SLOWNESSES, (1.0, 0.0)):
        window = WINDOW_S * slowness
        dead_time = 1.5 * window + latency
        gain = (proportional + max(slope_rate, proportional / (8.0 * dead_time)) / (1j * modulation)) / (
            2.0 * dead_time
        )
        average_and_hold = np.sinc(modulation * window / (2.0 * np.pi)) ** 2
        loop = gain * plant * np.exp(-1j * modulation * dead_time) * average_and_hold
        distance = 1.0 + loop[modulation < np.pi / window]
        # Nyquist criterion: the curve of the open loop does not encircle -1.
        is_stable = abs(np.unwrap(np.angle(distance))[-1]) < np.pi / 2.0
        if is_stable and np.min(abs(distance)) > 1.0 / _MAX_SENSITIVITY:
            break
    return LoopSettings(slope_rate, proportional, slowness)


def _plant(scene: Scene, modulation: Array) -> ComplexArray:
    """Return the change of the phase per modulation of the angular frequency [s] near the phase of the test."""
    test, shaker, system = scene.test, scene.driven_shaker, assemble(scene)
    assert test is not None and test.held_phase is not None and test.band is not None and shaker is not None
    location, phase = test.held_phase

    def amplitudes(omega: Array) -> ComplexArray:
        """Return displacement and force per unit of drive."""
        motion = riding_response(system, scene.at_driven("shaker"), omega)[system.points.index(location)]
        return np.array(
            [motion, np.ones_like(motion) if shaker.drive_is_force else force_per_drive(scene, system, omega)]
        )

    omega = 2.0 * np.pi * np.linspace(*test.band, _FREQUENCIES)
    motion, force = amplitudes(omega)
    center = omega[np.argmin(abs(np.angle(motion / force * np.exp(-1j * phase))))]
    carrier = amplitudes(np.array([center]))
    upper, lower = (amplitudes(abs(center + sign * modulation)) / carrier for sign in (1.0, -1.0))
    of_motion, of_force = (upper + lower.conj()) / 2.0
    return np.asarray((of_force - of_motion) / (1j * modulation))
