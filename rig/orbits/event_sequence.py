"""The sequence of events of a periodic orbit: derivation from a simulated cycle, and labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.engine.state import CEILING_IMPACT, CEILING_TOUCH, FLOOR_IMPACT, FLOOR_TOUCH
from rig.engine.state import RELEASE as RELEASED
from rig.engine.trajectory import Trajectory
from rig.errors import UncoveredMotionError
from rig.orbits.orbit_equations import (
    CEILING,
    CEILING_BOUNCE,
    FLOOR,
    FLOOR_BOUNCE,
    FLYING,
    FORCELESS,
    ON_CEILING,
    ON_FLOOR,
    PRESS_CEILING,
    PRESS_FLOOR,
    RELEASE,
    RIDES_CEILING,
    RIDES_FLOOR,
    SEPARATION,
    TOUCH_CEILING,
    TOUCH_FLOOR,
    WITH_LAST,
    Sequence,
)
from rig.system.hybrid_system import HybridSystem

BOUNCE = {FLOOR: FLOOR_BOUNCE, CEILING: CEILING_BOUNCE}
#: Wall of a damper after an event, or flight.
AFTER = {
    SEPARATION: FLYING,
    WITH_LAST: FLYING,
    FLOOR_BOUNCE: FLYING,
    CEILING_BOUNCE: FLYING,
    FLOOR: RIDES_FLOOR,
    CEILING: RIDES_CEILING,
    TOUCH_FLOOR: ON_FLOOR,
    PRESS_FLOOR: ON_FLOOR,
    TOUCH_CEILING: ON_CEILING,
    PRESS_CEILING: ON_CEILING,
    RELEASE: FORCELESS,
}
#: Overlap, relative to the largest gap, above which a new contact force is a press event instead of a touch.
WITHIN = 1e-9


@dataclass(frozen=True)
class Plan:
    """An orbit's sequence of events, with the configurations of its slots."""

    sequence: Sequence
    configurations: tuple[int, ...]
    """As in `HybridSystem.toggles`."""
    repetition: int
    """Length in periods of the drive."""

    @property
    def flying(self) -> NDArray[np.int64]:
        """Dampers in flight at the start."""
        return np.flatnonzero(self.sequence.wall[0] == FLYING)

    @property
    def label(self) -> str:
        """The events in short, e.g. ``"2^ 2- 2_"``: damper 2 separates, bounces off the ceiling, lands.

        With finite-duration contact: touch of floor ``u`` or ceiling ``n``, release ``o``, renewed press ``w``,
        ``m``.
        """
        signs = {
            SEPARATION: "^",
            FLOOR: "_",
            CEILING: "=",
            FLOOR_BOUNCE: "v",
            CEILING_BOUNCE: "-",
            WITH_LAST: "~",
            TOUCH_FLOOR: "u",
            TOUCH_CEILING: "n",
            PRESS_FLOOR: "w",
            PRESS_CEILING: "m",
            RELEASE: "o",
        }
        pairs = zip(self.sequence.damper, self.sequence.kind, strict=True)
        return " ".join(f"{d + 1}{signs[int(k)]}" for d, k in pairs)

    @property
    def borders(self) -> tuple[str, ...]:
        """Names of the borders in the order of the flattened `rig.orbits.admissibility.margins`."""
        events, dampers = self.label.split(), self.sequence.damper + 1
        count = max(len(events), self.sequence.wall.shape[1], 1)
        pairs = zip(events, events[1:] + events[:1], strict=True)
        names: list[list[str]] = [
            [f"event {one} and event {other} change order" for one, other in pairs],
            [f"damper {number} is not released" for number in dampers],
            [f"damper {number} misses the wall that it should hit" for number in dampers],
        ]
        for text in (
            "the flight of damper {} vanishes",
            "damper {} hits the floor early",
            "damper {} hits the ceiling early",
            "damper {} leaves its wall early",
            "damper {} stays at the wall that it should leave at once",
            "damper {} is kicked off its wall by the impact of another",
        ):
            names.append([text.format(number) for number in range(1, count + 1)])
        return tuple(name for row in names for name in [*row, *[""] * (count - len(row))])

    def same_cycle(self, other: Plan) -> bool:
        """Whether the events are the same in the same cyclic order."""
        own, others = self.label.split(), other.label.split()
        return len(own) == len(others) and (own == others or " ".join(own) in " ".join(others + others))


