"""Laws of any motion: no penetration, compressive contact, balance of momentum and energy, no effect of blocks.

A discontinuity is an instant at which a velocity or an acceleration jumps: an impact or a separation. A motion lists
the values before and after each discontinuity. The contact of a damper is FLIGHT, FLOOR or CEILING.
"""

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rig
from rig.core.laws.events import CEILING, FLIGHT, FLOOR
from rig.core.system.assembly import assemble


def log_uniform(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log(low), np.log(high)).map(lambda value: float(np.exp(value)))


@st.composite
def scenes(draw: st.DrawFn) -> rig.Scene:
    """Draw a structure of one to four bodies, as a chain or with a full mass matrix, with one to four dampers.

    The force is about the weight of the structure, so that most dampers fly.
    """
    bodies = draw(st.integers(1, 4))
    masses = draw(st.lists(st.floats(0.3, 2.0), min_size=bodies, max_size=bodies))
    omega = draw(log_uniform(30.0, 500.0))
    springs = [mass * omega**2 * draw(st.floats(0.3, 3.0)) for mass in masses]
    structure: dict[str, object] = {
        "masses": masses,
        "springs": springs,
        "damping": {"modal": draw(log_uniform(1e-4, 0.1))},
    }
    if draw(st.booleans()):
        from rig.core.system.structural_model import chain_matrix

        mass = np.diag(masses)
        mass = mass + 0.15 * np.sqrt(np.outer(np.diag(mass), np.diag(mass))) * (1 - np.eye(bodies))
        stiffness = chain_matrix(tuple(springs))
        structure = {
            "matrices": {"mass": mass.tolist(), "stiffness": stiffness.tolist(), "damping": (1e-4 * stiffness).tolist()}
        }
    damper_bodies = draw(st.lists(st.integers(1, bodies), min_size=1, max_size=4))
    dampers = [
        {
            "body": body,
            "mass_ratio": draw(log_uniform(0.01, 2.0)),
            "clearance": draw(st.one_of(st.just(float("inf")), log_uniform(3e-5, 3e-3))),
            "restitution": draw(st.sampled_from([0.0, 0.0, 0.3, 0.8])),
        }
        for body in damper_bodies
    ]
    test = {
        "kind": "sine",
        "start": draw(st.sampled_from(["empty", "settled"])),
        "frequency": omega / 2 / np.pi * draw(st.floats(0.5, 1.6)),
        "force": sum(masses) * 9.80665 * draw(log_uniform(0.3, 4.0)),
    }
    shaker = {"kind": "force", "body": draw(st.integers(1, bodies))}
    return rig.Scene.model_validate({"structure": structure, "dampers": dampers, "shaker": shaker, "test": test})


def test_damper_between_other_impacts_misses_no_ceiling() -> None:
    # Two dampers hit one body in turns, at ever shorter intervals. One of them is separated, and at the same instant
    # an impact of the other moves the ceiling towards it.
    inf = float("inf")
    scene = rig.Scene.model_validate(
        {
            "structure": {
                "masses": [1.0, 1.0, 1.0, 1.0],
                "springs": [1490.478993520864, 2980.957987041728, 2980.957987041728, 8942.873961125184],
                "damping": {"modal": 0.049787068367863944},
            },
            "dampers": [
                {"body": 1, "mass_ratio": 1.0, "clearance": inf},
                {"body": 4, "mass_ratio": 1.0, "clearance": 0.0024787521766663585},
                {"body": 4, "mass_ratio": 1.6487212707001282, "clearance": inf, "restitution": 0.3},
                {"body": 1, "mass_ratio": 1.0, "clearance": inf},
            ],
            "shaker": {"kind": "force", "body": 1},
            "test": {"kind": "sine", "start": "empty", "frequency": 4.344782730723917, "force": 39.2266},
        }
    )
    energy = rig.simulate(scene, 4.6).energy
    # A late impact lifts the damper to the ceiling without work, by 8 nm in this motion.
    assert abs(energy.residual) < 1e-12 * energy.work


