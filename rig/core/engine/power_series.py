"""The state within one step: its power series in time, the sum of the series, and the accelerations.

They are computed from the tables of `rig.core.engine.flow`, or for a system without tables from the sparse matrix A of
z' = A z + b. The time in a step of length h is tau h, 0 <= tau <= 1.
"""

from rig.core.base.arrays import Array
from rig.core.engine.flow import Flow
from rig.core.engine.workspace import Workspace
from rig.core.numerics.bernstein import N_COEFFICIENTS
from rig.core.numerics.jit import inlined_kernel
from rig.core.numerics.simd import affine_product, affine_product_many

#: Status of the present state. CONTACTS_UNCHECKED: contact forces may be tensile. STATE_ONLY: the accelerations are not
#: computed. WITH_ACCELERATIONS: they are stored after the state. ABOVE_MARGINS: in addition, every signal is inside its
#: limits by its margin (`rig.core.engine.screening`).
CONTACTS_UNCHECKED, STATE_ONLY, WITH_ACCELERATIONS, ABOVE_MARGINS = -1, 0, 1, 2


@inlined_kernel
def expand_state(flow: Flow, step: float, table_index: int, z: Array, state_series: Array) -> None:
    """Compute the power series of the state over one step: state_series[k] = (A h)^k z / k!, plus the terms of b."""
    size = flow.rates_constant.shape[1]
    if flow.has_series:
        affine_product_many(flow.series, flow.series_constant, table_index, z, size, state_series)
        return
    for i in range(size):
        state_series[0, i] = z[i]
    for k in range(N_COEFFICIENTS):
        factor = step / (k + 1)
        for i in range(size):
            rate = flow.rates_constant[table_index, i] if k == 0 else 0.0
            for entry in range(flow.row_pointer[i], flow.row_pointer[i + 1]):
                rate += flow.rates[table_index, entry] * state_series[k, flow.column[entry]]
            state_series[k + 1, i] = factor * rate


@inlined_kernel
def sum_state_series(workspace: Workspace, tau: float, out: Array) -> None:
    """Compute the state at the fraction tau of the step: the sum of the series' rows times the powers of tau."""
    powers = workspace.powers
    square = tau * tau
    powers[0] = 1.0
    powers[1] = tau
    for k in range(2, N_COEFFICIENTS + 1, 2):
        powers[k] = powers[k - 2] * square
    for k in range(3, N_COEFFICIENTS + 1, 2):
        powers[k] = powers[k - 2] * square
    affine_product(workspace.series_matrix, workspace.zero_constant, 0, powers, N_COEFFICIENTS + 1, out)


@inlined_kernel
def store_accelerations(flow: Flow, coordinates: int, table_index: int, z: Array, work: Array, status: int) -> None:
    """Store after a state its accelerations, if `status` is STATE_ONLY, and their derivatives with respect to tau.

    `work`: scratch array. For a system without tables for full steps, only the accelerations are stored;
    `bound_by_series` computes the derivatives.
    """
    columns = flow.rates_constant.shape[1]
    if flow.has_step_matrix:
        affine_product(flow.derivative, flow.derivative_constant, table_index, z, columns, work)
        for i in range(coordinates if status != STATE_ONLY else 0, 2 * coordinates):
            z[columns + i] = work[i]
        return
    for i in range(coordinates, 2 * coordinates):
        rate = flow.rates_constant[table_index, i]
        for entry in range(flow.row_pointer[i], flow.row_pointer[i + 1]):
            rate += flow.rates[table_index, entry] * z[flow.column[entry]]
        z[columns + i - coordinates] = rate
