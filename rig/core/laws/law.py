"""The parts of a contact law: rows, signals, transitions, regimes.

An element has one relative displacement, the *gap* g, and the *speed* s = g'. Its force F acts along the gap. The law
divides the motion into *regimes*. In each regime, either F is an affine function of gap and speed, or the element is
*held*: the relative motion is zero, and F is the holding force h that follows from the motion of the whole system. A
regime lasts while each of its *signals* is inside an interval. A signal is an affine function of gap, speed and h. When
it reaches an end of its interval, a *transition* specifies the next regime, and the restitution if velocities jump.

Between two events the motion therefore obeys a linear system, which the engine solves exactly. A law with products of
states, such as friction in two directions or Hertz's contact, does not have this form.

References
----------
Pfeiffer, F., Glocker, C., "Multibody Dynamics with Unilateral Contacts", Wiley 1996, chapters 6 and 8.
"""

from math import inf
from typing import NamedTuple, Self

from rig.core.laws.events import FLIGHT, NO_EVENT


class Row(NamedTuple):
    """The affine function gap (g - rest) + speed s + hold h + slider u + constant, in SI units.

    Its variables are the gap g, the speed s, the holding force h and the slider displacement u.

    For the force of a spring with a dashpot, `gap` is minus the stiffness, `speed` minus the damping, and `rest` the
    gap at which the spring is relaxed; `constant` is a force that does not depend on the motion, such as friction in
    one direction. The slider displacement u [m] is constant during a regime. A regime whose force depends on u begins
    with the force of the previous regime; u follows from this condition.
    """

    gap: float = 0.0
    speed: float = 0.0
    hold: float = 0.0
    rest: float = 0.0
    constant: float = 0.0
    slider: float = 0.0

    def at(self, gap: float, speed: float) -> float:
        """Return the value for a gap and a speed, without holding force and slider."""
        return self.gap * (gap - self.rest) + self.speed * speed + self.constant


GAP, SPEED, HOLD = Row(gap=1.0), Row(speed=1.0), Row(hold=1.0)


class Transition(NamedTuple):
    """The end of a regime at one end of a signal's interval.

    `to`: candidates for the next regime, which is the first that is consistent with the motion. `event`: kind of event
    in the log (`rig.core.laws.events`). `restitution`: ratio of rebound speed to closing speed; None: velocities do not
    jump.
    """

    to: tuple[str, ...]
    event: int = NO_EVENT
    restitution: float | None = None


class Signal(NamedTuple):
    """A row and the open interval in which its value remains during the regime; an infinite end has no transition."""

    row: Row
    low: float = -inf
    high: float = inf
    at_low: Transition | None = None
    at_high: Transition | None = None

    @property
    def ends(self) -> tuple[tuple[float, Transition | None], tuple[float, Transition | None]]:
        """Limit and transition at the lower and at the upper end."""
        return (self.low, self.at_low), (self.high, self.at_high)


class Regime(NamedTuple):
    """A regime: its signals, the force along the gap (None: held), and the wall that the element touches.

    `wall`: contact in results (`FLIGHT`, `FLOOR`, `CEILING`). `wall_gap`: gap of a held element [m].
    """

    signals: tuple[Signal, ...]
    force: Row | None = Row()
    wall: int = FLIGHT
    wall_gap: float = 0.0

    @property
    def ends_by_impact(self) -> bool:
        """Whether a transition of the regime is an impact, at which velocities jump."""
        transitions = (transition for signal in self.signals for _, transition in signal.ends)
        return any(transition is not None and transition.restitution is not None for transition in transitions)

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
    """A contact law: its regimes by name, the regime at the start, and its walls, the lower wall first."""

    regimes: dict[str, Regime]
    start: str
    walls: tuple[Wall, ...] = ()

    @property
    def key(self) -> tuple[object, ...]:
        """The content of the law, which can be hashed."""
        return tuple(self.regimes.items()), self.start

    @property
    def starts_at_rest(self) -> bool:
        """Whether the element is at rest on its body at the start: on a wall, or held by friction."""
        start = self.regimes[self.start]
        return start.wall != FLIGHT or start.force is None

    def regime_at(self, wall: int, gap: float) -> str:
        """Return the first regime with a gap [m], or at it within rounding, that touches a wall (`FLIGHT`: none)."""
        at_wall = [name for name, regime in self.regimes.items() if regime.wall == wall]
        containing = [
            name
            for name in at_wall
            if all(signal.low <= gap <= signal.high for signal in self.regimes[name].signals if signal.row == GAP)
        ]
        return (containing or at_wall)[0]

    @property
    def has_slider(self) -> bool:
        """Whether a force depends on a slider displacement."""
        return any(force is not None and force.slider for force in self.forces)

    def regime_for(self, gap: float, speed: float) -> str:
        """Return the first regime that contains a gap [m] and a speed [m/s], or else the regime at the start."""
        fitting = [
            name
            for name, regime in self.regimes.items()
            if all(signal.low <= signal.row.at(gap, speed) <= signal.high for signal in regime.signals)
        ]
        return (fitting or [self.start])[0]

    def reachable(self) -> Self:
        """Return the law with only the regimes that can follow from the regime at the start."""
        names = [self.start]
        for name in names:
            ends = [each for signal in self.regimes[name].signals for _, each in signal.ends if each is not None]
            names += dict.fromkeys(target for each in ends for target in each.to if target not in names)
        return self._replace(regimes={name: regime for name, regime in self.regimes.items() if name in names})

    @property
    def force_indices(self) -> dict[str, int]:
        """Number of each regime's force, equal for regimes with the same force, and for all regimes of a held element.

        The forces of two walls have two numbers even if they are equal, so no number depends on a parameter.
        """
        numbers: dict[tuple[Row | None, int], int] = {}
        return {
            name: numbers.setdefault((regime.force, regime.wall if regime.force is not None else FLIGHT), len(numbers))
            for name, regime in self.regimes.items()
        }

    @property
    def forces(self) -> tuple[Row | None, ...]:
        """Forces by their numbers in `force_indices`."""
        numbers = self.force_indices
        return tuple({numbers[name]: regime.force for name, regime in self.regimes.items()}.values())


def faults(law: Law) -> list[str]:
    """Return the faults of a declaration, in words; a correct law has none."""
    flaws = [] if law.start in law.regimes else [f"the start {law.start!r} is not a regime"]
    for name, regime in law.regimes.items():
        for signal in regime.signals:
            if not signal.low < signal.high:
                flaws.append(f"{name}: the interval from {signal.low} to {signal.high} is empty")
            if regime.force is not None and signal.row.hold:
                flaws.append(f"{name}: a signal is the holding force, but the regime is not held")
            if regime.force is None and not signal.row.hold:
                flaws.append(f"{name}: a signal is constant while the regime is held")
            for limit, transition in signal.ends:
                if (abs(limit) == inf) != (transition is None):
                    flaws.append(f"{name}: a limit of {limit} does not agree with the transition {transition}")
                flaws += [
                    f"{name}: the transition to {target!r} has no regime"
                    for target in (transition.to if transition is not None else ())
                    if target not in law.regimes
                ]
    return flaws
