"""Guards: distances of signals, such as gaps and contact forces, from limits that are positive until an event.

From a guard's values and slopes at both ends of a step, the engine computes a lower bound. A positive lower bound
proves that the guard is positive over the step. Otherwise the engine locates the first zero of the guard's power
series. `tau` is the time from the start of the step, in full time steps; `length` is the end of a step, which may be
shorter than a full step. The contact of a damper, and its regime, is FLIGHT, FLOOR or CEILING.
"""

from functools import cache
from itertools import cycle

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.interpolate import BPoly

import rig
from rig.core.engine.guards import bound_by_series, bound_by_tables, first_event
from rig.core.engine.law_tables import BOUND, ELEMENT, LOWER, UPPER
from rig.core.engine.power_series import expand_state
from rig.core.engine.propagator import Propagator, sampled_propagator
from rig.core.engine.screening import _lower_bound, inside_margins, reset_envelope, screen, widen_envelope
from rig.core.engine.state import load_signals
from rig.core.laws.events import CEILING, FLIGHT, FLOOR
from rig.core.numerics.bernstein import N_COEFFICIENTS, NO_CROSSING
from rig.core.system.assembly import assemble

TAU = np.linspace(0.0, 1.0, 201)[1:]
VALUES = st.floats(-3.0, 3.0)
CLEARANCE = 1e-3  # m
#: Over a step of length 1, a cubic Hermite interpolant has at most this error, relative to the fourth derivative.
HERMITE_ERROR = 1.0 / 384.0


@cache
def propagator(duration: str = "", bodies: tuple[int, ...] = (1, 2, 3), clearance: float = CLEARANCE) -> Propagator:
    """Return the engine for a chain of three bodies, whose state the tests set.

    `duration`: duration of the contacts; without it, impacts are instantaneous; `bodies`: those with a damper.
    """
    contact_keys = {"contact": {"duration": duration}} if duration else {}
    scene = rig.Scene(
        structure={"masses": [1.0, 0.8, 0.6], "springs": [4e3] * 3, "damping": {"modal": 0.01}},
        dampers=[{"body": body, "mass": 0.1, "clearance": clearance, **contact_keys} for body in bodies],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 10.0, "force": 1.0},
    )
    return sampled_propagator(assemble(scene), 4e-3)[0]


@given(start=VALUES, slope=VALUES, end=VALUES, slope_end=VALUES, fourth_derivative=st.floats(0.0, 500.0))
def test_positive_lower_bound_proves_a_positive_guard(start, slope, end, slope_end, fourth_derivative):
    cubic = BPoly.from_derivatives([0.0, 1.0], [[start, slope], [end, slope_end]])
    # The Bernstein coefficients bound the cubic from below, and the error bounds its distance from the guard.
    coefficients, error = cubic.c[:, 0], fourth_derivative * HERMITE_ERROR
    assume((np.abs(coefficients - error) > 1e-9).all())
    lower_bound = _lower_bound(start, slope, end, slope_end, fourth_derivative, 0)
    assert (lower_bound > 0.0) == (coefficients > error).all()
    if lower_bound > 0.0:
        assert (cubic(TAU) - fourth_derivative * TAU**2 * (1 - TAU) ** 2 / 24 > 0.0).all()
        assert lower_bound == pytest.approx(coefficients[:3].min() - error)


@given(half_curvature=VALUES, end=st.floats(0.01, 3.0), error_ratio=st.floats(0.1, 2.0))
def test_lower_bound_after_a_double_zero_is_exact(half_curvature: float, end: float, error_ratio: float) -> None:
    # The guard starts with a double zero. The guard is at least tau^2 (half_curvature (1 - tau) + end tau) minus the
    # interpolation error tau^2 (1 - tau)^2 / 24 fourth_derivative. At error_ratio 1 both are equal near tau = 0.
    assume(abs(error_ratio - 1.0) > 1e-6 and abs(half_curvature) > 1e-3)
    fourth_derivative = error_ratio * 24 * abs(half_curvature)
    assume(end > fourth_derivative * HERMITE_ERROR)
    lower_bound = _lower_bound(0.0, 0.0, end, 3 * end - half_curvature, fourth_derivative, 2)
    # Smallest possible guard, divided by tau^2.
    smallest = half_curvature * (1 - TAU) + end * TAU - fourth_derivative * (1 - TAU) ** 2 / 24
    initial_value = half_curvature - fourth_derivative / 24
    assert (lower_bound > 0.0) == (initial_value > 0.0)
    if lower_bound > 0.0:
        assert (smallest > 0.0).all()


