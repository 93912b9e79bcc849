"""Largest acceleration that an accelerometer indicates due to impacts of dampers."""

from collections.abc import Sequence

import numpy as np

from rig.core.system.hybrid_system import HybridSystem

#: Peak of the step response of an undamped sensor, relative to the step.
_STEP_OVERSHOOT = 2.0


def impact_acceleration(
    system: HybridSystem, row: int, closing_speed: Sequence[float], resonance: float | None
) -> float:
    """Compute the largest acceleration indicated by an accelerometer due to damper impacts [m/s²].

    An instantaneous impact causes a velocity jump of the body. The sensor then indicates the jump times 2 pi times the
    resonance frequency of the sensor; without a resonance the value is unbounded. In a finite-duration contact, the
    force is estimated as the larger of the initial dashpot force, v c, and the peak of the spring force without
    damping, v sqrt(k m).

    `system`: the assembled system of the scene; `row`: coordinate of the sensor location; `closing_speed`, shape
    (dampers,): closing speed of each damper and a wall [m/s]; `resonance`: resonance frequency of the sensor [Hz];
    None without a resonance.

    >>> import rig
    >>> from rig.core.system.assembly import assemble
    >>> jump = 0.1 * 0.71 / 0.781  # plastic impact of a tenth of the body's mass at 1 m/s: velocity jump [m/s]
    >>> system = assemble(rig.load("fig9", {"dampers": [{"body": 2, "mass_ratio": 0.1, "clearance": 1e-3}]}))
    >>> round(impact_acceleration(system, 1, [1.0], 1000.0) / (2 * np.pi * 1000.0 * jump), 9)
    1.0
    >>> impact_acceleration(system, 0, [1.0], None)
    0.0
    """
    inverse_mass = np.linalg.inv(system.mass)
    accelerations = [0.0]
    for j, speed in enumerate(closing_speed):
        body = system.damper_coordinate[j]
        if system.finite_contact[j]:
            dashpot = system.wall_damping[j]
            spring = np.sqrt(system.reduced_mass[j] * system.wall_stiffness[j])
            force = speed * float(np.maximum(dashpot, spring).max())
            accelerations.append((1.0 if resonance is None else _STEP_OVERSHOOT) * abs(inverse_mass[row, body]) * force)
            continue
        impulse = (1.0 + system.restitution[j]) * speed / (1.0 / system.damper_mass[j] + inverse_mass[body, body])
        jump = abs(inverse_mass[row, body]) * impulse
        angular_frequency = np.inf if resonance is None else 2.0 * np.pi * resonance
        accelerations.append(float(jump * angular_frequency) if jump else 0.0)
    return float(max(accelerations))
