"""Result of a propagation: states at sample instants, events and discontinuities.

An event is a change of the regime of one element, such as the bed of a damper. A discontinuity is an instant at which
velocities or accelerations jump. A segment is a time interval in which the drive is one smooth function, such as a
sample interval (`rig.core.engine.propagator`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.laws.events import EVENT_NAMES, FLIGHT, FLOOR
from rig.core.system.hybrid_system import HybridSystem

#: An event for users: time [s], number of the damper from 1, kind, closing speed [m/s].
EVENT = np.dtype([("time", "f8"), ("damper", "i4"), ("kind", "U10"), ("speed", "f8")])
#: An event in a scene with joints. For an event of a joint, `joint` is its number from 1 and `damper` is 0; for an
#: event of a damper the reverse.
EVENT_WITH_JOINT = np.dtype([*EVENT.descr, ("joint", "i4")])


@dataclass(frozen=True)
class Trajectory:
    """States, events and discontinuities over a number of segments.

    A table index identifies the tables of a contact configuration in `rig.core.engine.flow_tables.FlowTables`. An
    offset is the time after the start of the segment [s].
    """

    state: Array
    """State at each sample, after any discontinuity at this instant; shape (samples, states)."""
    table_index: NDArray[np.int64]
    """Table index of the configuration at each sample; shape (samples,)."""
    height: Array
    """Absolute position of each mass in flight [m], upwards; undefined on a wall; shape (samples, elements)."""
    contact: NDArray[np.int8]
    """FLIGHT, FLOOR or CEILING; shape (samples, elements)."""
    event_segment: NDArray[np.int64]
    """Number of the segment of each event; shape (events,)."""
    event_offset: Array
    """Offset of each event in its segment [s]; shape (events,)."""
    event_damper: NDArray[np.int64]
    """Number of the element of each event, from 0; shape (events,)."""
    event_kind: NDArray[np.int64]
    """Kind of each event, an index of `EVENT_NAMES`; shape (events,)."""
    event_speed: Array
    """Closing speed of each event [m/s]; shape (events,)."""
    discontinuity_segment: NDArray[np.int64]
    """Number of the segment of each discontinuity; shape (discontinuities,)."""
    discontinuity_offset: Array
    """Offset of each discontinuity in its segment [s]; shape (discontinuities,)."""
    state_before: Array
    """State before each discontinuity; shape (discontinuities, states)."""
    state_after: Array
    """State after each discontinuity; shape (discontinuities, states)."""
    damper_velocity_before: Array
    """Velocities of the dampers before each discontinuity [m/s]; shape (discontinuities, dampers)."""
    damper_velocity_after: Array
    """Velocities of the dampers after each discontinuity [m/s]; shape (discontinuities, dampers)."""
    table_index_before: NDArray[np.int64]
    """Table index before each discontinuity; shape (discontinuities,)."""
    table_index_after: NDArray[np.int64]
    """Table index after each discontinuity; shape (discontinuities,)."""


def event_type(system: HybridSystem) -> np.dtype[Any]:
    """Return the type of the events of a system."""
    return EVENT_WITH_JOINT if len(system.elements) > system.dampers else EVENT


def event_table(
    times: Array, damper: NDArray[np.int64], kind: NDArray[np.int64], speed: Array, system: HybridSystem
) -> NDArray[Any]:
    """Return events for users, with dtype `EVENT` or `EVENT_WITH_JOINT`: numbers as in the scene, kinds by name.

    `times`: s; `damper`: number of the element from 0; `kind`: index of `EVENT_NAMES`; `speed`: closing speed [m/s];
    all of shape (events,).
    """
    table = np.zeros(len(times), dtype=event_type(system))
    if not len(times):
        return table
    table["time"] = times
    for field, is_joint in (("damper", False), ("joint", True)):
        if field not in (table.dtype.names or ()):
            continue
        numbers = [element.number if element.is_joint == is_joint else 0 for element in system.elements]
        table[field] = np.array(numbers, dtype=np.int64)[damper]
    table["kind"] = EVENT_NAMES[kind]
    table["speed"] = speed
    return table


def events_at_start(started: NDArray[np.int64], system: HybridSystem) -> NDArray[Any]:
    """Return the events at t = 0 for users, with dtype as `event_table`.

    `started`: numbers of the elements from 0 and kinds, shape (2, events).
    """
    zeros = np.zeros(started.shape[1])
    return event_table(zeros, started[0], started[1], zeros, system)


def gaps_and_contacts(trajectory: Trajectory, system: HybridSystem) -> tuple[Array, NDArray[np.int8]]:
    """Return the gap of each damper, m, and its contact (`rig.core.laws.events`); both of shape (dampers, samples)."""
    positions = trajectory.state[:, system.damper_coordinate].T
    gap = trajectory.height.T[: system.dampers] - positions
    contact = trajectory.contact.T[: system.dampers]
    at_wall = np.take_along_axis(system.wall_gap[: system.dampers], np.maximum(contact - FLOOR, 0), axis=1)
    gap = np.maximum(np.where(contact == FLIGHT, gap, at_wall), 0.0)
    coordinates = system.gap_coordinate[: system.dampers]
    gap[coordinates >= 0] = trajectory.state[:, coordinates[coordinates >= 0]].T
    return gap, np.ascontiguousarray(contact)
