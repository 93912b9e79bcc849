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

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rig.core.numerics.jit import kernel

#: A sum below this fraction of the magnitudes of its terms is a rounding error of zero.
ROUNDING = 16 * 2.3e-16
#: State of a contact: between its limits, at the lower limit, at the upper limit.
FREE, AT_LOW, AT_HIGH = 0, 1, 2
#: Maximum number of pivots; in practice the number of contacts is sufficient.
MAX_PIVOTS = 100_000


class ContactWorkspace(NamedTuple):
    """Scratch arrays of the contact laws, with one entry for each contact of the instant.

    `force`: forces on all coordinates, N. `damper`: number of the damper, from 0. `sign`: +1 floor, -1 ceiling. `row`:
    r. `direction`: d. `own`: 1 / md, or 0. `flying`: whether the damper was in flight. `wall_gap`: gap at the wall, m.
    `velocity_before`: velocity of the body before the impact, m/s. `opening_speed`: opening speed of the gap before the
    impact, m/s. `magnitude`: sum of the magnitudes of the terms of the acceleration, m/s².

    `matrix`, `rhs`, `reaction`: A, q and the solution p; `reaction` is a force or an impulse. `low`, `high`: limits of
    p; those of a wall are 0 and infinity. `bound`: `AT_LOW`, `AT_HIGH`, or `FREE` between the limits. `block`: scratch
    space.
    """

    force: np.ndarray
    damper: np.ndarray
    sign: np.ndarray
    row: np.ndarray
    direction: np.ndarray
    own: np.ndarray
    flying: np.ndarray
    wall_gap: np.ndarray
    velocity_before: np.ndarray
    magnitude: np.ndarray
    opening_speed: np.ndarray
    rhs: np.ndarray
    reaction: np.ndarray
    low: np.ndarray
    high: np.ndarray
    bound: np.ndarray
    matrix: np.ndarray
    block: np.ndarray


def allocate_contact_workspace(dampers: int, forces: int) -> ContactWorkspace:
    """Allocate the scratch arrays; `forces`: padded number of coordinates on which forces act."""
    return ContactWorkspace(
        force=np.zeros(forces),
        damper=np.zeros(dampers + 1, dtype=np.int64),
        sign=np.zeros(dampers + 1),
        row=np.zeros(dampers + 1, dtype=np.int64),
        direction=np.zeros(dampers + 1),
        own=np.zeros(dampers + 1),
        flying=np.zeros(dampers + 1, dtype=np.bool_),
        wall_gap=np.zeros(dampers + 1),
        velocity_before=np.zeros(dampers + 1),
        magnitude=np.zeros(dampers + 1),
        opening_speed=np.zeros(dampers + 1),
        rhs=np.zeros(dampers + 1),
        reaction=np.zeros(dampers + 1),
        low=np.zeros(dampers + 1),
        high=np.full(dampers + 1, np.inf),
        bound=np.zeros(dampers + 1, dtype=np.int64),
        matrix=np.zeros((dampers + 1, dampers + 1)),
        block=np.zeros((dampers + 1, dampers + 2)),
    )


@kernel
def contact_matrix(model: Any, work: ContactWorkspace, count: int) -> None:
    """Fill `work.matrix` for the contacts listed in `work`; `model`: inverse mass matrix of the structure."""
    for a in range(count):
        for b in range(count):
            coupling = model.inverse_mass[work.row[a], work.row[b]]
            work.matrix[a, b] = work.direction[a] * work.direction[b] * coupling
        work.matrix[a, a] += work.own[a]


@kernel
def solve_active(work: ContactWorkspace, count: int) -> None:
    """Solve A p + q = 0 for the contacts between their limits by Gaussian elimination; the others are at a limit."""
    block = work.block
    n_active = 0
    for a in range(count):
        if work.bound[a] != FREE:
            work.reaction[a] = work.low[a] if work.bound[a] == AT_LOW else work.high[a]
    for a in range(count):
        if work.bound[a] == FREE:
            column = 0
            block[n_active, count] = -work.rhs[a]
            for b in range(count):
                if work.bound[b] == FREE:
                    block[n_active, column] = work.matrix[a, b]
                    column += 1
                else:
                    block[n_active, count] -= work.matrix[a, b] * work.reaction[b]
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
        if work.bound[a] == FREE:
            work.reaction[a] = block[n_active, count]
            n_active += 1


@kernel
def solve_complementarity(work: ContactWorkspace, count: int) -> None:
    """Solve the problem with `work.matrix` A and `work.rhs` q for `work.reaction` p, by principal pivoting."""
    for a in range(count):
        work.bound[a] = AT_LOW
        work.reaction[a] = work.low[a]
    for _ in range(MAX_PIVOTS):
        violated, new_bound = -1, FREE
        for a in range(count):
            if work.bound[a] == FREE:
                is_violated = work.reaction[a] < work.low[a] or work.reaction[a] > work.high[a]
                if is_violated:
                    new_bound = AT_LOW if work.reaction[a] < work.low[a] else AT_HIGH
            else:
                opening_speed = work.rhs[a]
                magnitude = abs(opening_speed)
                for b in range(count):
                    term = work.matrix[a, b] * work.reaction[b]
                    opening_speed += term
                    magnitude += abs(term)
                if work.bound[a] == AT_HIGH:
                    opening_speed = -opening_speed
                is_violated = opening_speed < -ROUNDING * magnitude
            if is_violated:
                violated = a
                break
        if violated < 0:
            return
        work.bound[violated] = new_bound
        solve_active(work, count)
