"""Finite-duration contact, compared with 40-digit solutions, closed forms, energy balance and instant contact."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

import rig
from rig.core.laws.landing import duration_and_restitution, spring_damper
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import tone_drive
from rig.studies.cost.high_precision import exact_motion
from tests.rig.landing_force import peak_force
from tests.rig.laws.test_declarations import assert_motion_as_declared

SAMPLES_PER_PERIOD = 16


def random_scene(seed: int, bodies: int) -> rig.Scene:
    """Return a driven chain with a damper in every body, whose walls are defined in one of four forms."""
    random = np.random.default_rng(seed)
    masses, springs = random.uniform(0.3, 1.2, bodies), random.uniform(8e3, 4e4, bodies)
    frequency = float(random.uniform(0.5, 1.6) * math.sqrt(springs.mean() / masses.mean()) / (2 * math.pi))

    def duration() -> float:
        """Draw a contact duration between 3 % and 30 % of the drive period, s."""
        return float(10 ** random.uniform(-1.5, -0.5) / frequency)

    def wall(mass: float) -> dict[str, float]:
        """Draw stiffness and damping of a wall; sometimes without damping."""
        omega = math.pi / duration()
        damping = 2 * mass * omega * 10 ** random.uniform(-2.5, 0.3)
        return {"stiffness": mass * omega**2, "damping": damping if random.random() < 0.7 else 0.0}

    dampers = []
    for body in range(1, bodies + 1):
        mass = float(random.uniform(0.03, 0.4) * masses[body - 1])
        clearance = float(random.uniform(2e-4, 2e-3)) if random.random() < 0.7 else math.inf
        forms = [
            {"contact": {"duration": duration()}},
            {"contact": {"duration": duration()}, "restitution": float(random.uniform(0.02, 0.95))},
            {"contact": wall(mass)},
            {"contact": {"floor": wall(mass), "ceiling": wall(mass)}},
        ]
        dampers.append({"body": body, "mass": mass, "clearance": clearance, **forms[random.integers(4)]})
    return rig.Scene(
        structure={
            "masses": masses.tolist(),
            "springs": springs.tolist(),
            "damping": {"modal": float(random.uniform(0.001, 0.02))},
        },
        dampers=dampers,
        shaker={"kind": "force", "body": int(random.integers(1, bodies + 1))},
        test={
            "kind": "sine", "frequency": frequency, "force": float(random.uniform(5, 30)), "start": "empty",
            "duration": 1.0,
        },
    )  # fmt: skip


@pytest.mark.usefixtures("each_table_size")
@pytest.mark.parametrize(("seed", "bodies"), [(0, 1), (4, 1), (5, 2), (7, 1), (7314, 1)])
def test_random_finite_contacts_move_as_declared(seed: int, bodies: int) -> None:
    assert assert_motion_as_declared(random_scene(seed, bodies), 3) > 2


@pytest.mark.parametrize(("seed", "bodies"), [(0, 1), (4, 1), (5, 2), (7, 1), (7314, 1)])
def test_finite_contact_motion_agrees_to_forty_digits(seed: int, bodies: int) -> None:
    scene = random_scene(seed, bodies)
    system = assemble(scene)
    tone = tone_drive(scene, system)
    run = rig.simulate(scene, 3 / tone.frequency, rate=SAMPLES_PER_PERIOD * tone.frequency)
    exact = exact_motion(system, tone, run, SAMPLES_PER_PERIOD)
    displacement = exact.displacement.astype(float)
    np.testing.assert_allclose(run.displacement, displacement, rtol=0, atol=1e-12 * np.abs(displacement).max())
    np.testing.assert_allclose(run.events["time"], exact.event_time.astype(float), rtol=0, atol=1e-12)
    assert abs(run.energy.residual) < 1e-12 * abs(run.energy.work)


@pytest.mark.parametrize("ratio", [0.0, 1e-14, 1e-11, 1e-9, 1e-7])
@pytest.mark.parametrize("seed", [9000, 9147, 9149])
def test_weak_dashpot_causes_no_second_touch(seed: int, ratio: float) -> None:
    # `ratio`: damping ratio of the contacts. With a weak dashpot the force ends almost at zero overlap, where rounding
    # could cause another touch with zero speed.
    scene = random_scene(seed, 2)
    dampers = []
    for body, (body_mass, omega) in enumerate(zip(scene.structure.masses, (2e3, 5e3), strict=True), 1):
        mass = 0.03 * body_mass
        contact = {"stiffness": mass * omega**2, "damping": 2 * ratio * mass * omega}
        dampers.append({"body": body, "mass": mass, "clearance": 1e-3, "contact": contact})
    run = rig.simulate(scene.replace(dampers=dampers), 0.5, rate=2000.0)
    assert len(run.events) > 20
    assert (run.events["speed"][run.events["kind"] == "touch"] > 0.0).all()


@given(st.floats(1e-5, 0.1), st.floats(1e-3, 0.999), st.floats(1e-3, 10.0))
def test_spring_damper_has_duration_and_restitution(duration: float, restitution: float, mass: float) -> None:
    computed = duration_and_restitution(*spring_damper(duration, restitution, mass), mass)
    np.testing.assert_allclose(computed, (duration, restitution), rtol=1e-11)


@pytest.mark.parametrize("ratio", [0.05, 0.3, 0.499, 0.7, 1.0, 4.0])
def test_closed_form_of_the_peak_contact_force(ratio: float) -> None:
    # `ratio`: damping ratio. A mass of 70 g hits a spring and dashpot at 1.7 m/s.
    mass, stiffness, speed = 0.07, 3e4, 1.7
    omega = math.sqrt(stiffness / mass)
    damping = 2.0 * ratio * mass * omega
    system_matrix = np.array([[0.0, 1.0], [-stiffness / mass, -damping / mass]])
    states = [expm(system_matrix * angle / omega) @ (0.0, speed) for angle in np.linspace(0.0, 2.0, 2001)]
    expected = (np.array(states) @ (stiffness, damping)).max()
    assert peak_force(stiffness, damping, mass, speed) == pytest.approx(expected, rel=1e-6)


def test_residual_restitution_decreases_with_the_duration() -> None:
    # A dashpot of finite damping leaves a residual restitution where 0 is required. At 10 ms it is exp(-2), that of
    # critical damping.
    mass = 0.05
    restitutions = [duration_and_restitution(*spring_damper(t, 0.0, mass), mass)[1] for t in (1e-2, 1e-3, 1e-4, 1e-5)]
    assert restitutions[0] == pytest.approx(math.exp(-2.0))
    assert all(later < 0.2 * earlier for earlier, later in pairwise(restitutions))


@pytest.mark.parametrize("restitution", [0.3, 0.6, 0.9])
def test_free_landing_is_closed_form(restitution: float) -> None:
    # A hammer accelerates a free body towards its damper. Without gravity, only contacts change the motion afterwards.
    scene = rig.loads(
        f"""
        structure: {{masses: [0.8 kg], springs: [0 N/m]}}
        gravity: 0 m/s^2
        dampers: [{{body: 1, mass: 60 g, clearance: 0.1 mm, contact: {{duration: 2 ms}}, restitution: {restitution}}}]
        test: {{kind: impulse, body: 1, peak: 300 N, width: 0.2 ms, repeats: 1}}
        """
    )
    run = rig.simulate(scene, 0.2, rate=100e3)
    touch = int(np.flatnonzero((run.events["kind"] == "touch") & (run.events["time"] > 1e-3))[0])
    landing, release = run.events[touch], run.events[touch + 1]
    assert release["kind"] == "release"
    assert release["time"] - landing["time"] == pytest.approx(2e-3, rel=1e-9)
    # Without gravity the damper flies to the other wall with its separation speed.
    assert run.events[touch + 2]["speed"] == pytest.approx(restitution * landing["speed"], rel=1e-9)
    in_contact = (run.time >= landing["time"]) & (run.time <= release["time"])
    system = assemble(scene)
    stiffness, damping = system.wall_stiffness[0, 0], system.wall_damping[0, 0]
    peak = peak_force(stiffness, damping, float(system.reduced_mass[0]), float(landing["speed"]))
    # The body has 0.8 kg.
    assert np.abs(run.acceleration[0, in_contact]).max() == pytest.approx(peak / 0.8, rel=2e-3)


def test_short_contacts_converge_to_instant_contact() -> None:
    instant = rig.load("reference-A")
    reference = rig.simulate(instant, 0.3, rate=2000.0).displacement
    errors = []
    for duration in (4e-4, 1e-4, 2.5e-5):
        dampers = [damper.replace(contact={"duration": duration}) for damper in instant.dampers]
        run = rig.simulate(instant.replace(dampers=dampers), 0.3, rate=2000.0)
        errors.append(np.abs(run.displacement - reference).max() / np.abs(reference).max())
    # Order of convergence: the durations decrease by factors of 4.
    orders = np.log(np.array(errors[:-1]) / errors[1:]) / np.log(4.0)
    assert errors[-1] < 1e-3
    assert (orders > 0.7).all()


def test_dampers_rest_on_soft_floors() -> None:
    scene = rig.load("reference-A").replace(shaker=None, test={"kind": "free", "displacement": [0.0] * 3})
    scene = scene.replace(dampers=[damper.replace(contact={"duration": 5e-3}) for damper in scene.dampers])
    run = rig.simulate(scene, 0.5, rate=500.0)
    system = assemble(scene)
    static_overlap = system.damper_mass * scene.gravity / system.wall_stiffness[:, 0]
    assert len(run.events) == 0
    np.testing.assert_allclose(run.gap, np.broadcast_to(-static_overlap[:, None], run.gap.shape), rtol=1e-9)
    np.testing.assert_allclose(run.displacement, run.displacement[:, :1] * np.ones(len(run.time)), rtol=1e-9)


def test_block_size_changes_no_finite_contact() -> None:
    scene = rig.load("reference-C")
    scene = scene.replace(
        dampers=[damper.replace(contact={"duration": 1e-3}, restitution=0.2) for damper in scene.dampers]
    )
    drive = 20.0 * np.random.default_rng(1).standard_normal((1, 600))
    single_block = rig.Plant(scene, 5120.0).advance(drive)
    plant = rig.Plant(scene, 5120.0)
    blocks = [plant.advance(block) for block in np.split(drive, [1, 8, 250, 251], axis=1)]
    assert {"touch", "release"} <= set(single_block.events["kind"])
    for name in ("displacement", "velocity", "acceleration", "gap"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(block, name) for block in blocks], axis=1), getattr(single_block, name)
        )
    np.testing.assert_array_equal(np.concatenate([block.events for block in blocks]), single_block.events)
    # Accelerations are finite: at a discontinuity (the instant of a contact event) no velocity jumps.
    np.testing.assert_array_equal(single_block.discontinuity_velocity[0], single_block.discontinuity_velocity[1])
