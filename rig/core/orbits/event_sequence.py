"""The sequence of events of a periodic orbit: its derivation from a simulated cycle, and its label for users.

An event is a change of the contact state of one damper. Beyond a *border* in the parameter, the sequence is impossible.
The engine describes the *contact* of a damper as flight or one of two walls. An orbit describes it by a *wall state*,
which also distinguishes finite-duration contact (`rig.core.orbits.event_kinds`).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.base.errors import UncoveredMotionError
from rig.core.engine.trajectory import Trajectory
from rig.core.laws.events import CEILING_IMPACT, CEILING_TOUCH, FLIGHT, FLOOR_IMPACT, FLOOR_TOUCH, RELEASE, SLIP, STOP
from rig.core.laws.law import Law, Signal, Transition
from rig.core.orbits import event_kinds as kinds
from rig.core.orbits.orbit_equations import Sequence
from rig.core.system.hybrid_system import Element, HybridSystem

BOUNCE = {kinds.FLOOR: kinds.FLOOR_BOUNCE, kinds.CEILING: kinds.CEILING_BOUNCE}
#: Wall state of a damper after an event.
WALL_AFTER_EVENT = {
    kinds.SEPARATION: kinds.FLYING,
    kinds.INDUCED_SEPARATION: kinds.FLYING,
    kinds.FLOOR_BOUNCE: kinds.FLYING,
    kinds.CEILING_BOUNCE: kinds.FLYING,
    kinds.FLOOR: kinds.RIDES_FLOOR,
    kinds.CEILING: kinds.RIDES_CEILING,
    kinds.TOUCH_FLOOR: kinds.ON_FLOOR,
    kinds.PRESS_FLOOR: kinds.ON_FLOOR,
    kinds.TOUCH_CEILING: kinds.ON_CEILING,
    kinds.PRESS_CEILING: kinds.ON_CEILING,
    kinds.RELEASE: kinds.WITHOUT_FORCE,
}
#: Overlap, relative to the largest gap, above which a new contact force is a press event instead of a touch.
MIN_RELATIVE_OVERLAP = 1e-9


@dataclass(frozen=True)
class Plan:
    """An orbit's sequence of events, with the different contact configurations between them."""

    sequence: Sequence
    configurations: tuple[int, ...]  # As in `HybridSystem.strides`
    repetition: int  # Duration in periods of the drive
    joints: tuple[str, ...] = ()  # Names of the joints, which are the last elements

    @property
    def flying(self) -> NDArray[np.int64]:
        """Dampers in flight at the start."""
        return np.flatnonzero(self.sequence.wall[0] == kinds.FLYING)

    def instants(self, unknowns: Array) -> Array:
        """Return the instants of the events [s]: the last elements of an orbit's unknowns."""
        return unknowns[len(unknowns) - len(self.sequence.kind) :]

    @property
    def label(self) -> str:
        r"""Abbreviated events, e.g. ``"2^ 2- 2_"``: damper 2 separates, bounces off the ceiling, lands.

        With finite-duration contact: touch of floor ``u`` or ceiling ``n``, release ``o``, renewed press ``w``,
        ``m``. With friction: slip upwards ``/`` or downwards ``\\``, stop ``|``, reversal without rest ``x``.
        """
        symbols = {
            kinds.SEPARATION: "^",
            kinds.FLOOR: "_",
            kinds.CEILING: "=",
            kinds.FLOOR_BOUNCE: "v",
            kinds.CEILING_BOUNCE: "-",
            kinds.INDUCED_SEPARATION: "~",
            kinds.TOUCH_FLOOR: "u",
            kinds.TOUCH_CEILING: "n",
            kinds.PRESS_FLOOR: "w",
            kinds.PRESS_CEILING: "m",
            kinds.RELEASE: "o",
            kinds.SLIP_LOW: "/",
            kinds.SLIP_HIGH: "\\",
            kinds.STOP: "|",
            kinds.REVERSE: "x",
        }
        events = zip(self.sequence.damper, self.sequence.kind, strict=True)
        return " ".join(f"{damper + 1}{symbols[int(kind)]}" for damper, kind in events)

    @cached_property
    def borders(self) -> tuple[str, ...]:
        """Names of the borders in the order of the flattened `rig.core.orbits.admissibility.margins`."""
        events, elements = self.label.split(), self.sequence.wall.shape[1]
        element_names = [f"damper {j + 1}" for j in range(elements - len(self.joints))] + list(self.joints)
        own_names = [element_names[j] for j in self.sequence.damper]
        count = max(len(events), elements, 1)
        pairs = zip(events, events[1:] + events[:1], strict=True)
        names: list[list[str]] = [
            [f"event {first} and event {second} change order" for first, second in pairs],
            [
                f"{name} {'does not stop' if kind in (kinds.STOP, kinds.REVERSE) else 'is not released'}"
                for name, kind in zip(own_names, self.sequence.kind, strict=True)
            ],
            [f"{name} misses the wall that it should hit" for name in own_names],
        ]
        for template in (
            "the flight of {} vanishes",
            "{} hits the floor early",
            "{} hits the ceiling early",
            "{} leaves its wall early",
            "{} stays at the wall that it should leave immediately",
            "{} separates from its wall by the impact of another damper",
            "{} slips early",
            "{} stops early",
            "{} sticks where it should reverse",
        ):
            names.append([template.format(name) for name in element_names])
        return tuple(name for row in names for name in [*row, *[""] * (count - len(row))])

    def has_same_cycle(self, other: "Plan") -> bool:
        """Return whether the events of both plans are equal after a cyclic shift."""
        events, others = self.label.split(), other.label.split()
        return len(events) == len(others) and (events == others or " ".join(events) in " ".join(others + others))


