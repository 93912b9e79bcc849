"""Base excitation, `shaker: {kind: base}`, against closed forms and against forces in relative coordinates."""

from typing import Any

import numpy as np
import pytest

import rig
from rig.core.base.arrays import Array, ComplexArray
from rig.core.system.assembly import assemble
from rig.core.system.open_loop_drive import riding_response
from rig.core.system.structural_model import driven_bodies, structural_model, transmissibility

CHAIN = {"masses": [0.74, 0.71, 0.64], "springs": [24300.0, 21800.0, 19800.0], "damping": {"modal": [0.01, 0.02, 0.05]}}
DAMPER = {"body": 3, "mass_ratio": 0.06, "clearance": "0.8 mm"}
FREQUENCY = np.array([1.0, 9.0, 13.0365, 20.0, 35.0, 49.6, 80.0])


def scene(structure: dict[str, Any] | None = None, **sections: Any) -> rig.Scene:
    test = {"kind": "sine", "frequency": "13 Hz", "duration": "2 s", "drive": "4 m/s^2"}
    return rig.load(
        {"structure": structure or CHAIN, "shaker": {"kind": "base"}, "converter": {"rate": 2000}, "test": test}
        | sections
    )


def ratio_of_states(tested: rig.Scene, frequency: Array) -> ComplexArray:
    """Return the displacement of each body over that of the table, from the equations of the engine."""
    system = assemble(tested)
    states = riding_response(system, "shaker", 2.0 * np.pi * frequency)
    return states[: tested.structure.bodies] / states[system.points.index("table")]


def closed_form(tested: rig.Scene, frequency: Array, influence: Array) -> ComplexArray:
    """Return r + (K + i w C - w^2 M)^-1 M r w^2: relative motion under the forces -M r z''."""
    model = structural_model(tested)
    omega = 2.0 * np.pi * frequency[:, None, None]
    dynamic = model.stiffness + 1j * omega * model.damping - omega**2 * model.mass
    force = omega**2 * (model.mass @ influence)[:, None]
    return np.asarray(influence[:, None] + np.linalg.solve(dynamic, force)[..., 0].T)


@pytest.mark.parametrize("damping_ratio", [0.001, 0.05, 0.7])
def test_one_body_has_closed_form(damping_ratio: float) -> None:
    dashpot = 2.0 * damping_ratio * np.sqrt(2.0 * 2e4)
    tested = scene({"masses": [2.0], "springs": [2e4], "damping": {"dashpots": [dashpot]}})
    beta = 2.0 * np.pi * FREQUENCY / np.sqrt(2e4 / 2.0)
    magnitude = np.sqrt((1 + (2 * damping_ratio * beta) ** 2) / ((1 - beta**2) ** 2 + (2 * damping_ratio * beta) ** 2))
    np.testing.assert_allclose(abs(ratio_of_states(tested, FREQUENCY)[0]), magnitude, rtol=1e-11)
    np.testing.assert_allclose(abs(transmissibility(tested, FREQUENCY)[0]), magnitude, rtol=1e-11)


def test_chain_has_closed_form() -> None:
    exact = closed_form(scene(), FREQUENCY, np.ones(3))
    np.testing.assert_allclose(ratio_of_states(scene(), FREQUENCY), exact, rtol=1e-9)
    np.testing.assert_allclose(transmissibility(scene(), FREQUENCY), exact, rtol=1e-9)


def test_matrices_use_influence() -> None:
    # A body on two springs of unequal stiffness, with its rotation as the second coordinate.
    matrices = {"mass": [[2.0, 0.0], [0.0, 0.1]], "stiffness": [[3e4, 1e3], [1e3, 2e3]], "influence": [1.0, 0.0]}
    tested = scene({"matrices": matrices, "damping": {"rayleigh": {"alpha": 2.0, "beta": 1e-4}}})
    # Rayleigh damping acts on the motion relative to the table.
    exact = closed_form(tested, FREQUENCY, np.array([1.0, 0.0]))
    np.testing.assert_allclose(ratio_of_states(tested, FREQUENCY), exact, rtol=1e-9)


def test_steady_responses_are_transmissibilities() -> None:
    exact = closed_form(scene(), FREQUENCY[1:4], np.ones(3))
    settled, orbits = rig.frequency_response(scene(), FREQUENCY[1:4]), rig.orbit_response(scene(), FREQUENCY[1:4])
    np.testing.assert_allclose(orbits.frf, exact, rtol=1e-9)
    np.testing.assert_allclose(settled.frf, exact, rtol=1e-6)
    assert settled.response.unit == orbits.response.unit == "m/m"
    assert "body 3_m/m" in settled.columns() and "m/m at" in orbits.summary()


def test_damped_orbit_equals_settled_motion() -> None:
    damped = scene(dampers=[DAMPER])
    settled, orbits = rig.frequency_response(damped, [12.7]), rig.orbit_response(damped, [12.7])
    assert orbits.motion_type[0] != "riding"
    np.testing.assert_allclose(orbits.frf, settled.frf, rtol=1e-6)


def test_energy_of_base_is_balanced() -> None:
    energy = rig.simulate(scene(dampers=[DAMPER]), 2.0, rate=2000.0).energy
    assert energy.impacts > 0.0 and energy.work > 0.0
    assert abs(energy.residual) < 1e-12 * energy.work


def test_relative_motion_follows_inertia_forces() -> None:
    # Almost without centering, the acceleration of the table is linear between samples, as the forces are.
    drive = np.random.default_rng(1).standard_normal(4001)
    base = rig.simulate(scene(shaker={"kind": "base", "centering": 1e-6}), 2.0, rate=2000.0, drive=drive[None])
    forces = [{"kind": "force", "body": body} for body in (1, 2, 3)]
    inertia = -np.array(CHAIN["masses"])[:, None] * base.acceleration[base.points.index("table")]
    relative = rig.simulate(scene(shaker=forces, test=None), 2.0, rate=2000.0, drive=inertia).displacement
    difference = base.displacement[:3] - base.displacement[base.points.index("table")] - relative[:3]
    assert abs(difference).max() < 1e-9 * abs(relative).max()


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"test": {"kind": "sine", "frequency": 9.0, "force": 1.0}}, "test.force: a shaker of kind base"),
        ({"channels": [{"name": "force", "at": "shaker"}]}, "at: table"),
        (
            {"shaker": [{"kind": "base"}, {"kind": "table", "body": 1, "spring": 1e3}], "test": None},
            "combined with shakers of kind force only",
        ),
        (
            {"structure": {"matrices": {"mass": [[1.0]], "stiffness": [[9.0]], "influence": [1.0, 0.0]}}},
            "structure.matrices.influence: got 2 values",
        ),
    ],
)
def test_wrong_scene_of_base_is_rejected(sections: dict[str, Any], message: str) -> None:
    with pytest.raises(rig.SceneError, match=message):
        scene(**sections)


def test_free_structure_on_base_is_rejected() -> None:
    with pytest.raises(rig.SceneError, match="nothing connects the structure to the ground"):
        assemble(scene({"masses": [1.0, 2.0], "springs": [0.0, 1e4]}))


def test_base_has_no_driven_body() -> None:
    with pytest.raises(rig.SceneError, match="excited at its base"):
        driven_bodies(scene())
