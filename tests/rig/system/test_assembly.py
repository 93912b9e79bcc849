"""The assembled equations of motion, compared with transfer functions, static deflections and initial states."""

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.core.laws.landing import duration_and_restitution
from rig.core.system.assembly import assemble, force_row
from rig.core.system.hybrid_system import HybridSystem

# Masses [kg], springs [N/m] and dashpots [N s/m] of the chain, body 1 first.
M1, M2, K1, K2, C1, C2 = 1.0, 0.5, 4e3, 2e3, 3.0, 1.0
# Laplace variable at the compared frequencies, rad/s.
S = 2j * np.pi * np.array([0.5, 7.0, 40.0, 300.0, 2000.0])


def scene_of(**parts: object) -> rig.Scene:
    """Return a chain of two bodies with dashpots, and other parts of the scene."""
    structure = {"masses": [M1, M2], "springs": [K1, K2], "damping": {"dashpots": [C1, C2]}}
    return rig.Scene.model_validate({"structure": structure, **parts})


def response(system: HybridSystem, column: int = 0) -> dict[str, np.ndarray]:
    """Return the response of each coordinate to a unit of an input at the frequencies of `S`."""
    n, currents = system.coordinates, len(system.rate_state)
    result = []
    for s in S:
        dynamic_stiffness = np.zeros((n + currents, n + currents), dtype=complex)
        dynamic_stiffness[:n, :n] = (
            system.mass * s**2 - system.force_state[:, :n] - s * system.force_state[:, n : 2 * n]
        )
        dynamic_stiffness[:n, n:] = -system.force_state[:, 2 * n :]
        dynamic_stiffness[n:, :n] = -system.rate_state[:, :n] - s * system.rate_state[:, n : 2 * n]
        dynamic_stiffness[n:, n:] = s * np.eye(currents) - system.rate_state[:, 2 * n :]
        input_column = np.concatenate([system.force_drive[:, column], system.rate_drive[:, column]])
        result.append(np.linalg.solve(dynamic_stiffness, input_column))
    return dict(zip(system.points, np.array(result).T, strict=False))


def link(spring: float, dashpot: float) -> np.ndarray:
    """Return the dynamic stiffness of a spring with a parallel dashpot."""
    return spring + dashpot * S


def stiffness_of_body_2(ground_spring: float = 0.0) -> np.ndarray:
    """Return the dynamic stiffness at body 2 (force / displacement), with a spring [N/m] to ground."""
    body_1, link_2 = link(K1, C1) + M1 * S**2, link(K2, C2)
    return M2 * S**2 + body_1 * link_2 / (body_1 + link_2) + ground_spring


def test_table_is_a_critically_damped_servo() -> None:
    scene = scene_of(shaker={"kind": "table", "body": 2, "spring": 6e3, "bandwidth": 150.0})
    motion = response(assemble(scene))
    table = 1.0 / (1.0 + S / (2 * np.pi * 150.0)) ** 2
    np.testing.assert_allclose(motion["table"], table, rtol=1e-10)
    np.testing.assert_allclose(motion["body 2"], 6e3 * table / stiffness_of_body_2(6e3), rtol=1e-9)


@pytest.mark.parametrize("mode", ["voltage", "current"])
def test_electrodynamic_shaker_obeys_its_equations(mode: str) -> None:
    resistance, inductance, factor, spring, gain = 2.5, 3e-4, 12.0, 5e3, 1.7
    armature = {"mass": 0.3, "stiffness": 7e3, "damping": 9.0}
    coil = {"resistance": resistance, "inductance": inductance, "force_factor": factor}
    amplifier = {"mode": mode, "gain": gain}
    shaker = {"body": 2, "spring": spring, "coil": coil, "armature": armature, "amplifier": amplifier}
    shaker["kind"] = "electrodynamic"
    system = assemble(scene_of(shaker=shaker))
    motion = response(system)
    body = stiffness_of_body_2()
    armature_stiffness = 0.3 * S**2 + 9.0 * S + 7e3 + spring * body / (spring + body)
    if mode == "voltage":
        impedance = resistance + inductance * S
        expected = factor * gain / (impedance * armature_stiffness + factor**2 * S)
    else:
        expected = factor * gain / armature_stiffness
    np.testing.assert_allclose(motion["table"], expected, rtol=1e-9)
    np.testing.assert_allclose(motion["body 2"], motion["table"] * spring / (spring + body), rtol=1e-9)
    row = force_row(scene_of(shaker=shaker), system)
    assert row.tolist() == [0.0, -spring, spring, *[0.0] * (system.states - 3)]


