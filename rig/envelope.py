"""The cheapest proof that nothing happens in a step: an envelope of the state's size, and margins of the guards.

As long as no state outgrows the envelope, no guard can sag by more than its margin below its values at the ends of
a step; while those stay above the margins there is nothing to examine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.contact import FLIGHT, FLOOR, ROUNDING, State
from rig.flow import Flow, Model
from rig.jit import inlined
from rig.lanes import combine
from rig.scratch import Scratch

Array = NDArray[np.float64]

#: An envelope is drawn this much wider than the state is large.
WIDER = 2.0


@inlined
def fold_envelope(flow: Flow, scratch: Scratch) -> None:
    """Begin the envelope anew."""
    for i in range(flow.rates_constant.shape[1]):
        scratch.envelope[i] = 0.0


@inlined
def draw_envelope(flow: Flow, slot: int, z: Array, scratch: Scratch) -> None:
    """Widen the envelope around a state, and fit the margins to it and to the configuration."""
    columns = flow.rates_constant.shape[1]
    for i in range(columns):
        scratch.envelope[i] = max(scratch.envelope[i], WIDER * abs(z[i]))
    combine(flow.margin, flow.margin_constant, slot, scratch.envelope, columns, scratch.margin)


@inlined
def above_margins(model: Model, state: State, margin: Array, z: Array, columns: int, duration: float) -> bool:
    """Whether every guard lies above its margin at a state with its accelerations, `duration` from now."""
    for j in range(model.mass.shape[0]):
        if state.mode[j] == FLIGHT:
            height = state.height[j] + duration * (state.speed[j] - 0.5 * model.gravity * duration)
            gap = height - z[model.position[j]]
            lowest = min(gap, model.clearance[j] - gap) - 2 * ROUNDING * abs(height)
        else:
            lowest = model.gravity + z[columns + model.position[j]]
            if state.mode[j] != FLOOR:
                lowest = -lowest
        if not lowest > margin[j]:
            return False
    return True
