"""The sequence of events of a periodic orbit: read off a simulated cycle, and named."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.engine.state import CEILING_IMPACT, FLOOR_IMPACT
from rig.engine.trajectory import Trajectory
from rig.errors import RunError
from rig.orbits.orbit_equations import (
    CEILING,
    CEILING_BOUNCE,
    FLOOR,
    FLOOR_BOUNCE,
    SEPARATION,
    WITH_LAST,
    Sequence,
)
from rig.system.hybrid_system import HybridSystem

Array = NDArray[np.float64]
BOUNCE = {FLOOR: FLOOR_BOUNCE, CEILING: CEILING_BOUNCE}


@dataclass(frozen=True)
class Plan:
    """An orbit's sequence of events, with the configurations behind its slots."""

    sequence: Sequence
    configurations: tuple[int, ...]  # bit j set: damper j rides
    repetition: int
    """Length in periods of the drive."""

    @property
    def flying(self) -> NDArray[np.int64]:
        """Dampers in flight at the start."""
        return np.flatnonzero(self.sequence.wall[0] == 0)

    @property
    def label(self) -> str:
        """The events in short, e.g. ``"2^ 2- 2_"``: damper 2 separates, bounces off the ceiling, lands."""
        signs = {
            SEPARATION: "^",
            FLOOR: "_",
            CEILING: "=",
            FLOOR_BOUNCE: "v",
            CEILING_BOUNCE: "-",
            WITH_LAST: "~",
        }
        pairs = zip(self.sequence.damper, self.sequence.kind, strict=True)
        return " ".join(f"{d + 1}{signs[int(k)]}" for d, k in pairs)

    @property
    def borders(self) -> tuple[str, ...]:
        """Names of the borders in the order of `rig.orbits.admissibility.margins`, made flat."""
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
    """Read the sequence of events off a simulated cycle.

    Parameters
    ----------
    course : Trajectory
        Events of the cycle.
    start : ndarray of int8, shape (dampers,)
        Walls at its start.
    repetition : int
        Periods in the cycle.

    Returns
    -------
    order : ndarray
        Positions of the plan's events among the course's.

    Raises
    ------
    RunError
        If a damper that rebounds comes to rest on a wall, after impacts without end; or one is thrown off its wall
        by another's impact, through a full mass matrix or the body of both.
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
            raise RunError(
                f"an impact of a damper is felt by another at once (dampers {damper + 1} and {dampers[now[-1]] + 1}, "
                "coupled by their body or the mass matrix), for which orbits are not computed; a settled simulation "
                "(rig.frequency_response) covers it"
            )
        if kind in (FLOOR_IMPACT, CEILING_IMPACT):
            landed = FLOOR if kind == FLOOR_IMPACT else CEILING
            kinds.append(landed if system.restitution[damper] == 0 else BOUNCE[landed])
        elif hit:
            # It hit in this very instant: one event, a bounce, and no stay in between.
            kinds[hit[-1]] = BOUNCE[kinds[hit[-1]]]
            continue
        elif system.restitution[damper] > 0:
            raise RunError(
                f"damper {damper + 1} rebounds ever lower until it rests on a wall: impacts without end in every "
                "period, for which orbits are not computed; a settled simulation (rig.frequency_response) covers it"
            )
        else:
            kinds.append(WITH_LAST if now else SEPARATION)
        dampers.append(damper)
        order.append(k)
    return make_plan(kinds, dampers, start, repetition), np.array(order, dtype=np.int64)


def make_plan(kinds: list[int], dampers: list[int], start: NDArray[Any], repetition: int) -> Plan:
    """Build a plan from events and the walls at the start."""
    walls = [np.asarray(start, dtype=np.int64)]
    after = dict.fromkeys((SEPARATION, WITH_LAST, FLOOR_BOUNCE, CEILING_BOUNCE), 0) | {FLOOR: 1, CEILING: 2}
    for kind, damper in zip(kinds, dampers, strict=True):
        wall = walls[-1].copy()
        wall[damper] = after[kind]
        walls.append(wall)
    masks = [sum(1 << int(j) for j in np.flatnonzero(wall)) for wall in walls]
    configurations = tuple(dict.fromkeys(masks))
    sequence = Sequence(
        np.array(kinds, dtype=np.int64),
        np.array(dampers, dtype=np.int64),
        np.array([configurations.index(mask) for mask in masks], dtype=np.int64),
        np.array(walls, dtype=np.int64),
    )
    return Plan(sequence, configurations, repetition)
