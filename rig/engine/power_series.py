"""The state over one step: its power series, the sum of the series, and the derivatives that guards need.

They are computed from the tables of `rig.engine.flow`, or for a system without tables from the sparse matrix.
"""

from __future__ import annotations

from rig.arrays import Array
from rig.engine.flow import Flow, Model
from rig.engine.workspace import Workspace
from rig.numerics.bernstein import N_COEFFICIENTS
from rig.numerics.jit import inlined_kernel
from rig.numerics.simd import combine, combine_many

#: Status of the present state. UNSETTLED: contact forces may be tensile. STALE: its accelerations are unknown. CURRENT:
#: its accelerations follow it. CLEAR: in addition, every guard exceeds its margin.
UNSETTLED, STALE, CURRENT, CLEAR = -1, 0, 1, 2


@inlined_kernel
def expand(flow: Flow, model: Model, slot: int, z: Array, tableau: Array) -> None:
    """Compute the power series of the state over one step: tableau[k] = (A h)^k z / k!, plus the constant part."""
    size = flow.rates_constant.shape[1]
    if flow.tabulated:
        combine_many(flow.series, flow.series_constant, slot, z, size, tableau)
        return
    for i in range(size):
        tableau[0, i] = z[i]
    for k in range(N_COEFFICIENTS):
        factor = model.step / (k + 1)
        for i in range(size):
            rate = flow.rates_constant[slot, i] if k == 0 else 0.0
            for entry in range(flow.pointer[i], flow.pointer[i + 1]):
                rate += flow.rates[slot, entry] * tableau[k, flow.column[entry]]
            tableau[k + 1, i] = factor * rate


@inlined_kernel
def sum_series(workspace: Workspace, tau: float, out: Array) -> None:
    """Compute the state at the fraction tau of the step: the rows of the tableau times the powers of tau."""
    powers = workspace.powers
    square = tau * tau
    powers[0] = 1.0
    powers[1] = tau
    for k in range(2, N_COEFFICIENTS + 1, 2):
        powers[k] = powers[k - 2] * square
    for k in range(3, N_COEFFICIENTS + 1, 2):
        powers[k] = powers[k - 2] * square
    combine(workspace.series_rows, workspace.zero_constant, 0, powers, N_COEFFICIENTS + 1, out)


@inlined_kernel
def differentiate(flow: Flow, model: Model, slot: int, z: Array, work: Array, status: int) -> None:
    """Store the accelerations after a state, unless they are known, and their derivatives with respect to tau.

    For a system without tables for full steps, the derivatives are computed from its series instead.
    """
    columns = flow.rates_constant.shape[1]
    points = model.first_velocity
    if flow.stepping:
        combine(flow.derivative, flow.derivative_constant, slot, z, columns, work)
        for i in range(points if status != STALE else 0, 2 * points):
            z[columns + i] = work[i]
        return
    for i in range(points, 2 * points):
        rate = flow.rates_constant[slot, i]
        for entry in range(flow.pointer[i], flow.pointer[i + 1]):
            rate += flow.rates[slot, entry] * z[flow.column[entry]]
        z[columns + i - points] = rate
