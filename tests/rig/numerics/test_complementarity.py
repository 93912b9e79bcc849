"""The linear complementarity problem of simultaneous contacts, compared with a search over all combinations."""

from itertools import product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rig.core.numerics.complementarity import allocate_contact_workspace, solve_complementarity

Limit = float | np.ndarray


def solve(matrix: np.ndarray, right: np.ndarray, low: Limit = 0.0, high: Limit = np.inf) -> np.ndarray:
    """Return the reactions p within limits; matrix p + right is zero between them, and points inwards at a limit."""
    count = len(right)
    work = allocate_contact_workspace(count, 8)
    work.contacts.low[:count], work.contacts.high[:count] = low, high
    work.matrix[:count, :count] = matrix
    work.contacts.rhs[:count] = right
    solve_complementarity(work, count)
    return work.contacts.reaction[:count].copy()


def solve_by_enumeration(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the same reactions by a search over all combinations of active contacts."""
    for pattern in product([False, True], repeat=len(right)):
        active = np.array(pattern)
        reaction = np.zeros(len(right))
        if active.any():
            reaction[active] = np.linalg.solve(matrix[np.ix_(active, active)], -right[active])
        if (reaction >= -1e-12).all() and (matrix @ reaction + right >= -1e-9).all():
            return reaction
    raise AssertionError("a positive definite problem has a solution")


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_pivoting_agrees_with_enumeration(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((count, count))
    matrix = factor @ factor.T + 0.1 * np.eye(count)
    right = rng.standard_normal(count)

    reaction = solve(matrix, right)

    assert (reaction >= 0.0).all()
    np.testing.assert_allclose(reaction, solve_by_enumeration(matrix, right), atol=1e-9)


@given(st.integers(0, 10_000), st.integers(1, 8))
def test_limited_reactions_satisfy_their_conditions(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    factor = rng.standard_normal((count, count))
    matrix, right = factor @ factor.T + 0.1 * np.eye(count), rng.standard_normal(count)
    low, high = np.sort(rng.standard_normal((2, count)) * 10.0 ** rng.integers(-2, 2, count), axis=0)
    high[rng.random(count) < 0.3] = np.inf
    reaction = solve(matrix, right, low, high)
    rate = matrix @ reaction + right
    assert ((low <= reaction) & (reaction <= high)).all()
    assert (rate[reaction < high] >= -1e-9).all()
    assert (rate[reaction > low] <= 1e-9).all()


def test_separating_contacts_have_no_force() -> None:
    assert (solve(np.eye(3), np.ones(3)) == 0.0).all()


def test_single_contact_has_its_exact_reaction() -> None:
    assert solve(np.array([[4.0]]), np.array([-2.0]))[0] == 0.5