def derive_plan(
    trajectory: Trajectory, start: NDArray[np.int64], end: NDArray[np.int64], repetition: int, system: HybridSystem
) -> tuple[Plan, Array]:
    """Derive the sequence of events from a simulated cycle.

    `start`, `end`, shape (dampers,): regimes at both ends of the cycle; `repetition`: drive periods in the cycle.
    Returns the plan, and the indices of its events among the events of the cycle. Raises `UncoveredMotionError` if a
    damper changes its contact at the instant of an impact of another damper to which it is coupled by a full mass
    matrix or a common body.
    """
    events: list[int] = []
    dampers: list[int] = []
    order: list[int] = []  # index of each event of the plan in the trajectory
    instants = list(zip(trajectory.event_segment.tolist(), trajectory.event_offset.tolist(), strict=True))
    finite_contact, restitution = system.finite_contact.tolist(), system.element_restitution.tolist()
    for k, (damper, kind) in enumerate(
        zip(trajectory.event_damper.tolist(), trajectory.event_kind.tolist(), strict=True)
    ):
        simultaneous = [i for i in range(len(order)) if instants[order[i]] == instants[k]]
        impacts = [i for i in simultaneous if dampers[i] == damper and events[i] in (kinds.FLOOR, kinds.CEILING)]
        if any(dampers[i] != damper for i in simultaneous) and system.impacts_interact:
            raise UncoveredMotionError(
                f"an impact of {system.elements[damper].name} acts on "
                f"{system.elements[dampers[simultaneous[-1]]].name} at the same instant, through a common body or the "
                "mass matrix"
            )
        previous = [i for i in simultaneous if dampers[i] == damper]
        if finite_contact[damper]:
            events.append(_finite_contact_kind(trajectory, k, system))
        elif kind == SLIP and previous and events[previous[-1]] == kinds.STOP:
            events[previous[-1]] = kinds.REVERSE
            continue
        elif kind == STOP:
            events.append(kinds.STOP)
        elif kind == SLIP and not previous:
            events.append(_slip_kind(trajectory, k, system))
        elif kind in (FLOOR_IMPACT, CEILING_IMPACT):
            impact = kinds.FLOOR if kind == FLOOR_IMPACT else kinds.CEILING
            events.append(impact if restitution[damper] == 0 else BOUNCE[impact])
        elif impacts:
            # Impact and separation at the same instant are one event, a bounce, without contact in between.
            events[impacts[-1]] = BOUNCE[events[impacts[-1]]]
            continue
        else:
            events.append(kinds.INDUCED_SEPARATION if simultaneous else kinds.SEPARATION)
        dampers.append(damper)
        order.append(k)
    for damper in {damper for damper in dampers if restitution[damper] > 0.0}:
        own = [i for i, each in enumerate(dampers) if each == damper]
        # In a closed cycle, the first event follows the last.
        _end_rebounds(events, own + own[:1] if start[damper] == end[damper] else own)
    plan = make_plan(events, dampers, walls_from_regimes(start, system), repetition, system)
    return plan, np.array(order, dtype=np.int64)


