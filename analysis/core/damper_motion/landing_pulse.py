"""Force pulse of a finite-duration impact: change of the body's velocity from first contact to release.

Floor and ceiling of the damper's cavity are springs with dashpots, so the scene determines the pulse of each impact.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.scene.damper import TimedContact, walls_of
from rig.core.scene.scene import Scene

# An impact is treated as instantaneous up to this duration, in sample intervals: shorter pulses look the same.
_MAX_INSTANT_RATIO = 0.25
# Two pulses are equal up to this fraction of the velocity change, which is below the error of an estimated jump.
_MAX_PULSE_DIFFERENCE = 0.02
# The closed form is evaluated at least this far from critical damping, where it is singular.
_CRITICAL_OFFSET = 1e-6
# Number of times at which pulses are compared: enough for a smooth half-sine.
_INSTANTS = 200


@dataclass(frozen=True)
class Pulse:
    """Force of a spring-dashpot contact on an impacting mass, until the force would become tensile."""

    duration: float
    """Time from first contact to release if no other forces act [s]."""
    damping_ratio: float
    """Damping ratio of the mass on the contact."""
    angular_frequency: float
    """Natural angular frequency of the mass on the contact [rad/s]."""

    def velocity_change_ratio(self, time: Array) -> Array:
        """Return the fraction of the whole velocity change that is reached at times [s] after first contact.

        >>> half_sine = Pulse(duration=2e-3, damping_ratio=0.0, angular_frequency=np.pi / 2e-3)
        >>> half_sine.velocity_change_ratio(np.array([-1.0, 0.0, 1e-3, 2e-3, 1.0])).round(12).tolist()
        [0.0, 0.0, 0.5, 1.0, 1.0]
        """
        return (1.0 - self._speed(np.clip(time, 0.0, self.duration))) / (1.0 + self.restitution)

    def _speed(self, time: Array) -> Array:
        """Return the closing speed during contact relative to the closing speed at first contact."""
        ratio = self.damping_ratio + _CRITICAL_OFFSET * (abs(self.damping_ratio - 1.0) < _CRITICAL_OFFSET)
        root = np.sqrt(complex(ratio**2 - 1.0))
        first, second = self.angular_frequency * (root - ratio), -self.angular_frequency * (root + ratio)
        speed = (first * np.exp(first * time) - second * np.exp(second * time)) / (first - second)
        return np.asarray(speed.real)

    @property
    def restitution(self) -> float:
        """Ratio of rebound speed to closing speed."""
        return float(-self._speed(np.array([self.duration]))[0])

    @cached_property
    def time_to_90_percent(self) -> float:
        """Time until 90 % of the velocity change [s]."""
        time = np.linspace(0.0, self.duration, _INSTANTS)
        return float(np.interp(0.9, self.velocity_change_ratio(time), time))


_INSTANTANEOUS_PULSE = Pulse(duration=1e-9, damping_ratio=0.0, angular_frequency=np.pi / 1e-9)


def landing_pulse(scene: Scene, location: str, rate: float) -> Pulse | None:
    """Return the common pulse of all impacts in a location such as ``"body 2"``; None if they are instantaneous.

    `rate`: samples per second of the channel.

    Raises `RecordingError` if there are grains, or impacts with different pulses.
    """
    from rig.core.system.assembly import assemble

    inside = {
        number: damper
        for number, damper in enumerate(scene.dampers, 1)
        if damper.impacts and location == f"body {damper.body}"
    }
    dampers = inside.values()
    if any(damper.grains is not None for damper in dampers):
        raise RecordingError(
            f"{location}: the grains of a bed hit at different times, so impacts cannot be detected. Choose a "
            "body without grains."
        )
    walls = [wall for damper in dampers for wall in walls_of(damper.contact)]
    if all(isinstance(wall, TimedContact) and wall.duration * rate <= _MAX_INSTANT_RATIO for wall in walls):
        return None
    system, pulses = assemble(scene), []
    for number, damper in inside.items():
        [j] = np.flatnonzero(system.damper_number == number)
        for wall in (1, 2) if np.isfinite(damper.clearance) else (1,):
            if not system.finite_contact[j]:
                pulses.append(_INSTANTANEOUS_PULSE)
                continue
            duration, _ = system.duration_and_restitution(int(j), wall)
            angular_frequency = np.sqrt(system.wall_stiffness[j, wall - 1] / system.reduced_mass[j])
            ratio = system.wall_damping[j, wall - 1] / (2.0 * angular_frequency * system.reduced_mass[j])
            pulses.append(Pulse(float(duration), float(ratio), float(angular_frequency)))
    longest = max(pulses, key=lambda pulse: pulse.duration)
    time = np.linspace(0.0, longest.duration, _INSTANTS)
    longest_ratio = longest.velocity_change_ratio(time)
    if any(abs(pulse.velocity_change_ratio(time) - longest_ratio).max() > _MAX_PULSE_DIFFERENCE for pulse in pulses):
        raise RecordingError(
            f"{location}: contact durations or restitutions of floor, ceiling or dampers differ, so the pulse of an "
            "impact is not known beforehand. Choose a body whose walls have the same contact settings."
        )
    return longest


def transmissibility(scene: Scene, number: int, frequency: Array) -> NDArray[np.complex128]:
    """Return the transmissibility from the body to a resting damper, shape (frequencies,).

    `number`: number of the damper, from 1; `frequency`: Hz. The damper leaves the floor when its own acceleration falls
    below -g. On a compliant floor this differs from the acceleration of the body.
    """
    if scene.dampers[number - 1].contact is None:
        return np.ones(frequency.size, dtype=complex)
    from rig.core.system.assembly import assemble

    system = assemble(scene)
    for j in np.flatnonzero((system.damper_number == number) & system.finite_contact[: system.dampers]):
        s = 2j * np.pi * frequency
        dynamic_stiffness = system.wall_stiffness[j, 0] + s * system.wall_damping[j, 0]
        return np.asarray(dynamic_stiffness / (dynamic_stiffness + system.damper_mass[j] * s**2))
    return np.ones(frequency.size, dtype=complex)
