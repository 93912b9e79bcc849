"""What an orbit is the solution of: the equations of motion in each configuration, and the sequence of its events."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Whole = NDArray[np.int64]

# Kinds of events. A damper that bounces leaves the wall in the instant in which it hits it, with the common
# velocity (osculating contact) or with its rebound; one that leaves `WITH_LAST` is thrown off by the event
# before, at the same instant.
SEPARATION, FLOOR, CEILING, FLOOR_BOUNCE, CEILING_BOUNCE, WITH_LAST = 0, 1, 2, 3, 4, 5
# Where contact lasts: a gap falls to zero (touch), a force falls to zero (release), and a force rises from zero again
# while the overlap is not undone (press). All are rows of the state, and only the force law changes.
TOUCH_FLOOR, TOUCH_CEILING, PRESS_FLOOR, PRESS_CEILING, RELEASE = 6, 7, 8, 9, 10
# Walls in a stretch: in flight, or riding on one; and where contact lasts, without force, or pressed on one.
FLYING, RIDES_FLOOR, RIDES_CEILING, FORCELESS, ON_FLOOR, ON_CEILING = 0, 1, 2, 3, 4, 5


class Equations(NamedTuple):
    """The equations of motion in every configuration that an orbit visits, for one set of parameters."""

    generator: Array
    """shape (configurations, states + 3, states + 3)."""
    rate: Array
    """Bound on how fast each generator turns or grows what it acts on [1/s]; shape (configurations,)."""
    inverse_mass: Array
    """shape (configurations, coordinates, coordinates)."""
    position: Whole
    """Coordinate of each damper's body; int64, shape (dampers,)."""
    mass: Array
    clearance: Array
    restitution: Array
    """mass, clearance, restitution: shape (dampers,)."""
    bed: Whole
    """Coordinate of a damper whose contact lasts, its gap; -1 where contact is instant; int64, shape (dampers,)."""
    stiffness: Array
    damping: Array
    """stiffness, damping: of floor and ceiling where contact lasts; shape (dampers, 2)."""
    gravity: float
    omega: float
    period: float
    """Length of the orbit, a multiple of the drive's period [s]."""


class Change(NamedTuple):
    """Derivatives of the fields of `Equations` with respect to the parameter that is followed."""

    generator: Array
    inverse_mass: Array
    mass: Array
    clearance: Array
    stiffness: Array
    damping: Array
    omega: float
    period: float


class Sequence(NamedTuple):
    """Which events happen, in order."""

    kind: Whole
    damper: Whole
    """kind, damper: int64, shape (events,)."""
    slot: Whole
    """Configuration of each stretch: before the first event, between events, after the last; int64, shape
    (events + 1,)."""
    wall: Whole
    """In each stretch, `FLYING` to `ON_CEILING`; int64, shape (events + 1, dampers)."""