def _end_rebounds(events: list[int], own: list[int]) -> None:
    """Replace, in place, the last of infinitely many rebounds with an impact after which the damper is at rest.

    The simulation ends such a sequence when a rebound is within rounding error. The orbit has the same number of
    impacts. A damper that separates from the wall next must have been at rest on it. `own`: indices of the damper's
    events.
    """
    leaves = (kinds.SEPARATION, kinds.INDUCED_SEPARATION, kinds.SLIP_LOW, kinds.SLIP_HIGH)
    impact = {bounce: kind for kind, bounce in BOUNCE.items()}
    for last, following in pairwise(own):
        if events[following] in leaves:
            events[last] = impact.get(events[last], events[last])


def _finite_contact_kind(trajectory: Trajectory, event: int, system: HybridSystem) -> int:
    """Return the kind of an event of finite-duration contact; a press event begins with overlap, a touch without."""
    kind, damper = trajectory.event_kind[event], trajectory.event_damper[event]
    if kind == RELEASE:
        return kinds.RELEASE
    is_event = (trajectory.discontinuity_segment == trajectory.event_segment[event]) & (
        trajectory.discontinuity_offset == trajectory.event_offset[event]
    )
    gaps = system.elements[damper].along_gap(trajectory.state_before)
    gap, min_overlap = gaps[np.flatnonzero(is_event)[0]], MIN_RELATIVE_OVERLAP * np.abs(gaps).max()
    lower, upper = system.wall_gap[damper].tolist()
    if kind == FLOOR_TOUCH:
        return kinds.PRESS_FLOOR if gap < lower - min_overlap else kinds.TOUCH_FLOOR
    assert kind == CEILING_TOUCH
    return kinds.PRESS_CEILING if gap > upper + min_overlap else kinds.TOUCH_CEILING


def _slip_kind(trajectory: Trajectory, event: int, system: HybridSystem) -> int:
    """Return the kind of a slip by the direction in which the gap changes until the next discontinuity of the cycle."""
    is_event = (trajectory.discontinuity_segment == trajectory.event_segment[event]) & (
        trajectory.discontinuity_offset == trajectory.event_offset[event]
    )
    gaps = system.elements[trajectory.event_damper[event]].along_gap(trajectory.state_before)
    changes = np.roll(gaps, -int(np.flatnonzero(is_event)[0]))
    changes -= changes[0]
    return kinds.SLIP_LOW if changes[np.flatnonzero(changes)[0]] > 0.0 else kinds.SLIP_HIGH


def walls_from_regimes(regimes: NDArray[np.int64], system: HybridSystem) -> NDArray[np.int64]:
    """Convert the regimes of the dampers in the engine to the wall states of an event sequence, shape (dampers,)."""
    laws = [element.law for element in system.elements]
    walls = np.array(
        [list(law.regimes.values())[regime].wall for law, regime in zip(laws, regimes.tolist(), strict=True)]
    )
    has_force = ~system.detached & (system.finite_contact | (walls == FLIGHT))
    states = walls + np.where(has_force, kinds.WITHOUT_FORCE, kinds.FLYING)
    return np.where(slides(system), kinds.REGIMES + regimes, states).astype(np.int64)


def slides(system: HybridSystem) -> NDArray[np.bool_]:
    """Return whether each element slides with friction, so it can stick away from its walls; shape (elements,)."""
    laws = [element.law for element in system.elements]
    sticks = [any(regime.force is None and regime.wall == FLIGHT for regime in law.regimes.values()) for law in laws]
    return np.array([each or law.has_slider for each, law in zip(sticks, laws, strict=True)], dtype=bool)