def plan_from(
    trajectory: Trajectory, start: NDArray[np.int8], repetition: int, system: HybridSystem
) -> tuple[Plan, Array]:
    """Derive the sequence of events from a simulated cycle.

    `course`: events of the cycle; `start`, shape (dampers,): contact state at its start; `repetition`: periods in
    the cycle. Returns `order`, positions of the plan's events among the events of the cycle. Raises
    `UncoveredMotionError` if a damper with rebound comes to rest on a wall after infinitely many impacts; or the
    impact of another damper throws a damper from its wall, through a full mass matrix or a common body.
    """
    kinds: list[int] = []
    dampers: list[int] = []
    order: list[int] = []
    instants = list(zip(trajectory.event_segment.tolist(), trajectory.event_offset.tolist(), strict=True))
    for k, (damper, kind) in enumerate(
        zip(trajectory.event_damper.tolist(), trajectory.event_kind.tolist(), strict=True)
    ):
        now = [i for i in range(len(order)) if instants[order[i]] == instants[k]]
        hit = [i for i in now if dampers[i] == damper and kinds[i] in (FLOOR, CEILING)]
        if system.coupled and any(dampers[i] != damper for i in now):
            raise UncoveredMotionError(
                f"an impact of damper {damper + 1} acts on damper {dampers[now[-1]] + 1} at the same "
                "instant, through a common body or the mass matrix"
            )
        if system.lasting[damper]:
            kinds.append(_lasting_kind(trajectory, k, system))
        elif kind in (FLOOR_IMPACT, CEILING_IMPACT):
            landed = FLOOR if kind == FLOOR_IMPACT else CEILING
            kinds.append(landed if system.restitution[damper] == 0 else BOUNCE[landed])
        elif hit:
            # Impact and separation at the same instant are one event, a bounce, without contact in between.
            kinds[hit[-1]] = BOUNCE[kinds[hit[-1]]]
            continue
        elif system.restitution[damper] > 0:
            raise UncoveredMotionError(
                f"damper {damper + 1} rebounds infinitely often in every period until it rests on a wall"
            )
        else:
            kinds.append(WITH_LAST if now else SEPARATION)
        dampers.append(damper)
        order.append(k)
    return make_plan(kinds, dampers, walls_of(start, system), repetition), np.array(order, dtype=np.int64)


def _lasting_kind(trajectory: Trajectory, event: int, system: HybridSystem) -> int:
    """Return the kind of an event with finite-duration contact: a press event starts with overlap."""
    kind, damper = trajectory.event_kind[event], trajectory.event_damper[event]
    if kind == RELEASED:
        return RELEASE
    now = (trajectory.break_segment == trajectory.event_segment[event]) & (
        trajectory.break_offset == trajectory.event_offset[event]
    )
    gaps = trajectory.before[:, system.bed[damper]]
    gap, least = gaps[np.flatnonzero(now)[0]], WITHIN * np.abs(gaps).max()
    if kind == FLOOR_TOUCH:
        return PRESS_FLOOR if gap < -least else TOUCH_FLOOR
    assert kind == CEILING_TOUCH
    return PRESS_CEILING if gap > system.clearance[damper] + least else TOUCH_CEILING


def walls_of(mode: NDArray[Any], system: HybridSystem) -> NDArray[np.int64]:
    """Return the walls of a sequence for the engine's contact states, shape (dampers,)."""
    return np.asarray(mode, dtype=np.int64) + np.where(system.lasting, FORCELESS, FLYING)


def mode_of(walls: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the engine's contact states for walls of a sequence, shape (dampers,)."""
    return np.where(walls >= FORCELESS, walls - FORCELESS, walls)


def configuration_of(walls: NDArray[np.int64]) -> int:
    """Return the configuration for walls of a sequence, as in `HybridSystem.toggles`."""
    pressed = np.flatnonzero((walls != FLYING) & (walls != FORCELESS)).tolist()
    ceilings = np.flatnonzero(walls == ON_CEILING).tolist()
    return sum(1 << j for j in pressed) + sum(1 << len(walls) + j for j in ceilings)


def make_plan(kinds: list[int], dampers: list[int], start: NDArray[Any], repetition: int) -> Plan:
    """Build a plan from events and the walls at the start."""
    walls = [np.asarray(start, dtype=np.int64)]
    for kind, damper in zip(kinds, dampers, strict=True):
        wall = walls[-1].copy()
        wall[damper] = AFTER[kind]
        walls.append(wall)
    masks = [configuration_of(wall) for wall in walls]
    configurations = tuple(dict.fromkeys(masks))
    sequence = Sequence(
        np.array(kinds, dtype=np.int64),
        np.array(dampers, dtype=np.int64),
        np.array([configurations.index(mask) for mask in masks], dtype=np.int64),
        np.array(walls, dtype=np.int64),
    )
    return Plan(sequence, configurations, repetition)
