"""The method of Inoue, Yokomichi, Hiraki (2011), compared with integration, known limits and laws of mechanics.

A branch is a curve of periodic motions of type I, II or III over frequency. ``tau`` is the phase of the force from the
floor impact: take-off from the floor at tau_0, ceiling impact at tau_1, take-off from the ceiling at tau_2.
"""

from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import rig
from rig.core.base.errors import SceneError
from rig.core.system.structural_model import receptance
from rig.studies.single_mode.admissibility import Batch, flaws
from rig.studies.single_mode.approximate_response import (
    Approximation,
    Branch,
    approximate_response,
    dimensionless,
    follow_mode,
)
from rig.studies.single_mode.motion_search import solutions
from rig.studies.single_mode.periodic_motion import INSTANTS, MotionParameters, MotionType, PeriodicMotion, jacobian
from rig.studies.single_mode.reduction import SingleMode, single_mode
from tests.rig.bouncing_ball import fly, take_off_phase


@cache
def fig9() -> Approximation:
    return follow_mode(single_mode(rig.load("fig9"), 3), (46.0, 53.0), searches=3)


@cache
def single_damper() -> Approximation:
    """The scene of Fig. 5 with a lower force: all three types, folds, and invalid parts of branches."""
    return follow_mode(single_mode(rig.load("fig5-single-damper"), 3, force=5.0), (45.0, 55.0), searches=3)


def branches(approximation: Approximation, kind: str) -> list[Branch]:
    return [branch for branch in approximation.branches if branch.motion_type == kind]


class IntegratedMode:
    """The mode with its damper in SI units, integrated by a general solver between events.

    The state is displacement and velocity of the mode at the damper, then of the damper.
    """

    def __init__(self, mode: SingleMode, frequency: float, phi: float) -> None:
        self.mode = mode
        self.omega = 2 * np.pi * frequency
        self.phi = phi

    def rate(self, riding: bool, t: float, state: np.ndarray) -> np.ndarray:
        """Return the time derivative of the state; `riding`: whether the damper is in contact."""
        mode = self.mode
        q, u, _, v = state
        ratio = mode.mass_ratio * riding
        force_per_mass = (
            mode.participation * mode.force * np.sin(self.omega * t - self.phi) / mode.mass - ratio * mode.gravity
        )
        acceleration = (force_per_mass - 2 * mode.damping_ratio * mode.omega * u - mode.omega**2 * q) / (1 + ratio)
        return np.array([u, acceleration, v, acceleration if riding else -mode.gravity])

    def integrate(self, riding: bool, begin: float, end: float, state: np.ndarray) -> np.ndarray:
        return solve_ivp(
            lambda t, x: self.rate(riding, t, x), (begin, end), state, method="DOP853", rtol=3e-14, atol=1e-18
        ).y[:, -1]

    def after_plastic_impact(self, state: np.ndarray) -> np.ndarray:
        """Return the state in which damper and mode have their common velocity."""
        q, u, y, v = state
        common = (u + self.mode.mass_ratio * v) / (1 + self.mode.mass_ratio)
        return np.array([q, common, y, common])


def sample_points(branch: Branch, count: int) -> list[int]:
    """Return the indices of some points within the valid part of a branch."""
    valid_points = np.flatnonzero(branch.valid)
    return [int(i) for i in valid_points[np.linspace(0, len(valid_points) - 1, count + 2).astype(int)[1:-1]]]


