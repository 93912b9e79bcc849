"""Guards looked at one by one: what is said to be above zero is, and what a step says of its ends holds there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.interpolate import BPoly

import rig
from rig.engine.guards import _margin, above_margins, bound_by_series, draw_envelope, fold_envelope
from rig.engine.propagator import Propagator
from rig.engine.state import CEILING, FLIGHT, FLOOR
from rig.numerics.bernstein import LENGTH
from rig.system.assembly import assemble
from rig.system.hybrid_system import tone

TAU = np.linspace(0.0, 1.0, 201)[1:]
VALUES = st.floats(-3.0, 3.0)
CLEARANCE = 1e-3


def engine(**of_dampers: object) -> Propagator:
    """Three bodies with a damper each, at rest."""
    scene = rig.Scene.model_validate(
        {
            "structure": {"masses": [1.0, 0.8, 0.6], "springs": [4e3] * 3, "damping": {"modal": 0.01}},
            "dampers": [
                {"body": body, "mass": 0.1, "clearance": CLEARANCE, **of_dampers} for body in (1, 2, 3)
            ],
            "shaker": {"kind": "force", "body": 1},
            "test": {"kind": "sine", "frequency": 10.0, "force": 1.0},
        }
    )
    return Propagator(assemble(scene), tone(np.ones(1), 60.0), 2e-3)


@given(start=VALUES, slope=VALUES, end=VALUES, slope_end=VALUES, error=st.floats(0.0, 500.0))
def test_given_a_cubic_when_it_is_said_to_stay_positive_then_all_within_the_error_of_it_does(
    start: float, slope: float, end: float, slope_end: float, error: float
) -> None:
    cubic = BPoly.from_derivatives([0.0, 1.0], [[start, slope], [end, slope_end]])
    coefficients = cubic.c[:, 0]
    assume((np.abs(coefficients - error / 384) > 1e-9).all())
    margin = _margin(start, slope, end, slope_end, error, 0)
    assert (margin > 0.0) == (coefficients > error / 384).all()
    if margin > 0.0:
        assert (cubic(TAU) - error * TAU**2 * (1 - TAU) ** 2 / 24 > 0.0).all()
        assert margin == pytest.approx(coefficients[:3].min() - error / 384)


@given(curve=VALUES, end=st.floats(0.01, 3.0), share=st.floats(0.1, 2.0))
def test_given_a_guard_that_begins_as_a_double_zero_when_said_to_rise_then_it_does_and_only_then(
    curve: float, end: float, share: float
) -> None:
    # tau^2 (curve (1 - tau) + end tau), and the most that the error takes from it.
    assume(abs(share - 1.0) > 1e-6 and abs(curve) > 1e-3)
    error = share * 24 * abs(curve)
    assume(end > error / 384)
    margin = _margin(0.0, 0.0, end, 3 * end - curve, error, 2)
    lowest = curve * (1 - TAU) + end * TAU - error * (1 - TAU) ** 2 / 24
    begins = curve - error / 24
    assert (margin > 0.0) == (begins > 0.0)
    assert margin <= 0.0 or (lowest > 0.0).all()


@pytest.mark.parametrize("length", [1.0, 0.3])
def test_given_a_power_series_when_guards_are_bounded_then_its_ends_and_its_bounds_are_theirs(
    length: float,
) -> None:
    run = engine()
    model, state, bound = run.tables.model, run.state, run.workspace.bound
    state.mode[:] = FLIGHT, FLOOR, CEILING
    rows = model.position.copy()
    rows[1:] = model.velocity[1:]
    tableau = run.workspace.tableau
    tableau[:] = np.random.default_rng(5).standard_normal(tableau.shape)
    new, behind = run.workspace.new, run.tables.size
    bound_by_series(model, state.mode, tableau, length, state.z, new, behind, bound)
    for j in range(3):
        series = np.polynomial.Polynomial(tableau[:LENGTH, rows[j]])
        if state.mode[j] != FLIGHT:
            series = series.deriv() / model.step
            place = behind + model.position[j]
            for at, when in ((state.z, 0.0), (new, length)):
                assert at[place] == pytest.approx(series(when))
                assert at[place + model.first_velocity] == pytest.approx(series.deriv()(when))
        sizes = np.polynomial.Polynomial(np.abs(series.coef))
        assert bound[j] == pytest.approx(sizes.deriv(4)(1.0))
        assert bound[3 + j] == pytest.approx(sizes(1.0))


def test_given_a_contact_that_lasts_when_bounded_by_its_series_then_there_is_no_bound() -> None:
    run = engine(contact={"duration": "2 ms"})
    model, work = run.tables.model, run.workspace
    bound_by_series(
        model, run.state.mode, work.tableau, 1.0, run.state.z, work.new, run.tables.size, work.bound
    )
    assert (work.bound[:3] == np.inf).all()


@given(
    modes=st.lists(st.sampled_from([FLIGHT, FLOOR, CEILING]), min_size=3, max_size=3),
    seed=st.integers(0, 1000),
    duration=st.sampled_from([0.0, 1e-3]),
    missed=st.integers(-1, 2),
)
def test_given_margins_just_below_every_guard_when_looked_at_then_all_lie_above_and_with_one_above_not(
    modes: list[int], seed: int, duration: float, missed: int
) -> None:
    run, chance = engine(), np.random.default_rng(seed)
    model, state, columns = run.tables.model, run.state, run.tables.size
    z = state.z
    z[model.position] = 1e-4 * chance.standard_normal(3)
    state.mode[:] = modes
    state.speed[:] = 0.01 * chance.standard_normal(3)
    gap = chance.uniform(0.1, 0.9, 3) * CLEARANCE
    fallen = model.gravity * duration**2 / 2
    state.height[:] = z[model.position] + gap - state.speed * duration + fallen
    guard = np.empty(3)
    for j, mode in enumerate(modes):
        upward = chance.uniform(0.1, 5.0)
        z[columns + model.position[j]] = -model.gravity + (-upward if mode == CEILING else upward)
        guard[j] = min(gap[j], CLEARANCE - gap[j]) if mode == FLIGHT else upward
    margin = guard * (1 - 1e-9)
    if missed >= 0:
        margin[missed] = guard[missed] * (1 + 1e-9)
    assert above_margins(model, state, margin, z, columns, duration) == (missed < 0)


def test_given_states_when_an_envelope_is_drawn_then_it_holds_them_all_until_it_begins_anew() -> None:
    run = engine()
    flow, work, columns = run.tables.flow, run.workspace, run.tables.size
    states = np.zeros((5, len(work.size)))
    states[:, :columns] = np.random.default_rng(2).standard_normal((5, columns))
    fold_envelope(flow, work)
    assert (work.envelope[:columns] == 0.0).all()
    for z in states:
        draw_envelope(flow, 0, z, work)
    largest = np.abs(states).max(axis=0)[:columns]
    assert (work.envelope[:columns] >= largest).all()
    wanted = flow.margin_constant[0] + work.envelope[:columns] @ flow.margin[0]
    np.testing.assert_allclose(work.margin, wanted, rtol=1e-12)