def _regime(element: Element, wall: int, gap: float) -> str:
    """Return the regime of an element for a wall code of an event sequence; `gap` [m] decides between equal codes."""
    if wall >= kinds.REGIMES:
        return list(element.law.regimes)[wall - kinds.REGIMES]
    return element.law.regime_at(wall % kinds.WITHOUT_FORCE, gap)


def regimes_from_walls(walls: NDArray[np.int64], z: Array, system: HybridSystem) -> list[int]:
    """Return the regime numbers of all elements for the wall codes of an event sequence and the states `z`."""
    # A damper without contact force may still overlap a wall from which it was released.
    return [
        list(element.law.regimes).index(_regime(element, wall, float(element.along_gap(z))))
        for wall, element in zip(walls.tolist(), system.elements, strict=True)
    ]


def configuration_of(walls: list[int], system: HybridSystem) -> int:
    """Return the configuration for wall states of a sequence."""
    return system.configuration(
        [_regime(element, wall, 0.0) for wall, element in zip(walls, system.elements, strict=True)]
    )


def _regime_after(law: Law, regime: int, kind: int) -> int:
    """Return the number of the regime of a sliding mass after an event."""
    names, signals = list(law.regimes), list(law.regimes.values())[regime].signals

    def targets(signals: tuple[Signal, ...], row: str, end: int | None = None) -> tuple[str, ...]:
        ends = [signal.ends for signal in signals if getattr(signal.row, row)]
        transitions: list[Transition | None] = [pair[e][1] for pair in ends for e in (0, 1) if end in (None, e)]
        return next(transition.to for transition in transitions if transition is not None)

    if kind in (kinds.FLOOR, kinds.CEILING, kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE):
        end = int(kind in (kinds.CEILING, kinds.CEILING_BOUNCE))
        is_bounce = kind in (kinds.FLOOR_BOUNCE, kinds.CEILING_BOUNCE)
        name = targets(signals, "gap", end)[0 if is_bounce else -1]
        if is_bounce and law.regimes[name].force is None:  # an impact without rebound, and an immediate separation
            name = targets(law.regimes[name].signals, "hold")[0]
    elif kind in (kinds.STOP, kinds.REVERSE):
        name = targets(signals, "speed")[0]
        if kind == kinds.REVERSE:
            moves_up = any(signal.row.speed and signal.low == 0.0 for signal in signals)
            name = targets(law.regimes[name].signals, "hold", int(moves_up))[0]
    else:
        row = "slider" if law.has_slider else "hold"
        name = targets(signals, row, {kinds.SLIP_LOW: 0, kinds.SLIP_HIGH: 1}.get(kind))[0]
    return names.index(name)


def make_plan(
    events: list[int], dampers: list[int], start: NDArray[Any], repetition: int, system: HybridSystem
) -> Plan:
    """Build a plan from the kinds of its events, their dampers, and the wall states at the start."""
    walls: list[list[int]] = [start.tolist()]
    for kind, damper in zip(events, dampers, strict=True):
        wall = walls[-1].copy()
        if wall[damper] >= kinds.REGIMES:
            wall[damper] = kinds.REGIMES + _regime_after(
                system.elements[damper].law, wall[damper] - kinds.REGIMES, kind
            )
        else:
            wall[damper] = WALL_AFTER_EVENT[kind]
            if wall[damper] == kinds.FLYING and not system.detached[damper]:
                wall[damper] = kinds.WITHOUT_FORCE
        walls.append(wall)
    segment_configurations = [configuration_of(wall, system) for wall in walls]
    configurations = tuple(dict.fromkeys(segment_configurations))
    sequence = Sequence(
        np.array(events, dtype=np.int64),
        np.array(dampers, dtype=np.int64),
        np.array([configurations.index(configuration) for configuration in segment_configurations], dtype=np.int64),
        np.array(walls, dtype=np.int64),
    )
    joints = tuple(element.name for element in system.elements if element.is_joint)
    return Plan(sequence, configurations, repetition, joints)