@pytest.mark.parametrize("kind", ["I", "II", "III"])
def test_integrated_motion_fulfills_all_conditions(kind: str) -> None:
    for branch in branches(single_damper(), kind):
        for i in sample_points(branch, 3):
            mode = single_damper().mode
            system = IntegratedMode(mode, branch.frequency[i], branch.phi[i])
            length = mode.gravity / system.omega**2
            q0, u0 = branch.unknowns[:2, i] * length * np.array([1, system.omega])
            amplitude = abs(branch.peak[i]) * mode.force
            take_off_time = branch.tau_0[i] / system.omega
            start = np.array([q0, u0, q0, u0])

            state = system.integrate(True, 0, take_off_time, start)
            assert system.rate(True, take_off_time, state)[1] == pytest.approx(-mode.gravity, rel=1e-10)
            time = take_off_time
            if kind != "I":
                time = branch.tau_1[i] / system.omega
                state = system.integrate(False, take_off_time, time, state)
                assert abs(state[2] - state[0] - mode.clearance) < 1e-10 * amplitude
                state = system.after_plastic_impact(state)
            if kind == "III":
                begin, time = time, branch.tau_2[i] / system.omega
                state = system.integrate(True, begin, time, state)
                assert system.rate(True, time, state)[1] == pytest.approx(-mode.gravity, rel=1e-10)
            state = system.integrate(False, time, 2 * np.pi / system.omega, state)
            assert abs(state[2] - state[0]) < 1e-10 * amplitude
            after = system.after_plastic_impact(state)
            assert abs(after[0] - q0) < 1e-10 * amplitude
            assert abs(after[1] - u0) < 1e-10 * amplitude * system.omega


def test_fig_9_has_type_ii_at_resonance() -> None:
    result = fig9()

    (second,) = branches(result, "II")
    inside = second.frequency[second.valid & second.stable]
    # Hz; the resonance is at 49.7 Hz.
    assert inside.min() < 48.7
    assert inside.max() > 51.0
    assert inside.min() < result.mode.riding_frequency < result.mode.frequency < inside.max()
    assert [branch.valid.all() for branch in branches(result, "I")] == [True, True]
    assert result.failures == ()
    # The damper reduces the resonance peak to less than a quarter.
    highest = np.abs(second.compliance[second.valid]).max()
    assert highest < 0.25 * np.abs(result.mode.receptance([result.mode.frequency]))[0]


@pytest.mark.thorough
def test_fig_5_has_type_iii_at_resonance() -> None:
    result = follow_mode(single_mode(rig.load("fig5-single-damper"), 3), (48.0, 49.0), searches=2)

    (third,) = branches(result, "III")
    assert third.valid.all()
    assert third.stable.all()
    assert (third.tau_1 < third.tau_2).all()


def test_type_ii_ends_where_type_iii_begins() -> None:
    result = fig9()

    (second,) = branches(result, "II")
    (third,) = branches(result, "III")
    changes = np.flatnonzero(np.diff(second.valid.astype(int)))
    borders = 0.5 * (second.frequency[changes] + second.frequency[changes + 1])
    steps = np.abs(np.diff(second.frequency))[changes]
    assert third.ends == ("the stay at the ceiling vanishes",) * 2
    np.testing.assert_array_less(np.abs(borders - third.frequency[[0, -1]]), steps)
    np.testing.assert_allclose(third.tau_1[[0, -1]], third.tau_2[[0, -1]], atol=1e-3)