def test_each_input_acts_on_its_body() -> None:
    test = {"kind": "impulse", "body": 2, "peak": 10.0, "width": 4e-3}
    scene = scene_of(shaker={"kind": "force", "body": [1, 2]}, test=test)
    system = assemble(scene)
    assert (system.inputs, system.drive_units) == (("shaker", "hammer"), ("N", "N"))
    receptance_22 = 1.0 / stiffness_of_body_2()
    body_1, link_2 = link(K1, C1) + M1 * S**2, link(K2, C2)
    receptance_11 = 1.0 / (body_1 + link_2 * M2 * S**2 / (link_2 + M2 * S**2))
    receptance_12 = receptance_22 * link_2 / (body_1 + link_2)
    np.testing.assert_allclose(response(system, 1)["body 2"], receptance_22, rtol=1e-9)
    np.testing.assert_allclose(response(system, 0)["body 2"], receptance_22 + receptance_12, rtol=1e-9)
    np.testing.assert_allclose(response(system, 0)["body 1"], receptance_11 + receptance_12, rtol=1e-9)
    assert not force_row(scene, system).any()


def test_dampers_of_all_kinds_are_assembled() -> None:
    dampers = [
        {"body": 2, "mass": 0.1, "clearance": 1e-3},
        {"body": 1, "mass": 0.2, "clearance": 2e-3, "locked": True},
        {"body": 4, "mass": 0.05, "clearance": 3e-3, "contact": {"duration": 1e-3}, "restitution": 0.4},
        {"body": 5, "mass": 0.01, "clearance": 0.0},
        {
            "body": 3,
            "mass": 0.02,
            "clearance": 4e-3,
            "contact": {"floor": {"stiffness": 5e5, "damping": 2.0}, "ceiling": {"duration": 2e-3}},
            "restitution": 0.7,
        },
    ]
    masses, springs = np.array([1.0, 0.5, 0.8, 0.6, 0.7]), np.array([4e3, 5e3, 2e3, 3e3, 6e3])
    structure = {"masses": masses.tolist(), "springs": springs.tolist()}
    scene = rig.Scene.model_validate({"structure": structure, "dampers": dampers, "gravity": 10.0})
    system = assemble(scene)
    assert system.damper_number.tolist() == [1, 3, 5]
    assert system.damper_coordinate.tolist() == [1, 3, 2]
    assert system.gap_coordinate.tolist() == [-1, 5, 6]
    assert system.damper_mass.tolist() == [0.1, 0.05, 0.02]
    assert system.clearance.tolist() == [1e-3, 3e-3, 4e-3]
    assert system.restitution.tolist() == [0.0, 0.4, 0.7]
    # Twice the kinetic energy of bodies with locked dampers, and of dampers with finite-duration contact, whose
    # coordinate is the gap (5 and 6).
    v = np.array([0.3, -0.2, 0.5, 0.7, -0.4, 0.9, -0.6])
    masses_with_locked = np.add(masses, [0.2, 0.0, 0.0, 0.0, 0.01])
    energy = masses_with_locked @ v[:5] ** 2 + 0.05 * (v[3] + v[5]) ** 2 + 0.02 * (v[2] + v[6]) ** 2
    assert v @ system.mass @ v == pytest.approx(energy)
    # The weight of locked dampers, and of dampers with finite-duration contact, always acts.
    assert system.force_constant == pytest.approx([-2.0, 0.0, -0.2, -0.5, -0.1, -0.5, -0.2])
    reduced_mass = {1: 1.0 / (1.0 / 0.05 + 1.0 / 0.6), 2: 1.0 / (1.0 / 0.02 + 1.0 / 0.8)}
    for j, wall, expected in ((1, 0, (1e-3, 0.4)), (1, 1, (1e-3, 0.4)), (2, 1, (2e-3, 0.7))):
        stiffness, damping = system.wall_stiffness[j, wall], system.wall_damping[j, wall]
        result = duration_and_restitution(stiffness, damping, reduced_mass[j])
        assert result == pytest.approx(expected)
    assert (system.wall_stiffness[2, 0], system.wall_damping[2, 0]) == (5e5, 2.0)
    assert not system.wall_stiffness[0].any() and not system.wall_damping[0].any()
    # Static equilibrium: springs carry the weight of all dampers, and floors yield to the weight of their dampers.
    weight = np.array([2.0, 1.0, 0.2, 0.5, 0.1])
    deflection = -np.cumsum(np.cumsum(weight[::-1])[::-1] / springs)
    assert system.initial[:7] == pytest.approx([*deflection, -0.5 / system.wall_stiffness[1, 0], -0.2 / 5e5])
    assert not system.initial[7:].any()


