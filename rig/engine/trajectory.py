"""Result of a propagation: states at samples, events and breaks; its events, gaps and contacts for users."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.engine.state import CEILING_IMPACT, CEILING_TOUCH, FLIGHT, FLOOR, FLOOR_IMPACT, FLOOR_TOUCH
from rig.system.hybrid_system import HybridSystem

EVENT = np.dtype([("time", "f8"), ("damper", "i4"), ("kind", "U10"), ("speed", "f8")])
#: Kinds of events at which a damper comes into contact with a wall.
CONTACT_EVENTS = (FLOOR_IMPACT, CEILING_IMPACT, FLOOR_TOUCH, CEILING_TOUCH)
EVENT_NAMES = np.array(["separation", "floor", "ceiling", "touch", "touch", "release"])


@dataclass(frozen=True)
class Trajectory:
    """States, events and breaks over a number of segments."""

    state: Array
    """State at each sample, after any break at this instant; shape (samples, states)."""
    slot: NDArray[np.int64]
    """The table of the configuration at each sample; shape (samples,)."""
    height: Array
    """Height of each damper in flight, m; undefined at rest; shape (samples, dampers)."""
    mode: NDArray[np.int8]
    """FLIGHT, FLOOR or CEILING; shape (samples, dampers)."""
    event_segment: NDArray[np.int64]
    event_offset: Array
    event_damper: NDArray[np.int64]
    event_kind: NDArray[np.int64]
    event_speed: Array
    """Offsets in seconds after the start of the segment; dampers from 0; shape (events,)."""
    break_segment: NDArray[np.int64]
    break_offset: Array
    """break_segment, break_offset: shape (breaks,)."""
    before: Array
    after: Array
    """before, after: shape (breaks, states)."""
    speed_before: Array
    speed_after: Array
    """Own velocities of the dampers, m/s; shape (breaks, dampers)."""
    before_slot: NDArray[np.int64]
    after_slot: NDArray[np.int64]
    """before_slot, after_slot: shape (breaks,)."""


def event_table(
    times: Array, damper: NDArray[np.int64], kind: NDArray[np.int64], speed: Array, system: HybridSystem
) -> NDArray[Any]:
    """Return events for users: dampers by their number in the scene, kinds by name."""
    table = np.zeros(len(times), dtype=EVENT)
    if not len(times):
        return table
    table["time"] = times
    table["damper"] = system.damper_number[damper]
    table["kind"] = EVENT_NAMES[kind]
    table["speed"] = speed
    return table


def gaps_and_contacts(trajectory: Trajectory, system: HybridSystem) -> tuple[Array, NDArray[np.int8]]:
    """Return the gap above each floor, m, and the contact state; both of shape (dampers, samples)."""
    positions = trajectory.state[:, system.damper_coordinate].T
    gap = trajectory.height.T - positions
    mode = trajectory.mode.T
    ceiling = np.broadcast_to(system.clearance[:, None], gap.shape)
    gap = np.maximum(np.where(mode == FLIGHT, gap, np.where(mode == FLOOR, 0.0, ceiling)), 0.0)
    gap[system.finite_contact] = trajectory.state[:, system.bed[system.finite_contact]].T
    return gap, np.ascontiguousarray(mode)
