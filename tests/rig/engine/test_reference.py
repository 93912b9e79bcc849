"""The engine, compared with exact events, declared contact laws, 40-digit solutions and closed forms.

The reference cases A, B and C are bundled scenes of the published problem, from rest over 100 periods of the drive. The
tests with `each_table_size` run for each set of tables that the engine may compute (`conftest`).
"""

import json
from pathlib import Path

import numpy as np
import pytest
from mpmath import findroot, mpf

import rig
from rig.core.base.errors import RunError, SceneError
from tests.rig.engine.exact import Segment
from tests.rig.laws.test_declarations import assert_motion_as_declared

# Kinds of events: names in the reference file, and in the engine.
KINDS = {
    "takeoff_floor": "separation",
    "land_floor": "floor",
    "takeoff_ceiling": "separation",
    "land_ceiling": "ceiling",
}


def simulate_scene(name: str, **changes: object) -> rig.Run:
    """Simulate a bundled scene over the duration of its test."""
    scene = rig.load(name).replace(**changes)
    return rig.simulate(scene, scene.test.duration, rate=2000.0)


def single_body(**test: object) -> rig.Scene:
    """Return a body of 1 kg at 10 Hz with a damper of 50 g, driven by a force of 6 N at 9 Hz; `test`: changed keys."""
    stiffness = (2 * np.pi * 10.0) ** 2
    return rig.Scene(
        structure={"masses": [1.0], "springs": [stiffness], "damping": {"modal": 0.01}},
        dampers=[{"body": 1, "mass": 0.05, "clearance": float("inf")}],
        shaker={"kind": "force", "body": 1},
        test={"kind": "sine", "frequency": 9.0, "force": 6.0, "duration": 1.0, **test},
    )


def reference_events() -> list[tuple[mpf, int, str]]:
    """Return the exact events of case A: time to 40 digits, damper from 1, kind."""
    data = Path(__file__).parent / "data" / "reference-A-events.json"
    return [(mpf(time), damper + 1, KINDS[kind]) for time, damper, kind in json.loads(data.read_text(encoding="utf-8"))]


@pytest.mark.usefixtures("each_table_size")
def test_reference_case_a_events_are_exact() -> None:
    reference = reference_events()
    events = simulate_scene("reference-A").events
    assert len(reference) == len(events) == 463
    assert [(int(event["damper"]), str(event["kind"])) for event in events] == [
        reference_event[1:] for reference_event in reference
    ]
    assert np.abs(events["time"] - [float(event[0]) for event in reference]).max() < 1e-12


@pytest.mark.thorough
def test_case_a_positions_agree_to_forty_digits() -> None:
    scene = rig.load("reference-A")
    run = simulate_scene("reference-A")
    segments: dict[tuple[int, ...], Segment] = {}
    on_floor, current_time, flight_velocity = (0, 1, 2), mpf(0), {}
    state = Segment(scene, on_floor).initial_state()
    # Change of the body's velocity in a perfectly plastic impact, relative to the closing speed. The dampers have 10 %
    # of the body mass.
    velocity_transfer = [mpf(0.1 * mass) / (mpf(0.1 * mass) + mpf(mass)) for mass in scene.structure.masses]
    end = len(run.time) - 1
    for time, damper, kind in [*reference_events(), (mpf(end) / 2000, 0, "end")]:
        segment = segments.setdefault(on_floor, Segment(scene, on_floor))
        state = segment.propagate(state, time - current_time)
        speed_loss = segment.gravity * (time - current_time)
        flight_velocity = {j: velocity - speed_loss for j, velocity in flight_velocity.items()}
        current_time, j = time, damper - 1
        if kind == "separation":
            flight_velocity[j] = state[3 + j]
            on_floor = tuple(k for k in on_floor if k != j)
        elif kind == "floor":
            state[3 + j] += velocity_transfer[j] * (flight_velocity.pop(j) - state[3 + j])
            on_floor = tuple(sorted((*on_floor, j)))
    for j in range(3):
        assert abs(run.displacement[j, end] - float(state[j])) < 1e-12 * np.abs(run.displacement[j]).max()


@pytest.mark.usefixtures("each_table_size")
@pytest.mark.parametrize(("name", "count"), [("reference-B", 273), ("reference-C", 984)])
def test_reference_cases_have_known_event_counts(name: str, count: int) -> None:
    run = simulate_scene(name)
    assert len(run.events) == count
    assert run.ambiguous == 0


