"""The force pulse of a landing that lasts: how its body's velocity changes from touch to release."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.errors import RecordingError
from rig.scene.damper import Landing, walls_of

if TYPE_CHECKING:
    from rig.scene.damper import Damper
    from rig.scene.scene import Scene

Array = NDArray[np.float64]

# A landing of no more than this part of a sample interval is a jump.
_INSTANT = 0.25
# Pulses that differ by no more than this part of the velocity's change count as one.
_ALIKE = 0.02
# At critical damping both roots are one, and the closed form needs two.
_CRITICAL = 1e-6
_FINE = 200


@dataclass(frozen=True)
class Pulse:
    """Force of a spring-dashpot of one damping ratio on what lands on it, until it would pull."""

    duration: float
    """From touch to release of a landing under no other force, s."""
    ratio: float
    """Damping ratio of the contact with what lands on it."""
    angular: float
    """Natural frequency of the contact with what lands on it, rad/s."""

    def exchanged(self, time: Array) -> Array:
        """Return the share of the body's change of velocity at a time after first contact, s.

        Examples
        --------
        >>> half_sine = Pulse(duration=2e-3, ratio=0.0, angular=np.pi / 2e-3)
        >>> half_sine.exchanged(np.array([-1.0, 0.0, 1e-3, 2e-3, 1.0])).round(12).tolist()
        [0.0, 0.0, 0.5, 1.0, 1.0]
        """
        return (1.0 - self._speed(np.clip(time, 0.0, self.duration))) / (1.0 + self.restitution)

    def _speed(self, time: Array) -> Array:
        """Give the closing speed at times of contact, in that of the touch."""
        ratio = self.ratio + _CRITICAL * (abs(self.ratio - 1.0) < _CRITICAL)
        apart = np.sqrt(complex(ratio**2 - 1.0))
        one, other = self.angular * (apart - ratio), -self.angular * (apart + ratio)
        speed = (one * np.exp(one * time) - other * np.exp(other * time)) / (one - other)
        return np.asarray(speed.real)

    @property
    def restitution(self) -> float:
        """Ratio of separation to approach speed."""
        return float(-self._speed(np.array([self.duration]))[0])

    @cached_property
    def width(self) -> float:
        """Time in which nine tenths of it are over, s."""
        time = np.linspace(0.0, self.duration, _FINE)
        return float(np.interp(0.9, self.exchanged(time), time))


_AT_ONCE = Pulse(duration=1e-9, ratio=0.0, angular=np.pi / 1e-9)


def landing_pulse(scene: Scene, place: str, rate: float) -> Pulse | None:
    """Give the pulse of every landing in a place such as ``"body 2"``; None where landings are jumps of velocity.

    Raises
    ------
    RecordingError
        If there are grains, or landings that differ.
    """
    from rig.system.assembly import assemble

    inside = [
        number
        for number, damper in enumerate(scene.dampers, 1)
        if damper.moves and place == f"body {damper.body}"
    ]
    dampers = [scene.dampers[number - 1] for number in inside]
    if any(damper.grains is not None for damper in dampers):
        raise RecordingError(
            f"{place}: a bed of grains is not one mass that lands, so its impacts cannot be detected in a channel"
        )
    if all(_instant(damper, rate) for damper in dampers):
        return None
    system, pulses = assemble(scene), []
    for number, damper in zip(inside, dampers, strict=True):
        [j] = np.flatnonzero(system.damper_number == number)
        for wall in (1, 2) if np.isfinite(damper.clearance) else (1,):
            if not system.lasting[j]:
                pulses.append(_AT_ONCE)
                continue
            duration, _ = system.landing(int(j), wall)
            angular = np.sqrt(system.wall_stiffness[j, wall - 1] / system.reduced_mass[j])
            ratio = system.wall_damping[j, wall - 1] / (2.0 * angular * system.reduced_mass[j])
            pulses.append(Pulse(float(duration), float(ratio), float(angular)))
    longest = max(pulses, key=lambda pulse: pulse.duration)
    time = np.linspace(0.0, longest.duration, _FINE)
    if any(abs(pulse.exchanged(time) - longest.exchanged(time)).max() > _ALIKE for pulse in pulses):
        raise RecordingError(
            f"{place}: floor and ceiling, or its dampers, differ in how landings last and rebound, and which of "
            "them is met is not known beforehand: they can be detected in a channel only where all are equal"
        )
    return longest


def transmissibility(scene: Scene, number: int, frequency: Array) -> NDArray[np.complex128]:
    """Return the share of a damper's motion in its body's while it rests on its floor; dampers count from 1.

    It leaves the floor where its own acceleration falls below -g: on one that gives way, the body's may not.
    """
    if scene.dampers[number - 1].contact is None:
        return np.ones(frequency.size, dtype=complex)
    from rig.system.assembly import assemble

    system = assemble(scene)
    for j in np.flatnonzero((system.damper_number == number) & system.lasting):
        s = 2j * np.pi * frequency
        push = system.wall_stiffness[j, 0] + s * system.wall_damping[j, 0]
        return np.asarray(push / (push + system.damper_mass[j] * s**2))
    return np.ones(frequency.size, dtype=complex)


def _instant(damper: Damper, rate: float) -> bool:
    """Whether a landing is seen as instant: it is, or named by a time well within a sample interval."""
    return all(
        isinstance(wall, Landing) and wall.duration * rate <= _INSTANT for wall in walls_of(damper.contact)
    )
