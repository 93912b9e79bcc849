"""Input of the kernel: tables of the exact flow for each configuration, and the constants of the elements.

The configuration specifies which forces act in the elements (`HybridSystem.strides`). The flow maps a state to a later
state. A signal is a function of the state whose limits end a regime (`rig.core.engine.law_tables`).
`rig.core.engine.flow_tables` computes both inputs.
"""

from typing import NamedTuple

import numpy as np

from rig.core.engine.law_tables import LawTables

#: Number of terms of the matrix exponential of a step; the power series of a signal has fewer.
TERMS = 25


class Flow(NamedTuple):
    """Tables of a system; the first index of each table of numbers is the table index of a configuration.

    The state obeys z' = A z + b. The step length is h, and tau = t / h is the time in a step. Matrices are stored
    [column, row] with padded rows. A table X and its constant part represent the affine map X z + X_constant.

    has_series: whether `series` is filled. has_step_matrix: whether all other tables are.
    drive_is_smooth: the drive has no corners, so the derivatives of the accelerations are continuous from step to step.
    uses_envelope: whether steps are so short that the envelope of `rig.core.engine.screening` saves time.
    step_matrix: gives the state after a full step, its accelerations and, as far as the padding has room, their
    derivatives with respect to tau. derivative: gives accelerations and their derivatives at the state z itself.
    series: (A h)^k / k! for every k.
    margin: maps |z| to the margins of the signals. A signal can be closer to a limit within a step than at both ends of
    the step, by at most its margin (an eighth of the bound of its second derivative, plus rounding).
    bound: maps |z| to bounds over a step: first the fourth derivative of each signal with respect to tau, then the sum
    of the magnitudes of the terms of each signal. For a flying mass the signal here is the position of its body. rates:
    nonzero elements of A, in compressed sparse rows (row_pointer, column). rates_constant: b. after[k, m]: table index
    after one element of the configuration with table index k changes to regime m, or -1 if it is not yet computed.
    """

    has_series: bool
    has_step_matrix: bool
    drive_is_smooth: bool
    uses_envelope: bool
    step_matrix: np.ndarray
    step_matrix_constant: np.ndarray
    series: np.ndarray
    series_constant: np.ndarray
    margin: np.ndarray
    margin_constant: np.ndarray
    bound: np.ndarray
    bound_constant: np.ndarray
    derivative: np.ndarray
    derivative_constant: np.ndarray
    row_pointer: np.ndarray
    column: np.ndarray
    rates: np.ndarray
    rates_constant: np.ndarray
    after: np.ndarray


class Model(NamedTuple):
    """Constants of a system for the laws of its elements, in SI units.

    step: step length, s. first_velocity: index of the first velocity in the state, which equals the number of
    coordinates. first_acceleration: index of the accelerations that are stored after the state. inverse_mass: inverse
    of the mass matrix. force, force_constant: forces on the coordinates. coupled: whether simultaneous contacts affect
    each other. laws: tables of the elements and their laws.
    """

    gravity: float
    step: float
    first_velocity: int
    first_acceleration: int
    inverse_mass: np.ndarray
    force: np.ndarray
    force_constant: np.ndarray
    coupled: bool
    laws: LawTables