def test_case_b_has_one_near_grazing_impact() -> None:
    events = simulate_scene("reference-B").events
    # The drive of case B has 312.4 rad/s. The ceiling impact in period 80 has a closing speed of only 7 mm/s.
    period = events["time"] * 312.4 / (2 * np.pi)
    impacts = events[(period > 80) & (period < 81) & (events["kind"] == "ceiling")]
    assert len(impacts) == 1
    assert impacts["speed"][0] == pytest.approx(7e-3, rel=0.05)


@pytest.mark.thorough
def test_random_beds_move_as_declared() -> None:
    random = np.random.default_rng(11)
    for _ in range(4):
        assert_motion_as_declared(_random_scene(random), 8)


def _random_scene(random: np.random.Generator) -> rig.Scene:
    """Draw a chain of one to three bodies with dampers, from light to heavy and from undamped to well damped."""
    bodies = int(random.integers(1, 4))
    masses = random.uniform(0.5, 1.5, bodies)
    omega = np.exp(random.uniform(np.log(30.0), np.log(500.0)))
    springs = masses * omega**2 * random.uniform(0.5, 2.0, bodies)
    dampers = [
        {
            "body": int(body) + 1,
            "mass_ratio": float(np.exp(random.uniform(np.log(0.01), np.log(2.0)))),
            "clearance": float(random.choice([np.exp(random.uniform(np.log(3e-5), np.log(3e-3))), np.inf])),
        }
        for body in range(bodies)
        if random.random() < 0.8 or body == 0
    ]
    return rig.Scene(
        structure={
            "masses": masses.tolist(),
            "springs": springs.tolist(),
            "damping": {"modal": float(np.exp(random.uniform(np.log(1e-4), np.log(0.1))))},
        },
        dampers=dampers,
        shaker={"kind": "force", "body": 1},
        test={
            "kind": "sine",
            "start": "empty",
            "frequency": float(omega / 2 / np.pi * random.uniform(0.6, 1.4)),
            "force": float(masses.sum() * 9.80665 * np.exp(random.uniform(np.log(0.3), np.log(3.0)))),
        },
    )


def first_flight_peak(scene: rig.Scene) -> tuple[mpf, mpf]:
    """Return the largest gap of the first flight of damper 1 [m], and its time [s], to 40 digits."""
    run = rig.simulate(scene, 1.0, rate=20_000.0)
    separation, landing = run.events["time"][:2]
    is_flight = (run.time > separation) & (run.time < landing)
    peak_time = run.time[is_flight][np.argmax(run.gap[0, is_flight])]
    on_floor, in_flight = Segment(scene, (0,)), Segment(scene, ())
    start = on_floor.initial_state()

    def contact_acceleration(t: mpf) -> mpf:
        return on_floor.acceleration(on_floor.propagate(start, t), 0) + on_floor.gravity

    exact_separation = findroot(contact_acceleration, (mpf(separation), mpf(separation) + mpf("1e-9")), tol=1e-60)
    separation_state = on_floor.propagate(start, exact_separation)

    def relative_velocity(t: mpf) -> mpf:
        state = in_flight.propagate(separation_state, t - exact_separation)
        return separation_state[1] - in_flight.gravity * (t - exact_separation) - state[1]

    exact_peak_time = findroot(relative_velocity, (mpf(peak_time), mpf(peak_time) + mpf("1e-7")), tol=1e-60)
    flight_time = exact_peak_time - exact_separation
    height = separation_state[0] + separation_state[1] * flight_time - in_flight.gravity * flight_time**2 / 2
    return height - in_flight.propagate(separation_state, flight_time)[0], exact_peak_time


@pytest.mark.parametrize("distance", [1e-6, 1e-9, 1e-12, 1e-15])
def test_only_a_ceiling_within_reach_is_hit(distance: float) -> None:
    # `distance`: between the ceiling and the apex of the flight, m. The ceiling is first below (sign 1), then above it.
    scene = single_body(start="empty")
    largest_gap, peak_time = first_flight_peak(scene)
    kinds = {}
    for sign in (1, -1):
        clearance = float(largest_gap - sign * mpf(distance))
        damper = {"body": 1, "mass": 0.05, "clearance": clearance}
        events = rig.simulate(scene.replace(dampers=[damper]), float(peak_time) + 1e-3, rate=1000.0).events
        kinds[sign] = [str(kind) for kind in events["kind"]]
    assert kinds[1] == ["separation", "ceiling", "separation"]
    assert kinds[-1] == ["separation"]


