"""What is kept of a march at its samples: whole states, or what can be seen of the motion.

Both are filled inside the kernel, row by row, so that a march of any length costs one call.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.engine.flow import Flow, Model
from rig.engine.lasting import gap_of
from rig.engine.state import FLIGHT, FLOOR, SLOT, State
from rig.numerics.jit import inlined
from rig.numerics.simd import LANES, transpose


class StateSamples(NamedTuple):
    """Whole states at samples, rows of a `Trajectory`; without rows nothing is kept."""

    state: Array
    slot: NDArray[np.int64]
    height: Array
    mode: NDArray[np.int8]


class MotionSamples(NamedTuple):
    """What can be seen of the motion at samples, as in `rig.simulation.motion.Motion`; without columns nothing is.

    rows (displacements, velocities, accelerations, gaps; samples); contact (dampers, samples); begin (1,), the first
    column that is filled next; window (LANES, rows).
    """

    rows: Array
    contact: NDArray[np.int8]
    begin: NDArray[np.int64]
    window: Array


@inlined
def keep_state(state: State, row: int, kept: StateSamples) -> None:
    """Keep the present state in a row."""
    kept.slot[row] = state.counters[SLOT]
    for i in range(kept.state.shape[1]):
        kept.state[row, i] = state.z[i]
    for j in range(kept.height.shape[1]):
        kept.height[row, j] = state.height[j]
        kept.mode[row, j] = state.mode[j]


@inlined
def show_motion(flow: Flow, model: Model, state: State, seen: MotionSamples, column: int, last: bool) -> None:
    """Show the present motion in a column: by way of a window, because the rows lie far apart in memory."""
    row, points = column % LANES, model.first_velocity
    behind = flow.rates_constant.shape[1]
    for i in range(2 * points):
        seen.window[row, i] = state.z[i]
    for i in range(points):
        seen.window[row, 2 * points + i] = state.z[behind + i]
    for j in range(seen.contact.shape[0]):
        mode = state.mode[j]
        gap = 0.0 if mode == FLOOR else model.clearance[j]
        if model.bed[j] >= 0:
            gap = gap_of(model, state.z, j)
        elif mode == FLIGHT:
            gap = max(state.height[j] - state.z[model.position[j]], 0.0)
        seen.contact[j, column] = mode
        seen.window[row, 3 * points + j] = gap
    first = column - row
    if row == LANES - 1 and first >= seen.begin[0]:
        transpose(seen.window, seen.rows, first)
    elif row == LANES - 1 or last:
        for there in range(max(first, seen.begin[0]), column + 1):
            for i in range(seen.rows.shape[0]):
                seen.rows[i, there] = seen.window[there % LANES, i]
