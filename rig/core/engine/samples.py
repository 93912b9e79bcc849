"""Results of a propagation at its sample instants: states, or the motion (displacement, velocity, acceleration, gap).

The kernel fills both sample by sample, so that a propagation of any length is one call of compiled code.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.engine.flow import Model
from rig.core.engine.state import TABLE_INDEX, State, regime_number
from rig.core.numerics.jit import inlined_kernel
from rig.core.numerics.simd import LANES, transpose, unsigned


class StateSamples(NamedTuple):
    """States at sample instants, one row each; fields as in `Trajectory`. Without rows no state is stored."""

    state: Array
    table_index: NDArray[np.int64]
    height: Array
    contact: NDArray[np.int8]


class MotionSamples(NamedTuple):
    """Motion at sample instants, as in `rig.core.simulation.motion.Motion`; without columns no motion is stored.

    rows: displacements, velocities, accelerations and gaps in SI units, shape (rows, samples). contact: wall that each
    damper touches (`rig.core.laws.events`), shape (dampers, samples). first_column: first column that this propagation
    fills, shape (1,). buffer: the last samples, which are not yet transposed into `rows`, shape (LANES, rows).
    """

    rows: Array
    contact: NDArray[np.int8]
    first_column: NDArray[np.int64]
    buffer: Array


@inlined_kernel
def store_state(model: Model, state: State, row: int, states: StateSamples) -> None:
    """Store the present state in a row of `states`."""
    states.table_index[row] = state.counters[TABLE_INDEX]
    for i in range(states.state.shape[1]):
        states.state[row, i] = state.z[i]
    for j in range(states.height.shape[1]):
        states.height[row, j] = state.height[j]
        states.contact[row, j] = model.laws.regimes[regime_number(model.laws.elements, state.regime, j)].wall


@inlined_kernel
def store_motion(model: Model, state: State, motion: MotionSamples, column: int, last: bool) -> None:
    """Store the present motion in a column of `motion`.

    `LANES` samples are buffered before they are written, because the rows are far apart in memory. `last`: whether this
    is the last sample of the propagation.
    """
    row, coordinates = column % LANES, model.first_velocity
    for i in range(2 * coordinates):
        motion.buffer[row, i] = state.z[i]
    for i in range(coordinates):
        motion.buffer[row, 2 * coordinates + i] = state.z[model.first_acceleration + i]
    for j in range(motion.contact.shape[0]):
        m = regime_number(model.laws.elements, state.regime, j)
        gap = model.laws.regimes[m].wall_gap
        if model.laws.elements[j].gap_coordinate >= 0:
            gap = state.z[model.laws.elements[j].gap_coordinate]
        elif model.laws.regimes[m].flies > 0.0:
            gap = max(state.height[j] - state.z[model.laws.elements[j].position_index], 0.0)
        motion.contact[j, unsigned(column)] = model.laws.regimes[m].wall
        motion.buffer[unsigned(row), unsigned(3 * coordinates + j)] = gap
    first = column - row
    if row == LANES - 1 and first >= motion.first_column[0]:
        transpose(motion.buffer, motion.rows, first)
    elif row == LANES - 1 or last:
        for sample in range(max(first, motion.first_column[0]), column + 1):
            for i in range(motion.rows.shape[0]):
                motion.rows[i, sample] = motion.buffer[sample % LANES, i]