def test_initial_displacement_adds_to_static_equilibrium() -> None:
    damper = {"body": 1, "mass": 0.1, "clearance": 1e-3}
    start = {"kind": "free", "displacement": [1e-3, 2e-3], "velocity": [0.1, -0.2], "duration": 1.0}
    weight = 0.1 * 9.80665
    settled = assemble(scene_of(dampers=[damper], test=start)).initial
    assert settled == pytest.approx([1e-3 - weight / K1, 2e-3 - weight / K1, 0.1, -0.2])
    empty = assemble(scene_of(dampers=[damper], test={**start, "start": "empty"})).initial
    assert empty == pytest.approx([1e-3, 2e-3, 0.1, -0.2])
    # First mode of the chain, from its characteristic equation in the squared angular frequency.
    mode = {"kind": "free", "mode": 1, "amplitude": 3e-3, "duration": 1.0, "start": "empty"}
    shape = assemble(scene_of(test=mode)).initial[:2]
    squared = min(np.roots([M1 * M2, -(M1 * K2 + M2 * (K1 + K2)), K1 * K2]).real)
    assert shape == pytest.approx([3e-3 * (1.0 - M2 * squared / K2), 3e-3])


@pytest.mark.parametrize(("contact", "max_dampers"), [({}, 62), ({"contact": {"duration": 1e-3}}, 31)])
def test_too_many_moving_dampers_are_rejected(contact: dict[str, object], max_dampers: int) -> None:
    def with_dampers(count: int) -> rig.Scene:
        structure = {"masses": [1.0] * (count + 1), "springs": [1e3] * (count + 1)}
        damper = {"mass": 1e-3, "clearance": 1e-3}
        dampers = [{"body": body, **damper} for body in range(1, count)]
        dampers += [{"body": count, **damper, **contact}, {"body": count + 1, **damper, "locked": True}]
        return rig.Scene.model_validate({"structure": structure, "dampers": dampers})

    assert assemble(with_dampers(max_dampers)).dampers == max_dampers
    with pytest.raises(SceneError, match=f"at most {max_dampers}"):
        assemble(with_dampers(max_dampers + 1))


def test_extremely_stiff_contact_keeps_the_static_equilibrium() -> None:
    damper = {"body": 1, "mass": 0.1, "clearance": 1e-3, "contact": {"duration": 1e-15}, "restitution": 0.5}
    deflection = 0.1 * 9.80665 / K1
    assert assemble(scene_of(dampers=[damper])).initial[:2] == pytest.approx([-deflection, -deflection])


def test_structure_without_support_is_rejected() -> None:
    floating = {"structure": {"masses": [1.0, 2.0], "springs": [0.0, 1e3]}}
    damper = {"body": 1, "mass": 0.1, "clearance": 1e-3}
    with pytest.raises(SceneError, match="structure has no support"):
        assemble(rig.Scene.model_validate({**floating, "dampers": [damper]}))
    # Without weight, or with unloaded springs, no support force is needed.
    assert not assemble(rig.Scene.model_validate({**floating, "dampers": [damper], "gravity": 0.0})).initial.any()
    assert not assemble(rig.Scene.model_validate(floating)).initial.any()