@settings(max_examples=40)
@given(scene=scenes())
def test_dampers_stay_in_cavities_and_energy_balances(scene: rig.Scene) -> None:
    frequency = scene.test.frequency
    run = rig.simulate(scene, 20 / frequency, rate=40 * frequency)
    clearance = np.array([damper.clearance for damper in scene.dampers])[:, None]
    assert np.isfinite(run.displacement).all()
    assert (run.gap >= 0.0).all() and (run.gap <= clearance + 1e-12).all()
    # A missed impact would leave a damper in flight at zero gap without an event.
    for damper in range(len(scene.dampers)):
        zero_gap_times = run.time[(run.contact[damper] == FLIGHT) & (run.gap[damper] == 0.0)]
        event_times = run.events["time"][run.events["damper"] == damper + 1]
        assert all(np.abs(event_times - time).min() < 1e-6 for time in zero_gap_times)
    energy = run.energy
    exchanged_energy = abs(energy.work) + energy.dissipated + energy.impacts + abs(energy.stored)
    assert abs(energy.residual) < 1e-10 * exchanged_energy
    assert energy.impacts >= -1e-12 * exchanged_energy
    assert (run.events["speed"] >= 0.0).all()
    assert (np.diff(run.events["time"]) >= 0.0).all()


@settings(max_examples=40)
@given(scene=scenes())
def test_contact_force_at_rest_is_compressive(scene: rig.Scene) -> None:
    frequency = scene.test.frequency
    run = rig.simulate(scene, 20 / frequency, rate=40 * frequency)
    sign = np.select([run.contact == FLOOR, run.contact == CEILING], [1.0, -1.0], 0.0)
    body = [damper.body - 1 for damper in scene.dampers]
    force_per_mass = sign * (run.acceleration[body] + scene.gravity)
    assert force_per_mass.min() > -1e-9 * max(scene.gravity, np.abs(run.acceleration).max())


@pytest.mark.thorough
@settings(max_examples=15)
@given(scene=scenes(), seed=st.integers(0, 2**32 - 1))
def test_envelope_of_a_block_misses_no_event(scene: rig.Scene, seed: int) -> None:
    # In a block, the engine omits the search for events while the state is within an envelope (upper bounds of its
    # magnitudes) and all gaps and contact forces exceed their margins. Blocks of one sample have no envelope.
    random = np.random.default_rng(seed)
    rate = 800 * scene.test.frequency
    time = np.arange(1000) / rate
    tone = np.sin(2 * np.pi * scene.test.frequency * time) + 0.1 * random.standard_normal(len(time))
    drive = 3.0 * scene.test.force * tone[None]
    single_block = rig.Plant(scene, rate).advance(drive)
    plant = rig.Plant(scene, rate)
    samples = [plant.advance(drive[:, k : k + 1]) for k in range(len(time))]
    np.testing.assert_array_equal(np.concatenate([sample.events for sample in samples]), single_block.events)
    for field in ("displacement", "acceleration", "gap", "contact"):
        joined = np.concatenate([getattr(sample, field) for sample in samples], axis=1)
        np.testing.assert_array_equal(joined, getattr(single_block, field))


@settings(max_examples=40)
@given(scene=scenes(), seed=st.integers(0, 2**32 - 1))
def test_block_size_changes_no_bit(scene: rig.Scene, seed: int) -> None:
    random = np.random.default_rng(seed)
    drive = scene.test.force * random.standard_normal((1, 300))
    rate = 30 * scene.test.frequency
    single_block = rig.Plant(scene, rate).advance(drive)
    plant = rig.Plant(scene, rate)
    block_starts = np.sort(random.integers(0, 300, 6))
    blocks = [plant.advance(block) for block in np.split(drive, block_starts, axis=1)]
    for field in (
        "displacement",
        "velocity",
        "acceleration",
        "gap",
        "contact",
        "discontinuity_velocity",
        "discontinuity_acceleration",
    ):
        joined = np.concatenate([getattr(block_motion, field) for block_motion in blocks], axis=-1)
        np.testing.assert_array_equal(joined, getattr(single_block, field))
    for field in ("discontinuity_sample", "discontinuity_offset", "events"):
        np.testing.assert_array_equal(
            np.concatenate([getattr(block_motion, field) for block_motion in blocks]), getattr(single_block, field)
        )