@pytest.mark.parametrize("depth", [1e-2, 1e-6, 1e-10, 1e-12])
def test_damper_separates_only_at_negative_contact_force(depth: float) -> None:
    # While the damper is on the floor, its acceleration is proportional to the force. The lowest acceleration at 1 N
    # gives the force at which the lowest acceleration is -(1 + depth) g or -(1 - depth) g.
    unit_force_scene = single_body(force=1.0)
    on_floor = Segment(unit_force_scene.replace(gravity=0.0), (0,))
    start = on_floor.initial_state()
    run = rig.simulate(unit_force_scene, 0.5, rate=20_000.0)
    guess = run.time[np.argmin(run.acceleration[0])]
    lowest_time = findroot(
        lambda t: on_floor.jerk(on_floor.propagate(start, t), 0), (mpf(guess), mpf(guess) + mpf("1e-6")), tol=1e-60
    )
    lowest = on_floor.acceleration(on_floor.propagate(start, lowest_time), 0)
    events = {}
    for sign in (1, -1):
        force = float(-mpf(unit_force_scene.gravity) * (1 + sign * mpf(depth)) / lowest)
        events[sign] = rig.simulate(single_body(force=force), float(lowest_time) + 1e-4, rate=1000.0).events
    assert len(events[-1]) == 0
    assert str(events[1]["kind"][0]) == "separation"
    # The contact force is a parabola near its minimum, which limits the time from separation to the minimum.
    assert 0.0 < float(lowest_time) - events[1]["time"][0] < 0.05 * np.sqrt(depth)


def test_undamped_resonance_agrees_to_forty_digits() -> None:
    scene = single_body().replace(dampers=())
    structure = scene.structure.replace(damping=None)
    natural_frequency = np.sqrt(structure.springs[0]) / (2 * np.pi)
    scene = scene.replace(structure=structure, test={"kind": "sine", "frequency": natural_frequency, "force": 6.0})
    run = rig.simulate(scene, 10.0, rate=50.0)
    segment = Segment(scene, ())
    state, previous = segment.initial_state(), 0
    for k in (1, 10, 100, 500):
        state, previous = segment.propagate(state, mpf(k - previous) / 50), k
        exact = float(state[0])
        # At resonance the amplitude grows as F t / (2 m w), here with 6 N and 1 kg.
        amplitude = 6.0 * run.time[k] / (2 * 2 * np.pi * natural_frequency)
        assert abs(run.displacement[0, k] - exact) < 1e-12 * amplitude


def test_critically_damped_return_is_closed_form() -> None:
    omega = 2 * np.pi * 10.0
    scene = rig.loads(
        f"""
        structure: {{masses: [1.0], springs: [{omega**2!r}], damping: {{dashpots: [{2 * omega!r}]}}}}
        test: {{kind: free, displacement: [1e-3], duration: 1}}
        """,
        where="test",
    )
    run = rig.simulate(scene, 0.5, rate=1000.0)
    exact = 1e-3 * (1 + omega * run.time) * np.exp(-omega * run.time)
    np.testing.assert_allclose(run.displacement[0], exact, rtol=1e-12, atol=1e-28)


def test_response_without_dampers_is_linear_receptance() -> None:
    from rig.core.system.structural_model import receptance

    scene = rig.load("reference-C").replace(dampers=())
    frequencies = [10.0, 13.04, 25.0, 49.7, 60.0]
    response = rig.frequency_response(scene, frequencies)
    np.testing.assert_allclose(response.compliance, receptance(scene, frequencies), rtol=1e-7)
    assert set(response.motion_type) == {"linear"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"duration": float("nan")}, "duration"),
        ({"duration": -1.0}, "duration"),
        ({"rate": float("inf")}, "rate"),
        ({"frequency": 0.0}, "frequency"),
    ],
)
def test_error_names_the_invalid_argument(change: dict[str, object], message: str) -> None:
    arguments = {"duration": 0.1, "rate": 1000.0, **change}
    with pytest.raises(SceneError) as error:
        rig.simulate("reference-A", **arguments)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("drive", "message"),
    [
        (np.full((1, 100), np.nan), "drive: got nan at sample 0 of input shaker"),
        (np.zeros((2, 100)), "drive: got an array of shape (2, 100); expected shape (1, samples)"),
        ([[1.0, 2.0], [3.0]], "drive: the values are not real numbers, or the rows differ in length"),
        ([[1j] * 101], "drive: the values are not real numbers"),
    ],
)
def test_error_describes_the_invalid_drive(drive: object, message: str) -> None:
    with pytest.raises(RunError) as error:
        rig.simulate("reference-A", 0.1, 1000.0, drive=drive)
    assert message in str(error.value)


def test_error_gives_the_sample_of_the_whole_run() -> None:
    plant = rig.Plant(rig.load("fig9"), 5120.0)
    plant.advance(np.zeros((1, 10)))
    drive = np.zeros((1, 10))
    drive[0, 3] = np.inf
    with pytest.raises(RunError, match="inf at sample 13 of input shaker"):
        plant.advance(drive)
