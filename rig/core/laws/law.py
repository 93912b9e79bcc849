"""The parts of a contact law: rows, signals, exits, modes.

An element has one relative displacement, the *gap* g, and the *speed* s = g'. Its force F acts along the gap. The law
divides the motion into *modes*. In a mode, F is an affine function of gap and speed, or the element is *held*: its
relative motion is zero, and the holding force h follows from the motion of the whole system. A mode lasts while each of
its *signals* is inside an interval. A signal is an affine function of gap, speed and h. When it reaches an end of its
interval, an *exit* specifies the next mode, and the restitution if velocities jump.

Between two events the motion therefore obeys a linear system, which the engine solves exactly. A law with products of
states, such as friction in two directions or Hertz's contact, does not have this form.

References
----------
Pfeiffer, F., Glocker, C., "Multibody Dynamics with Unilateral Contacts", Wiley 1996, chapters 6 and 8.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from rig.core.laws.events import FLIGHT, NO_EVENT


class Row(NamedTuple):
    """The affine function gap (g - rest) + speed s + hold h + memory u + constant, in SI units.

    Its variables are the gap g, the speed s, the holding force h and the memory u.

    For the force of a spring with a dashpot, `gap` is minus the stiffness, `speed` minus the damping, and `rest` the
    gap at which the spring is relaxed; `constant` is a force that does not depend on the motion, such as friction in
    one direction. The memory u [m] is constant during a mode. A mode whose force depends on u begins with the force of
    the previous mode; u follows from this condition.
    """

    gap: float = 0.0
    speed: float = 0.0
    hold: float = 0.0
    rest: float = 0.0
    constant: float = 0.0
    memory: float = 0.0

    def at(self, gap: float, speed: float) -> float:
        """Return the value for a gap and a speed, without holding force and memory."""
        return self.gap * (gap - self.rest) + self.speed * speed + self.constant


GAP, SPEED, HOLD = Row(gap=1.0), Row(speed=1.0), Row(hold=1.0)


class Exit(NamedTuple):
    """The end of a mode at one end of a signal's interval.

    `to`: candidates for the next mode, which is the first that is consistent with the motion. `event`: kind of event in
    the log (`rig.core.laws.events`). `restitution`: ratio of rebound speed to closing speed; None: velocities do not
    jump.
    """

    to: tuple[str, ...]
    event: int = NO_EVENT
    restitution: float | None = None


class Signal(NamedTuple):
    """A row and the open interval in which its value remains during the mode; an infinite end has no exit."""

    row: Row
    low: float = -inf
    high: float = inf
    at_low: Exit | None = None
    at_high: Exit | None = None

    @property
    def ends(self) -> tuple[tuple[float, Exit | None], tuple[float, Exit | None]]:
        """Limit and exit at the lower and at the upper end."""
        return (self.low, self.at_low), (self.high, self.at_high)


class Mode(NamedTuple):
    """A mode: its signals, the force along the gap (None: held), and the wall that the element touches.

    `wall`: contact in results (`FLIGHT`, `FLOOR`, `CEILING`). `wall_gap`: gap of a held element [m].
    """

    signals: tuple[Signal, ...]
    force: Row | None = Row()
    wall: int = FLIGHT
    wall_gap: float = 0.0

    @property
    def ends_by_impact(self) -> bool:
        """Whether an exit of the mode is an impact, at which velocities jump."""
        exits = (exit_ for signal in self.signals for _, exit_ in signal.ends)
        return any(exit_ is not None and exit_.restitution is not None for exit_ in exits)

    @property
    def transmits_impulses(self) -> bool:
        """Whether the element is held by a force that is unlimited in a direction, as at a wall."""
        return self.force is None and any(abs(limit) == inf for signal in self.signals for limit, _ in signal.ends)

    @property
    def push(self) -> float:
        """Direction in which the force of the touched wall acts on the element, 1 or -1."""
        return 1.0 if any(signal.low > -inf for signal in self.signals) else -1.0


class Wall(NamedTuple):
    """A wall: gap at contact [m]; stiffness [N/m] and damping [N s/m] of a contact of finite duration."""

    gap: float
    stiffness: float = 0.0
    damping: float = 0.0


class Law(NamedTuple):
    """A contact law: its modes by name, the mode at the start, and its walls, the lower wall first."""

    modes: dict[str, Mode]
    start: str
    walls: tuple[Wall, ...] = ()

    @property
    def key(self) -> tuple[object, ...]:
        """The content of the law, which can be hashed."""
        return tuple(self.modes.items()), self.start

    @property
    def starts_at_rest(self) -> bool:
        """Whether the element is at rest on its body at the start: on a wall, or held by friction."""
        start = self.modes[self.start]
        return start.wall != FLIGHT or start.force is None

    def mode_at(self, wall: int, gap: float) -> str:
        """Return the first mode with a gap [m], or at it within rounding, that touches a wall (`FLIGHT`: none)."""
        at_wall = [name for name, mode in self.modes.items() if mode.wall == wall]
        containing = [
            name
            for name in at_wall
            if all(signal.low <= gap <= signal.high for signal in self.modes[name].signals if signal.row == GAP)
        ]
        return (containing or at_wall)[0]

    @property
    def has_memory(self) -> bool:
        """Whether a force depends on a memory."""
        return any(force is not None and force.memory for force in self.forces)

    def mode_for(self, gap: float, speed: float) -> str:
        """Return the first mode that contains a gap [m] and a speed [m/s], or the mode at the start if none does."""
        fitting = [
            name
            for name, mode in self.modes.items()
            if all(signal.low <= signal.row.at(gap, speed) <= signal.high for signal in mode.signals)
        ]
        return (fitting or [self.start])[0]

    def reachable(self) -> Law:
        """Return the law with only the modes that can follow from the mode at the start."""
        names = [self.start]
        for name in names:
            exits = [exit_ for signal in self.modes[name].signals for _, exit_ in signal.ends if exit_ is not None]
            names += dict.fromkeys(target for exit_ in exits for target in exit_.to if target not in names)
        return self._replace(modes={name: mode for name, mode in self.modes.items() if name in names})

    @property
    def force_indices(self) -> dict[str, int]:
        """Number of each mode's force, equal for modes with the same force, and for all modes of a held element.

        The forces of two walls have two numbers even if they are equal, so no number depends on a parameter.
        """
        numbers: dict[tuple[Row | None, int], int] = {}
        return {
            name: numbers.setdefault((mode.force, mode.wall if mode.force is not None else FLIGHT), len(numbers))
            for name, mode in self.modes.items()
        }

    @property
    def forces(self) -> tuple[Row | None, ...]:
        """Force of each number in `force_indices`."""
        numbers = self.force_indices
        return tuple({numbers[name]: mode.force for name, mode in self.modes.items()}.values())


def faults(law: Law) -> list[str]:
    """Return the faults of a declaration, in words; a correct law has none."""
    flaws = [] if law.start in law.modes else [f"the start {law.start!r} is not a mode"]
    for name, mode in law.modes.items():
        for signal in mode.signals:
            if not signal.low < signal.high:
                flaws.append(f"{name}: the interval from {signal.low} to {signal.high} is empty")
            if mode.force is not None and signal.row.hold:
                flaws.append(f"{name}: a signal is the holding force, but the mode is not held")
            if mode.force is None and not signal.row.hold:
                flaws.append(f"{name}: a signal is constant while the mode is held")
            for limit, exit_ in signal.ends:
                if (abs(limit) == inf) != (exit_ is None):
                    flaws.append(f"{name}: a limit of {limit} does not agree with the exit {exit_}")
                flaws += [
                    f"{name}: the exit to {target!r} has no mode"
                    for target in (exit_.to if exit_ is not None else ())
                    if target not in law.modes
                ]
    return flaws