def test_memory_layout_of_drive_changes_no_bit() -> None:
    force = {"kind": "force", "body": 1}
    scene = rig.load({"structure": {"masses": [1, 1], "springs": ["20 kN/m", "20 kN/m"]}, "shaker": [force, force]})
    drive = np.random.default_rng(1).standard_normal((2, 200))
    motions = []
    for order in ("C", "F"):
        plant = rig.Plant(scene, 2000.0)
        plant.advance(drive[:, :1])
        motions.append(plant.advance(np.asarray(drive, order=order)).displacement)
    np.testing.assert_array_equal(*motions)


@settings(max_examples=40)
@given(scene=scenes(), seed=st.integers(0, 2**32 - 1))
def test_impact_conserves_momentum(scene: rig.Scene, seed: int) -> None:
    scene = scene.replace(dampers=[damper.replace(restitution=0.0) for damper in scene.dampers])
    drive = scene.test.force * np.random.default_rng(seed).standard_normal((1, 400))
    rate = 30 * scene.test.frequency
    motion = rig.Plant(scene, rate).advance(drive)
    system = assemble(scene)
    time = (motion.discontinuity_sample - 1) / rate + motion.discontinuity_offset
    contacts = np.full(system.dampers, FLOOR)
    contacts[[int(e["damper"]) - 1 for e in motion.events if e["time"] == 0.0]] = FLIGHT
    events = motion.events[motion.events["time"] > 0.0]
    # Several discontinuities may coincide within rounding error. The list of events does not show to which
    # discontinuity each belongs.
    for discontinuities in np.split(np.arange(time.size), np.flatnonzero(np.diff(time) > SIMULTANEITY_S) + 1):
        if discontinuities.size:
            simultaneous = list(events[np.abs(time[discontinuities, None] - events["time"]).min(axis=0) <= 1e-12])
            next_contacts = contacts_after_breaks(system, motion, discontinuities.tolist(), simultaneous, contacts)
            assert next_contacts is not None, (
                f"no assignment of {simultaneous} to discontinuities {discontinuities} conserves momentum"
            )
            contacts = next_contacts


#: Impacts within this time, s, are treated as simultaneous in these tests.
SIMULTANEITY_S = 1e-9
#: Separation speed, m/s, below which the engine may keep a damper in contact during an impact and release it later:
#: the gap would be within rounding error.
MIN_SEPARATION_SPEED = 1e-6


def contacts_after_breaks(system, motion, discontinuities, events, contacts):
    """Return the contacts after several discontinuities, or None if no assignment of the events conserves momentum.

    `discontinuities`: indices of the discontinuities; `events`: to be assigned to the discontinuities in order;
    `contacts`: before the discontinuities.
    """
    if not discontinuities:
        return contacts if not events else None
    # `count`: number of events that are assigned to the first discontinuity.
    for count in range(len(events) + 1):
        after = contacts_after_break(system, motion, discontinuities[0], events[:count], contacts)
        next_contacts = (
            None if after is None else contacts_after_breaks(system, motion, discontinuities[1:], events[count:], after)
        )
        if next_contacts is not None:
            return next_contacts
    return None