@pytest.mark.parametrize("length", [1.0, 0.3])
def test_series_bounds_contain_the_guard(length: float) -> None:
    engine = propagator()
    model, state, bound = engine.tables.model, engine.state, engine.workspace.bound
    state.regime[:] = FLIGHT, FLOOR, CEILING
    signals = engine.workspace.signals
    load_signals(model.laws, state.regime, signals.row)
    # The signal depends on the position of the body in flight, and on its acceleration in contact.
    rows = model.laws.elements.position_index.copy()
    rows[1:] = model.laws.elements.velocity_index[1:]
    state_series = engine.workspace.state_series
    state_series[:] = np.random.default_rng(5).standard_normal(state_series.shape)
    # A state is followed by the accelerations, then by their derivatives.
    end_state, first_acceleration = engine.workspace.end_state, engine.tables.size
    bound_by_series(model, signals, state_series, length, state.z, end_state, bound)
    for j in range(3):
        series = np.polynomial.Polynomial(state_series[:N_COEFFICIENTS, rows[j]])
        if state.regime[j] != FLIGHT:
            series = series.deriv() / model.step
            index = first_acceleration + model.laws.elements.position_index[j]
            for z, tau in ((state.z, 0.0), (end_state, length)):
                assert z[index] == pytest.approx(series(tau))
                assert z[index + model.first_velocity] == pytest.approx(series.deriv()(tau))
        # The bounds of the fourth derivative, then of the magnitude, of each signal.
        absolute_series = np.polynomial.Polynomial(np.abs(series.coef))
        assert bound[j] == pytest.approx(absolute_series.deriv(4)(1.0))
        assert bound[len(bound) // 2 + j] == pytest.approx(absolute_series(1.0))


def test_series_bound_of_finite_contact_is_infinite() -> None:
    engine = propagator("2 ms")
    model, work = engine.tables.model, engine.workspace
    load_signals(model.laws, engine.state.regime, work.signals.row)
    bound_by_series(model, work.signals, work.state_series, 1.0, engine.state.z, work.end_state, work.bound)
    assert (work.bound[work.signals.indices[work.signals.row[model.laws.elements.first_slot], BOUND]] == np.inf).all()


class Step:
    """A time step from a random state by power series, and the guard values at any time in the step."""

    def __init__(self, engine: Propagator, contacts: list[int], random_values: np.ndarray) -> None:
        self.engine, self.contacts = engine, contacts
        model, system, state = engine.tables.model, engine.system, engine.state
        size, count, dampers = engine.tables.size, system.coordinates, system.dampers
        z = np.concatenate(
            [
                3e-3 * random_values[:count],
                0.1 * random_values[count : 2 * count],
                5.0 * random_values[2 * count : size],
            ]
        )
        position, speed = random_values[size : size + dampers], random_values[size + dampers :]
        for j in np.flatnonzero(system.finite_contact):
            # A gap between the walls in flight; in contact, an overlap with the wall.
            gap = (0.5 + 0.48 * np.sin(position[j])) * CLEARANCE
            z[model.laws.elements.gap_coordinate[j]] = [gap, -0.1 * gap, CLEARANCE + 0.1 * gap][contacts[j]]
        regimes = [
            list(element.law.regimes)[contact] for element, contact in zip(system.elements, contacts, strict=True)
        ]
        self.configuration = system.configuration(regimes)
        self.matrix, self.offset = (array.astype(float) for array in engine.tables.generator(self.configuration))
        state.regime[:] = contacts
        state.height[:] = z[model.laws.elements.position_index] + (0.5 + 0.48 * np.sin(position)) * CLEARANCE
        state.velocity[:] = 0.1 * speed
        scaled, term = self.matrix * model.step, (self.matrix @ z + self.offset) * model.step
        self.taylor_terms = [z]
        for k in range(1, 25):
            self.taylor_terms.append(term / k)
            term = scaled @ term / k
        self.table_index = engine.tables.table_index(self.configuration)
        bound = engine.tables.flow.bound[self.table_index][:size]
        self.bounds = engine.tables.flow.bound_constant[self.table_index] + np.abs(z) @ bound
        load_signals(model.laws, state.regime, engine.workspace.signals.row)
        self.bound = self.bounds[
            engine.workspace.signals.indices[engine.workspace.signals.row[model.laws.elements.first_slot], BOUND]
        ]

    def guards(self, tau: np.ndarray) -> list[tuple[int, np.ndarray]]:
        """Return (damper from 0, array of shape (3, times)) for every guard.

        The rows are the guard's value and its first and fourth derivatives with respect to tau.
        """
        engine, model, state, result = self.engine, self.engine.tables.model, self.engine.state, []
        force, constant = engine.system.contact_forces(self.configuration)
        for j, contact in enumerate(self.contacts):
            sign = -1.0 if contact == CEILING else 1.0
            row, offset, flight_terms = np.zeros(engine.tables.size), 0.0, np.zeros(3)
            if engine.system.finite_contact[j] and contact != FLIGHT:
                row[: engine.system.states], offset = (
                    sign * force[model.laws.elements.gap_coordinate[j]],
                    sign * constant[model.laws.elements.gap_coordinate[j]],
                )
            elif engine.system.finite_contact[j]:
                row[model.laws.elements.gap_coordinate[j]] = 1.0
            elif contact != FLIGHT:
                row = sign * self.matrix[model.laws.elements.velocity_index[j]]
                offset = sign * (self.offset[model.laws.elements.velocity_index[j]] + model.gravity)
            else:
                row[model.laws.elements.position_index[j]] = -1.0
                flight_terms[:] = (state.height[j], state.velocity[j] * model.step, -model.gravity * model.step**2 / 2)
            series = np.polynomial.Polynomial([row @ term for term in self.taylor_terms])
            series = series + np.polynomial.Polynomial([offset, 0.0, 0.0]) + np.polynomial.Polynomial(flight_terms)
            walls = [series, CLEARANCE - series] if engine.system.clearance[j] < np.inf else [series]
            for guard in walls if contact == FLIGHT else walls[:1]:
                result.append((j, np.array([guard(tau), guard.deriv()(tau), guard.deriv(4)(tau)])))
        return result

    def lower_bounds(self, length: float) -> np.ndarray:
        """Return the Bernstein coefficients of every guard's cubic minus its error, (guards, 4).

        The guard is proven positive if all four are positive.
        """
        result = []
        for j, (value, slope, _) in self.guards(np.array([0.0, length])):
            inner = value[0] + slope[0] * length / 3, value[1] - slope[1] * length / 3
            result.append(np.array([value[0], *inner, value[1]]) - self.bound[j] * length**4 * HERMITE_ERROR)
        return np.array(result)

    def examine(self, length: float) -> tuple[bool, float, int]:
        """Return whether the engine must examine a series, and the time and damper of the first event in the step.

        The time is a fraction of `length`, or NO_CROSSING.
        """
        engine, model, state, work, size = (
            self.engine, self.engine.tables.model, self.engine.state, self.engine.workspace, self.engine.tables.size,
        )  # fmt: skip
        for z, tau in ((state.z, 0.0), (work.end_state, length)):
            z[:size] = sum(term * tau**k for k, term in enumerate(self.taylor_terms))
            rate = self.matrix @ z[:size] + self.offset
            accelerations = slice(model.first_velocity, 2 * model.first_velocity)
            derivatives = np.concatenate([rate[accelerations], model.step * (self.matrix @ rate)[accelerations]])
            z[size : size + len(derivatives)] = derivatives
        flow = engine.tables.flow
        bound_by_tables(flow, self.table_index, state.z, work)
        np.testing.assert_allclose(work.bound, self.bounds, rtol=1e-12)
        unproven_low, unproven_high = screen(model.gravity, state, work, length, length * model.step)
        if unproven_low | unproven_high:
            expand_state(flow, model.step, self.table_index, state.z, work.state_series)
        tau, slot, _ = first_event(model, state, work, length, unproven_low, unproven_high)
        return bool(unproven_low | unproven_high), tau, int(work.signals.indices[work.signals.row[slot], ELEMENT])


def draw_state(engine: Propagator, rng: np.random.Generator) -> np.ndarray:
    """Draw the random values of a `Step`."""
    return rng.standard_normal(engine.tables.size + 2 * engine.system.dampers)


@pytest.mark.parametrize("contact_duration", ["", "10 ms"])
@given(
    contacts=st.lists(st.sampled_from([FLIGHT, FLOOR, CEILING]), min_size=3, max_size=3),
    seed=st.integers(0, 100_000),
    length=st.sampled_from([1.0, 0.4]),
)
@settings(max_examples=50, deadline=None)
def test_first_falling_guard_is_located(contact_duration: str, contacts: list[int], seed: int, length: float) -> None:
    engine = propagator(contact_duration)
    step = Step(engine, contacts, draw_state(engine, np.random.default_rng(seed)))
    times = np.linspace(0.0, length, 400)
    guards = step.guards(times)
    for j, guard in guards:
        assert (np.abs(guard[2]) <= step.bound[j] * (1 + 1e-6) + 1e-12).all()
    assume(all(guard[0, 0] > 0.0 for _, guard in guards))
    _, tau, damper = step.examine(length)
    before = times < (length if tau == NO_CROSSING else tau * length) - 1e-9
    assert all((guard[0, before] > 0.0).all() for _, guard in guards)
    if tau != NO_CROSSING:
        crossing = [guard[:2, 0] for j, guard in step.guards(np.array([tau * length])) if j == damper]
        value, slope = min(crossing, key=lambda guard: abs(guard[0]))
        scale = max(np.abs(guard[0]).max() for j, guard in guards if j == damper)
        assert abs(value) < 1e-9 * scale and slope < 0.0


@pytest.mark.parametrize("duration", ["", "10 ms"])
@pytest.mark.parametrize("contact", [FLIGHT, FLOOR, CEILING])
@pytest.mark.parametrize("length", [1.0, 0.4])
def test_proven_guard_is_not_examined(duration: str, contact: int, length: float) -> None:
    rng = np.random.default_rng(8)
    for clearance in (CLEARANCE, np.inf) if contact == FLIGHT else (CLEARANCE,):
        engine = propagator(duration, (2,), clearance)
        draws = [draw_state(engine, rng) * rng.uniform(0.0, 1.0) for _ in range(120)]
        bounds = [Step(engine, [contact], draw).lower_bounds(length) for draw in draws]
        proven_draws = [draw for draw, result in zip(draws, bounds, strict=True) if result.min() > 0.0]
        # For each coefficient of each guard, a state in which this coefficient is the lowest and not positive.
        unproven_draws = {
            int(result.argmin()): draw for draw, result in zip(draws, bounds, strict=True) if result.min() <= 0.0
        }
        assert unproven_draws and proven_draws
        for proven, unproven in zip(cycle(proven_draws), unproven_draws.values()):
            # Bisect between the states until they are close to the limit at which the guard is proven positive.
            for _ in range(24):
                middle = (proven + unproven) / 2
                if Step(engine, [contact], middle).lower_bounds(length).min() > 0.0:
                    proven = middle
                else:
                    unproven = middle
            assert not Step(engine, [contact], proven).examine(length)[0]
            assert Step(engine, [contact], unproven).examine(length)[0]


@given(
    contacts=st.lists(st.sampled_from([FLIGHT, FLOOR, CEILING]), min_size=3, max_size=3),
    seed=st.integers(0, 1000),
    duration=st.sampled_from([0.0, 1e-3]),
    low_guard=st.integers(-1, 2),
)
def test_one_guard_below_its_margin_is_detected(contacts, seed, duration, low_guard):
    # A margin is the value that a guard must exceed at both ends of a step. `low_guard`: damper whose guard is below
    # its margin, or -1. `duration`: time from the state of the dampers to z, s.
    engine, rng = propagator(), np.random.default_rng(seed)
    model, state, columns = engine.tables.model, engine.state, engine.tables.size
    z = state.z
    z[model.laws.elements.position_index] = 1e-4 * rng.standard_normal(3)
    state.regime[:] = contacts
    state.velocity[:] = 0.01 * rng.standard_normal(3)
    gap = rng.uniform(0.1, 0.9, 3) * CLEARANCE
    drop = model.gravity * duration**2 / 2
    state.height[:] = z[model.laws.elements.position_index] + gap - state.velocity * duration + drop
    guard = np.empty(3)
    for j, contact in enumerate(contacts):
        relative_acceleration = rng.uniform(0.1, 5.0)
        z[columns + model.laws.elements.position_index[j]] = -model.gravity + (
            -relative_acceleration if contact == CEILING else relative_acceleration
        )
        guard[j] = min(gap[j], CLEARANCE - gap[j]) if contact == FLIGHT else relative_acceleration
    margin = guard * (1 - 1e-9)
    if low_guard >= 0:
        margin[low_guard] = guard[low_guard] * (1 + 1e-9)
    signals = engine.workspace.signals
    load_signals(model.laws, state.regime, signals.row)
    signals.lowest[:] = signals.numbers[signals.row, LOWER] + margin
    signals.highest[:] = signals.numbers[signals.row, UPPER] - margin
    assert inside_margins(model.gravity, state, signals, z, duration) == (low_guard < 0)


def test_envelope_contains_all_states_until_reset() -> None:
    # The envelope is an upper bound of the magnitude of every state variable; the margins are linear in it.
    engine = propagator()
    flow, work, columns = engine.tables.flow, engine.workspace, engine.tables.size
    states = np.zeros((5, len(work.magnitude)))
    states[:, :columns] = np.random.default_rng(2).standard_normal((5, columns))
    widen_envelope(flow, 0, np.ones(len(work.magnitude)), work)
    reset_envelope(work.envelope, columns)
    assert (work.envelope[:columns] == 0.0).all()
    for z in states:
        widen_envelope(flow, 0, z, work)
    largest = np.abs(states).max(axis=0)[:columns]
    assert (work.envelope[:columns] >= largest).all()
    expected = flow.margin_constant[0] + work.envelope[:columns] @ flow.margin[0]
    np.testing.assert_allclose(work.margin, expected, rtol=1e-12)
