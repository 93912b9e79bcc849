"""Input of the kernel: tables of the exact flow for each contact configuration, and the constants of the contacts.

A contact configuration specifies which dampers are in contact with which wall. The flow maps a state to a later state.
`rig.engine.flow_tables` computes both inputs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Number of terms of the matrix exponential of a step; more than those of a guard's power series.
TERMS = 25


class Flow(NamedTuple):
    """Tables of a system; the first index of each table of numbers is the table index of a configuration.

    The state obeys z' = A z + b. The step length is h, and tau = t / h is the time in a step. A guard is a gap or
    contact force, whose zero is a contact event. Matrices are stored [column, row] with padded rows. A table X and its
    constant part represent the affine map X z + X_constant.

    has_series: whether `series` is filled. has_step_matrix: whether all other tables are.
    drive_is_smooth: the drive has no corners, so the derivatives of the accelerations are continuous from step to step.
    uses_envelope: whether steps are so short that the envelope of `rig.engine.screening` saves time.
    step_matrix: gives the state after a full step, its accelerations and, as far as the padding has room, their
    derivatives with respect to tau. derivative: gives accelerations and their derivatives at the state z itself.
    series: (A h)^k / k! for every k.
    margin: gives from |z| the largest decrease of each damper's guard in a step below its values at both ends (an
    eighth of the bound of its second derivative, and rounding).
    bound: gives from |z| for each damper a bound of the fourth derivative of its guard with respect to tau over a step,
    then for each damper the sum of the magnitudes of the guard's terms.
    rates: nonzero elements of A, in compressed sparse rows (row_pointer, column). rates_constant: b.
    after_toggle[k, i]: table index after the change i of `HybridSystem.toggles` to the configuration with table index
    k, or -1 if it is not yet computed.

    The tables of guards contain the part that depends on z: for a damper in flight the position of its body, for a
    damper at rest the body's acceleration; with finite-duration contact the gap in flight, or the wall's force.
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
    after_toggle: np.ndarray


class Model(NamedTuple):
    """Constants of a system for the contact laws and the guards, in SI units; further fields as in `HybridSystem`.

    step: step length, s. mass: of each damper. position_index, velocity_index: of the position and velocity of each
    damper's body in the state. first_velocity: index of the first velocity, which equals the number of coordinates.
    first_acceleration: index of the accelerations that are stored after the state. inverse_mass: inverse of the mass
    matrix. force, force_constant: forces on the coordinates. coupled: whether simultaneous contacts affect each other.
    """

    gravity: float
    step: float
    mass: np.ndarray
    clearance: np.ndarray
    restitution: np.ndarray
    gap_coordinate: np.ndarray
    wall_stiffness: np.ndarray
    wall_damping: np.ndarray
    toggles: np.ndarray
    position_index: np.ndarray
    velocity_index: np.ndarray
    first_velocity: int
    first_acceleration: int
    inverse_mass: np.ndarray
    force: np.ndarray
    force_constant: np.ndarray
    coupled: bool
