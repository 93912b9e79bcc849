"""The equations of an orbit (a periodic motion): equations of motion in each configuration, and sequence of events.

The state is (coordinates, velocities, further states such as the coil current). The state is extended by cos wt, sin wt
and 1, so that the equations of motion are x' = A x with the *generator* A. Quantities are in SI units.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.numerics.jit import cached_njit

IndexArray = NDArray[np.int64]
#: Columns of `Equations.signals`: factors of the gap [m], of the speed [m/s], of the holding force per mass [m/s²] and
#: of the slider displacement [m], and the limits. A row without factors is unused. A force with a slider is divided by
#: its stiffness.
GAP, SPEED, HOLD, SLIDER, LOW, HIGH = range(6)


class Equations(NamedTuple):
    """The equations of motion in every configuration of an orbit, for one set of parameters."""

    generator: Array  # shape (configurations, states + 3, states + 3)
    norm_bound: Array  # Upper limit of the norm of each generator [1/s]; shape (configurations,)
    inverse_mass: Array  # shape (configurations, coordinates, coordinates)
    body_coordinate: IndexArray  # Coordinate of each element's body; int64, shape (elements,)
    mass: Array
    restitution: Array  # `mass` and `restitution`; shape (elements,)
    gap_coordinate: IndexArray
    """Coordinate of the gap of an element, -1 for a detached mass; int64, shape (elements,)."""
    base_coordinate: IndexArray
    """Coordinate that is subtracted from the coordinate of the gap, -1 if none is; int64, shape (elements,)."""
    slider_coordinate: IndexArray  # Coordinate of the slider displacement, -1 without slider; int64, shape (elements,)
    wall_gap: Array  # Gap at the lower and the upper wall [m]; shape (elements, 2)
    hold_offset: Array
    """Holding force per mass on both walls, minus the acceleration of the body [m/s²]; shape (elements, 2)."""
    stiffness: Array
    damping: Array  # `stiffness` and `damping` of both walls in finite-duration contact; shape (elements, 2)
    first_regime: IndexArray
    """Row in `signals` of the first regime of an element that slides with friction, otherwise -1; shape (elements,)."""
    signals: Array
    """Signals of the regimes of these elements; the columns are the constants above; shape (regimes, signals, 6)."""
    moves_freely: NDArray[np.bool_]  # Whether the gap is a coordinate without a spring; shape (elements,)
    gravity: float
    omega: float  # Angular frequency of the drive [rad/s]
    period: float  # Duration of the orbit, a multiple of the drive's period [s]


class EquationDerivatives(NamedTuple):
    """Derivatives of the fields of `Equations` with respect to the continuation parameter."""

    generator: Array
    inverse_mass: Array
    mass: Array
    wall_gap: Array
    hold_offset: Array
    stiffness: Array
    damping: Array
    signals: Array
    omega: float
    period: float


class Sequence(NamedTuple):
    """The events of an orbit in order."""

    kind: IndexArray
    damper: IndexArray  # kind of event and number of the element; int64, shape (events,)
    configuration: IndexArray
    """Index of the configuration in each segment: before the first event, between events, after the last; int64,
    shape (events + 1,)."""
    wall: IndexArray
    """Wall state in each segment, as in `rig.core.orbits.event_kinds`; int64, shape (events + 1, elements)."""


@cached_njit
def along_gap(equations: Equations, j: int, coordinates: Array) -> float:
    """Return the gap of element j for coordinates, or its rate for their velocities."""
    gap, base = equations.gap_coordinate[j], equations.base_coordinate[j]
    return float(coordinates[gap] - coordinates[base] if base >= 0 else coordinates[gap])
