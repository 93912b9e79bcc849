"""Contact forces or impulses of one instant: a linear complementarity problem.

Find p with low <= p <= high and w = A p + q, so that w = 0 between the limits, w >= 0 for p = low, and w <= 0 for
p = high, where

    A_ik = d_i d_k (M^-1)_{r_i r_k} + delta_ik / md_i,      d = -1 floor, +1 ceiling

(r_i the body of damper i, md_i its mass). If the gap of a damper is a coordinate, r_i is this coordinate, d_i has the
opposite sign, and 1 / md_i is omitted. At an impact p are the impulses, and A p + q are the speeds at which the
contacts open, minus their rebound speeds. Right after an impact p are the contact forces, and A p + q are the
accelerations at which the contacts open. A is positive definite, so the solution exists and is unique; Murty's
least-index principal pivoting reaches it in finitely many steps.

References
----------
Murty, K. G., "Linear Complementarity, Linear and Nonlinear Programming", Heldermann 1988, chapter 4.
Pfeiffer, F., Glocker, C., "Multibody Dynamics with Unilateral Contacts", Wiley 1996, chapters 6 and 8.
"""

from typing import Any, NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.jit import kernel

#: A sum below this fraction of the magnitudes of its terms is a rounding error of zero.
ROUNDING = 16 * 2.3e-16
#: State of a contact: between its limits, at the lower limit, at the upper limit.
FREE, AT_LOW, AT_HIGH = 0, 1, 2
#: Maximum number of pivots; in practice the number of contacts is sufficient.
MAX_PIVOTS = 100_000


#: Fields of a contact. damper: number of the damper, from 0. row: r. bound: `AT_LOW`, `AT_HIGH`, or `FREE` between the
#: limits. sign: +1 floor, -1 ceiling. direction: d. own: 1 / md, or 0. wall_gap: gap at the wall, m. velocity_before:
#: velocity of the body before the impact [m/s]. magnitude: sum of the magnitudes of the terms of the acceleration
#: [m/s²]. opening_speed: opening speed of the gap before the impact [m/s]. rhs, reaction: q and the solution p, a force
#: or an impulse. low, high: limits of p; those of a wall are 0 and infinity. flying: whether the damper was in flight.
CONTACT_FIELDS = np.dtype(
    [
        *(("damper", np.uintp), ("row", np.intp), ("bound", np.int64)),
        *((name, np.float64) for name in ("sign", "direction", "own", "wall_gap", "velocity_before", "magnitude")),
        *((name, np.float64) for name in ("opening_speed", "rhs", "reaction", "low", "high")),
        ("flying", np.bool_),
    ]
)


class ContactWorkspace(NamedTuple):
    """Scratch arrays of the contact laws, with one entry for each contact of the instant.

    `force`: forces on all coordinates, N. `contacts`: records (`CONTACT_FIELDS`). `matrix`: A. `block`: scratch space.
    """

    force: np.ndarray
    contacts: np.recarray[Any, Any]
    matrix: np.ndarray
    block: np.ndarray


def allocate_contact_workspace(dampers: int, forces: int) -> ContactWorkspace:
    """Allocate the scratch arrays; `forces`: padded number of coordinates on which forces act."""
    contacts = np.zeros(dampers + 1, dtype=CONTACT_FIELDS).view(np.recarray)
    contacts.high = np.inf
    return ContactWorkspace(
        force=np.zeros(forces),
        contacts=contacts,
        matrix=np.zeros((dampers + 1, dampers + 1)),
        block=np.zeros((dampers + 1, dampers + 2)),
    )


@kernel
def contact_matrix(inverse_mass: Array, work: ContactWorkspace, count: int) -> None:
    """Fill `work.matrix` for the contacts listed in `work`."""
    for a in range(count):
        for b in range(count):
            coupling = inverse_mass[work.contacts[a].row, work.contacts[b].row]
            work.matrix[a, b] = work.contacts[a].direction * work.contacts[b].direction * coupling
        work.matrix[a, a] += work.contacts[a].own


@kernel
def solve_active(work: ContactWorkspace, count: int) -> None:
    """Solve A p + q = 0 for the contacts between their limits by Gaussian elimination; the others are at a limit."""
    block = work.block
    n_active = 0
    for a in range(count):
        if work.contacts[a].bound != FREE:
            work.contacts[a].reaction = (
                work.contacts[a].low if work.contacts[a].bound == AT_LOW else work.contacts[a].high
            )
    for a in range(count):
        if work.contacts[a].bound == FREE:
            column = 0
            block[n_active, count] = -work.contacts[a].rhs
            for b in range(count):
                if work.contacts[b].bound == FREE:
                    block[n_active, column] = work.matrix[a, b]
                    column += 1
                else:
                    block[n_active, count] -= work.matrix[a, b] * work.contacts[b].reaction
            n_active += 1
    for i in range(n_active):
        for row in range(i + 1, n_active):
            factor = block[row, i] / block[i, i]
            for column in range(i, n_active):
                block[row, column] -= factor * block[i, column]
            block[row, count] -= factor * block[i, count]
    for i in range(n_active - 1, -1, -1):
        for column in range(i + 1, n_active):
            block[i, count] -= block[i, column] * block[column, count]
        block[i, count] /= block[i, i]
    n_active = 0
    for a in range(count):
        if work.contacts[a].bound == FREE:
            work.contacts[a].reaction = block[n_active, count]
            n_active += 1


@kernel
def solve_complementarity(work: ContactWorkspace, count: int) -> None:
    """Solve the problem with `work.matrix` A and `work.rhs` q for `work.reaction` p, by principal pivoting."""
    for a in range(count):
        work.contacts[a].bound = AT_LOW
        work.contacts[a].reaction = work.contacts[a].low
    for _ in range(MAX_PIVOTS):
        violated, new_bound = -1, FREE
        for a in range(count):
            if work.contacts[a].bound == FREE:
                is_violated = (
                    work.contacts[a].reaction < work.contacts[a].low
                    or work.contacts[a].reaction > work.contacts[a].high
                )
                if is_violated:
                    new_bound = AT_LOW if work.contacts[a].reaction < work.contacts[a].low else AT_HIGH
            else:
                opening_speed = work.contacts[a].rhs
                magnitude = abs(opening_speed)
                for b in range(count):
                    term = work.matrix[a, b] * work.contacts[b].reaction
                    opening_speed += term
                    magnitude += abs(term)
                if work.contacts[a].bound == AT_HIGH:
                    opening_speed = -opening_speed
                is_violated = opening_speed < -ROUNDING * magnitude
            if is_violated:
                violated = a
                break
        if violated < 0:
            return
        work.contacts[violated].bound = new_bound
        solve_active(work, count)