def contacts_after_break(system, motion, k, events, contacts):
    """Return the contacts after discontinuity k with these events; None if they do not conserve momentum."""
    before, after = motion.discontinuity_velocity[:, :, k]
    impulse = system.mass @ (after - before)
    scale = np.abs(system.mass @ np.abs(before)).max() + np.abs(impulse).max()
    contacts, closing_speeds, separated = contacts.copy(), {}, set()
    for event in events:
        j = int(event["damper"]) - 1
        if event["kind"] == "separation":
            separated.add(j)
        else:
            closing_speeds[j] = float(event["speed"]) * (1.0 if event["kind"] == "floor" else -1.0)
            contacts[j] = FLOOR if event["kind"] == "floor" else CEILING
    # Sum of the momentum changes of bodies and dampers, which is zero. A damper that keeps contact at a small jump may
    # or may not have separated during the impact: both possibilities are tried.
    balance = impulse.copy()
    undecided: list[tuple[int, float]] = []
    for j in range(system.dampers):
        body = system.damper_coordinate[j]
        change = after[body] - before[body]
        if j in closing_speeds:
            # Before the impact the damper moved slower than the floor by the closing speed.
            balance[body] += system.damper_mass[j] * (change + closing_speeds[j])
        elif contacts[j] != FLIGHT and not (j in separated and separates(contacts[j], change)):
            balance[body] += system.damper_mass[j] * change
        elif contacts[j] != FLIGHT and abs(change) < MIN_SEPARATION_SPEED:
            undecided.append((body, system.damper_mass[j] * change))
    contacts[list(separated)] = FLIGHT
    for choice in product((0.0, 1.0), repeat=len(undecided)):
        undecided_impulse = np.bincount(
            [body for body, _ in undecided],
            [factor * impulse for factor, (_, impulse) in zip(choice, undecided, strict=True)],
            balance.size,
        )
        if np.abs(balance + undecided_impulse).max() < 1e-12 * max(scale, 1e-12):
            return contacts
    return None


def separates(contact: int, change: float) -> bool:
    """Return whether a damper in contact separates if the velocity of its body jumps by `change`, m/s."""
    return change < 0.0 if contact == FLOOR else change > 0.0


@pytest.mark.parametrize("name", ["fig8-three-dampers", "fig9", "bare-structure"])
def test_energy_balances_with_a_bundled_shaker(name: str) -> None:
    scene = rig.load(name)
    run = rig.simulate(scene, 1.0, rate=2000.0, frequency=35.0)
    exchanged_energy = run.energy.dissipated + run.energy.impacts + abs(run.energy.stored)
    assert exchanged_energy > 0.0
    assert abs(run.energy.residual) < 1e-10 * exchanged_energy


def test_dampers_settle_at_static_deflection() -> None:
    scene = rig.loads(
        """
        structure: {masses: [0.74, 0.71], springs: [24.3 kN/m, 21.8 kN/m], damping: {modal: 2 %}}
        dampers:
          - {body: 1, mass_ratio: 10 %, clearance: 1 mm}
          - {body: 2, mass_ratio: 10 %, clearance: .inf, restitution: 0.5}
        test: {kind: free, velocity: [1 m/s, -1 m/s], duration: 1 s}
        """,
        where="test",
    )
    run = rig.simulate(scene, 30.0, rate=100.0)
    # Each damper has 10 % of the mass of its body; the springs deflect under the weights above them.
    weight = 9.80665 * 0.1 * np.array([0.74, 0.71])
    deflection = -np.array([weight.sum() / 24.3e3, weight.sum() / 24.3e3 + weight[1] / 21.8e3])
    assert (run.contact[:, -1] == FLOOR).all()
    np.testing.assert_allclose(run.displacement[:, -1], deflection, rtol=1e-12)
    assert set(run.events["kind"]) == {"separation", "floor", "ceiling"}


@pytest.mark.parametrize(("body", "clearance"), [(1, 0.5e-3), (2, 0.98e-3), (3, float("inf"))])
def test_two_half_dampers_move_like_one_damper(body: int, clearance: float) -> None:
    whole_damper = {"body": body, "mass_ratio": 0.1, "clearance": clearance}
    half_damper = whole_damper | {"mass_ratio": 0.05}
    scene = rig.load("fig8-three-dampers").replace(
        test={"kind": "sine", "frequency": 33.0, "force": 2.6}, shaker={"kind": "force", "body": 1}, channels=None
    )
    motion, split_motion = (
        rig.simulate(scene.replace(dampers=dampers), 0.5) for dampers in ([whole_damper], [half_damper, half_damper])
    )
    assert motion.events.size > 3
    assert abs(motion.displacement - split_motion.displacement).max() < 1e-12 * abs(motion.displacement).max()
    for number in (1, 2):
        damper_events = split_motion.events[split_motion.events["damper"] == number]
        np.testing.assert_allclose(damper_events["time"], motion.events["time"], rtol=1e-12)
