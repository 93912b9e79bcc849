"""Input of the kernel: exact flow of a system by contact configuration, and the constants of its contacts.

`rig.engine.flow_tables` computes both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Number of terms of the matrix exponential; more than those of the series of guards.
TERMS = 25


class Flow(NamedTuple):
    """Tables by slot; matrices are stored [column, row] with padded rows.

    A is the state matrix, h the step length, tau = t / h the time in a step.

    tabulated: whether `series` is filled. stepping: whether all other tables are.
    smooth: the drive has no corners, so the derivatives of the accelerations are continuous from step to step.
    enveloping: whether steps are so short that an envelope saves time.
    propagate: state after a full step; its accelerations follow, then as far as there is room their derivatives with
    respect to tau. derivative: both for a state itself. series: (A h)^k / k! for every k.
    margin: times |z|, largest decrease of each damper's guard below its values at the ends of a step (an eighth of the
    bound of its second derivative, and rounding).
    bound: times |z|, for each damper the bound of the fourth derivative of its guard with respect to tau over the step,
    then the sum of the magnitudes of the guard's terms.
    rates: nonzero elements of A in compressed rows (pointer, column).
    neighbor[slot, i]: slot after the change i of `HybridSystem.toggles`, or -1.

    The guard of a damper depends on the position of its body in flight, and on the body's acceleration at rest. The
    guard of a finite-duration contact depends on the gap in flight, and on the wall's force in contact.
    """

    tabulated: bool
    stepping: bool
    smooth: bool
    enveloping: bool
    propagate: np.ndarray
    propagate_constant: np.ndarray
    series: np.ndarray
    series_constant: np.ndarray
    margin: np.ndarray
    margin_constant: np.ndarray
    bound: np.ndarray
    bound_constant: np.ndarray
    derivative: np.ndarray
    derivative_constant: np.ndarray
    pointer: np.ndarray
    column: np.ndarray
    rates: np.ndarray
    rates_constant: np.ndarray
    neighbor: np.ndarray


class Model(NamedTuple):
    """Constants of a system for the contact laws and the guards.

    position, velocity: indices of the body of each damper in the state. first_velocity: index of the first velocity.
    first_acceleration: index of the accelerations that are stored after the state.
    """

    gravity: float
    step: float
    mass: np.ndarray
    clearance: np.ndarray
    restitution: np.ndarray
    bed: np.ndarray
    wall_stiffness: np.ndarray
    wall_damping: np.ndarray
    toggles: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    first_velocity: int
    first_acceleration: int
    inverse_mass: np.ndarray
    force: np.ndarray
    force_constant: np.ndarray
    coupled: bool
