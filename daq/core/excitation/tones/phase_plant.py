"""Settings of the phase loop from the linear structure with its shaker, whose dynamics change the force.

At the frequency w, a small modulation of the frequency with the angular frequency v adds sidebands at w + v and w - v.
The phase of an amplitude H then changes by the mean of H(w + v) / H(w) and the conjugate of H(w - v) / H(w), multiplied
by the phase modulation of the drive. With a coil spring, the force nearly vanishes at a resonance of the structure. The
sidebands of the force do not vanish; they are largest where the structure resonates on the spring.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from daq.core.excitation.tones.steady_tone import WINDOW_S
from rig.core.base.arrays import Array, ComplexArray

if TYPE_CHECKING:
    from rig.core.scene.scene import Scene

# Largest factor by which the loop amplifies errors: the SIMC rules give 1.6 for a plant of first order.
_MAX_SENSITIVITY = 2.5
# Factors on the length of the windows that are tried.
_SLOWNESSES = (1.0, 2.0, 4.0, 8.0, 16.0)
# Numbers of frequencies at which the phase of the structure and the loop are evaluated.
_FREQUENCIES, _MODULATIONS = 2001, 400


class LoopSettings(NamedTuple):
    """Settings of a `PhaseLoop`."""

    slope_rate: float  # inverse of the slope of the phase over angular frequency [1/s]
    proportional: float  # weight of the proportional part
    slowness: float  # factor on the length of the windows


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
    from rig.core.system.assembly import assemble
    from rig.core.system.open_loop_drive import force_per_drive, riding_response

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
