"""What the kernel reads of a system: its exact flow by contact configuration, and the constants of its contacts.

`rig.engine.flow_tables` makes both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

#: Terms of the matrix exponential, which is summed further than the series that guards use.
TERMS = 25


class Flow(NamedTuple):
    """Tables by slot; matrices are stored [column, row] with padded rows.

    tabulated: the series is; stepping: everything else is. smooth: the drive has no corners, so the derivatives of
    the accelerations are continuous from step to step. enveloping: steps are so short that an envelope pays.
    propagate: z over a full step, and behind it the accelerations of the coordinates then, and as far as there is
    room their derivatives with respect to tau. derivative: both of a state itself. series: (A h)^k / k! for every k.
    margin: times |z|, what the guard of each damper may at most fall below its values at the ends of a step (an
    eighth of its second derivative's bound, and rounding). bound: times |z|, for each damper bounds the fourth
    derivative of its guard with respect to tau over the step, then the size of the terms that it is the sum of.
    rates: nonzero elements of A in compressed rows (pointer, column). neighbour[slot, i]: slot after the change i of
    `HybridSystem.toggles`, or -1.

    The guard of a damper depends on the position of its body in flight, and on the body's acceleration at rest; that of
    a finite-duration contact on the gap, and on the wall's force.
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
    neighbour: np.ndarray


class Model(NamedTuple):
    """Constants of a system that the contact laws and the guards need."""

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
    behind: int
    inverse_mass: np.ndarray
    force: np.ndarray
    force_constant: np.ndarray
    coupled: bool