@pytest.mark.parametrize("kind", ["I", "II", "III"])
def test_jacobian_equals_finite_differences(kind: MotionType) -> None:
    parameters = dimensionless(single_damper().mode, 0.97)
    # Any q_0, q'_0, a, b, and instants in order.
    unknowns = np.array([0.3, -1.2, 0.1, 0.25, 0.8, 2.9, 3.6])[: 4 + INSTANTS[kind]]

    values, slopes = jacobian(kind, unknowns, parameters, "ratio")

    def conditions(x: np.ndarray) -> np.ndarray:
        return PeriodicMotion(kind, x[:-1], parameters._replace(ratio=x[-1])).conditions()

    x = np.append(unknowns, parameters.ratio)
    numerical = np.array([(conditions(x + step) - conditions(x - step)) / 2e-6 for step in 1e-6 * np.eye(len(x))]).T
    np.testing.assert_allclose(values, conditions(x), rtol=1e-13)
    np.testing.assert_allclose(slopes, numerical, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("kind", ["I", "II", "III"])
def test_floquet_multipliers_equal_finite_differences(kind: str) -> None:
    branch = branches(single_damper(), kind)[-1]
    (i,) = sample_points(branch, 1)
    mode = single_damper().mode
    system = IntegratedMode(mode, branch.frequency[i], branch.phi[i])
    length = mode.gravity / system.omega**2
    units = length * np.array([1, system.omega])
    period = 2 * np.pi / system.omega

    def events(riding: bool, ceiling: bool) -> list:
        def contact(t: float, x: np.ndarray) -> float:
            return (system.rate(True, t, x)[1] + mode.gravity) * (-1 if ceiling else 1)

        def gap(t: float, x: np.ndarray) -> float:
            return x[2] - x[0]

        def ceiling_gap(t: float, x: np.ndarray) -> float:
            return mode.clearance - x[2] + x[0]

        guards = [contact] if riding else [gap, ceiling_gap]
        for guard in guards:
            guard.terminal, guard.direction = True, -1
        return guards

    def after_a_period(begin: np.ndarray) -> np.ndarray:
        """Return the state of the mode a period after tau = 0.1, where the damper is on the floor."""
        time, riding, ceiling = 0.1 / system.omega, True, False
        state = np.array([begin[0], begin[1], begin[0], begin[1]])
        end = time + period
        while True:
            segment = solve_ivp(
                lambda t, x, riding=riding: system.rate(riding, t, x), (time, end), state, method="DOP853",
                rtol=1e-12, atol=1e-16, events=events(riding, ceiling), max_step=period / 100,
            )  # fmt: skip
            time, state = segment.t[-1], segment.y[:, -1]
            if segment.status == 0:
                assert riding
                return state[:2]
            if riding:
                riding = False
                # Skip some microseconds: the zero of the gap at the separation is not an event.
                state = system.integrate(False, time, time + 2e-5, state)
                time += 2e-5
            else:
                ceiling = len(segment.t_events[1]) > 0
                state = system.after_plastic_impact(state)
                riding = not ceiling or system.rate(True, time, state)[1] < -mode.gravity
                if not riding:
                    state = system.integrate(False, time, time + 2e-5, state)
                    time += 2e-5

    start = system.integrate(True, 0, 0.1 / system.omega, np.tile(branch.unknowns[:2, i] * units, 2))[:2]
    step = 1e-4
    columns = [
        (after_a_period(start + change) - after_a_period(start - change)) / (2 * step * units)
        for change in step * np.diag(units)
    ]

    numerical = np.linalg.eigvals(np.array(columns).T)

    np.testing.assert_allclose(np.sort_complex(numerical), np.sort_complex(branch.multipliers[:, i]), atol=1e-5)


@pytest.mark.parametrize("acceleration", [1.2, 2.0, 3.0])
def test_vanishing_damper_moves_as_inelastic_ball(acceleration: float) -> None:
    mode = single_mode(rig.load("fig8-one-damper"), 3, force=1.0, at=1)
    light = SingleMode(**{**vars(mode), "mass_ratio": 1e-9})
    band = (0.9 * mode.frequency, 0.901 * mode.frequency)
    acceleration_per_newton = abs(light.receptance([band[0]])[0]) * (2 * np.pi * band[0]) ** 2 / light.gravity
    light = SingleMode(**{**vars(light), "force": acceleration / acceleration_per_newton})

    (branch,) = follow_mode(light, band, searches=2).branches

    flight = fly(acceleration, take_off_phase(acceleration))
    at_start = int(np.argmin(branch.frequency))
    assert branch.valid.all()
    assert 2 * np.pi - branch.tau_0[at_start] == pytest.approx(flight.end - flight.start, abs=1e-6)
    # The phase of the body's motion at the floor impact equals the phase of the ball's landing.
    motion = branch.compliance[at_start] * -1j * np.exp(-1j * branch.phi[at_start])
    landing_phase = np.angle(motion) + np.pi / 2
    assert np.angle(np.exp(1j * (landing_phase - flight.end))) == pytest.approx(0, abs=1e-6)


def test_mode_without_clearance_has_the_riding_response() -> None:
    scene = rig.load("fig9")
    locked = scene.replace(dampers=[scene.dampers[0].replace(clearance=0.0)])

    result = approximate_response(locked, 3, (47.0, 52.0))

    assert result.branches == ()
    # The single-mode method neglects the change of the mode shape due to the damper mass, and the other modes.
    band = np.linspace(48.6, 49.2, 601)
    riding_response, exact = result.mode.receptance(band, riding=True), receptance(locked, band)[1]
    assert band[np.abs(riding_response).argmax()] == pytest.approx(band[np.abs(exact).argmax()], rel=1e-3)
    assert np.abs(riding_response).max() == pytest.approx(np.abs(exact).max(), rel=0.02)


def test_small_clearance_converges_to_added_mass() -> None:
    scene = rig.load("fig9")
    deviations = []
    for clearance in (2e-5, 1e-5, 5e-6):
        narrow = scene.replace(dampers=[scene.dampers[0].replace(clearance=clearance)])
        result = follow_mode(single_mode(narrow, 3), (48.9, 48.95), searches=1)
        (branch,) = [branch for branch in result.branches if (branch.valid & branch.stable).any()]
        riding_response = result.mode.receptance(branch.frequency, riding=True)
        deviations.append(np.abs(branch.compliance / riding_response - 1)[branch.valid].max())

    assert deviations[2] < 0.01
    assert deviations[1] / deviations[0] == pytest.approx(0.5, abs=0.1)
    assert deviations[2] / deviations[1] == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("kind", ["I", "II", "III"])
def test_input_energy_equals_damping_and_impact_losses(kind: str) -> None:
    mode = single_damper().mode
    branch = branches(single_damper(), kind)[0]
    (i,) = sample_points(branch, 1)
    parameters = dimensionless(mode, branch.frequency[i] / mode.frequency)
    motion = PeriodicMotion(kind, branch.unknowns[:, i], parameters)
    omega = 2 * np.pi * branch.frequency[i]
    length = mode.gravity / omega**2

    # Work of the force in a period: pi F times the quadrature component of the displacement.
    work = -np.pi * mode.participation * mode.force * (branch.compliance[i] * mode.force).imag
    nodes, weights = np.polynomial.legendre.leggauss(40)
    dissipated = 0.0
    for phase in motion.phases:
        t = 0.5 * phase.duration * (nodes + 1)
        speed = motion.advance(phase, t).u * length * omega
        damping = 2 * mode.damping_ratio * mode.omega * mode.mass
        dissipated += damping * 0.5 * phase.duration / omega * float(weights @ speed**2)
    damper_mass = mode.mass_ratio * mode.mass
    impacts = [motion.landing] + ([motion.before_ceiling] if kind != "I" else [])
    for state in impacts:
        closing_speed = (state.v - state.u) * length * omega
        dissipated += 0.5 * damper_mass * mode.mass / (damper_mass + mode.mass) * closing_speed**2

    assert dissipated == pytest.approx(work, rel=1e-9)


def test_type_i_that_hits_the_ceiling_is_inadmissible() -> None:
    parameters = dimensionless(single_damper().mode, 0.93)._replace(clearance=0.1)
    motions = solutions("I", parameters).T
    batch = Batch("I", motions, MotionParameters(*(np.full(motions.shape[1], value) for value in parameters)))

    assert set(flaws(batch)) == {"hits the ceiling early"}


def test_printed_weighting_rejects_a_damper_moving_in_antiphase() -> None:
    scene = rig.load("fig8-one-damper")

    with pytest.raises(SceneError, match=r"weighting='printed'"):
        single_mode(scene, 3)
    # The energy weighting and the normalization at the damper agree.
    by_energy = single_mode(scene, 3, weighting="energy")
    at_damper = single_mode(scene, 3, at=1)
    assert by_energy.mass_ratio == pytest.approx(at_damper.mass_ratio, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "damper", "message"),
    [
        ("fig5-three-dampers", {"clearance": 2e-3}, "same clearance"),
        ("fig9", {"restitution": 0.3}, r"restitution 0\.3"),
        ("fig9", {"contact": {"duration": 5e-3}}, "its contact has a finite duration"),
    ],
)
def test_unsupported_dampers_are_rejected(name: str, damper: dict[str, object], message: str) -> None:
    first, *others = rig.load(name).dampers
    with pytest.raises(SceneError, match=message):
        single_mode(rig.load(name).replace(dampers=[first.replace(**damper), *others]), 3)
