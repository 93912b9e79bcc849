"""Interrupted simulations with grains continue from a checkpoint with identical results.

A run writes its checkpoint, the file `keep`, after each section, a fixed number of time steps.
"""

from pathlib import Path

import numpy as np
import pytest

import rig
from rig.core.base.errors import RunError
from rig.core.simulation.run_output import simulate_to_file
from rig.core.simulation.simulate import Run
from rig.extras.grains import grains_run
from rig.extras.grains.coupling import CoupledPropagator
from tests.rig.grains.scenes import momentum_errors, with_grains

RATE_HZ, DURATION_S = 2000.0, 0.03
SIDE = 2  # index of the side wall in `Bed.forces`
SWEEP = {"kind": "swept_sine", "from": "20 Hz", "to": "60 Hz", "duration": "0.03 s", "force": "0.4 N"}


@pytest.fixture(autouse=True)
def short_sections(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the sections of a run, so that every run has several."""
    monkeypatch.setattr(grains_run, "STEPS_PER_SECTION", 400)


def scene_with_two_dampers(**changes: object) -> rig.Scene:
    """Return two bodies, one with a bed of grains and one with a mass."""
    chain = {"masses": [0.01, 0.02], "springs": [400.0, 500.0], "damping": {"modal": 0.01}}
    scene = with_grains(structure=chain, **changes)
    mass_damper = {"body": 2, "mass": 2e-3, "clearance": 5e-4}
    return scene.replace(dampers=[mass_damper, *scene.dampers])


def assert_identical(run: Run, reference: Run) -> None:
    for name in ("time", "displacement", "velocity", "acceleration", "gap", "contact", "events"):
        assert np.array_equal(getattr(run, name), getattr(reference, name)), name
    assert run.energy == reference.energy
    assert run.ambiguous == reference.ambiguous


class InterruptAfter:
    """Progress function that interrupts a run after a number of sections, as Ctrl-C does."""

    def __init__(self, sections: int) -> None:
        self.sections_left = sections

    def __call__(self, n_completed: int, total: int) -> None:
        self.sections_left -= 1
        if not self.sections_left and n_completed < total:
            raise KeyboardInterrupt


@pytest.mark.parametrize("test", [{}, {"test": SWEEP}], ids=["tone", "sweep"])
def test_resumed_run_is_identical(tmp_path: Path, test: dict[str, object]) -> None:
    scene, stored = scene_with_two_dampers(**test), tmp_path / "kept"
    uninterrupted = rig.simulate(scene, DURATION_S, RATE_HZ)
    for sections in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            rig.simulate(scene, DURATION_S, RATE_HZ, keep=stored, progress=InterruptAfter(sections))

    resumed = rig.simulate(scene, DURATION_S, RATE_HZ, keep=stored)

    assert len(uninterrupted.events) > 1
    assert_identical(resumed, uninterrupted)
    assert_identical(rig.simulate(scene, DURATION_S, RATE_HZ, keep=stored), uninterrupted)


def test_sections_conserve_momentum_and_energy() -> None:
    scene = scene_with_two_dampers()
    coupled = CoupledPropagator(scene, 1.0 / RATE_HZ)
    drive = np.zeros((1, coupled.substeps * 20 + 1))
    drive[0] = 0.4 * np.sin(2 * np.pi * 30.0 * coupled.step * np.arange(drive.shape[1]))
    coupled.set_state(coupled.system.initial, drive[:, 0])
    contact_impulse = 0.0
    errors = np.zeros(len(coupled.beds))

    # Reading the state for a checkpoint between the sections does not change the motion.
    for start in range(0, drive.shape[1] - 1, coupled.substeps):
        coupled.state()
        momentum = coupled.momentum
        _, beds = coupled.propagate_steps(drive[:, start : start + coupled.substeps + 1])
        contact_impulse += float(np.abs(beds.force).sum()) * coupled.step
        errors += momentum_errors(coupled, momentum, beds)

    assert np.abs(errors).max() < 1e-12 * contact_impulse
    energy = rig.simulate(scene, DURATION_S, RATE_HZ).energy
    assert energy.grains > 0.01 * energy.work
    assert abs(energy.residual) < 1e-10 * energy.work


def test_resumed_bed_has_its_friction_forces() -> None:
    scene = with_grains(mass="2 g", grains={"friction": 0.5})
    coupled = CoupledPropagator(scene, 1.0 / RATE_HZ)
    (bed,) = coupled.beds
    # An additional 0.3 g and a viscous drag move the grains slowly, so that friction at the side wall builds up.
    bed.add_drag(1e-3)
    for _ in range(2000):
        bed.add_velocity(-0.15 * 9.80665 * bed.step)
        bed.advance()
        bed.add_velocity(-0.15 * 9.80665 * bed.step)
    before = bed.forces()

    bed.resume(bed.state_bytes())

    assert abs(before[SIDE]) > 0.02 * bed.mass * 9.80665, "no friction at the side"
    assert bed.forces() == pytest.approx(before, rel=1e-6)


def test_interrupted_output_continues(tmp_path: Path) -> None:
    scene = with_grains()
    simulate_to_file(tmp_path / "whole.npz", scene, DURATION_S, RATE_HZ, None, InterruptAfter(0))
    with pytest.raises(KeyboardInterrupt) as stopped:
        simulate_to_file(tmp_path / "run.npz", scene, DURATION_S, RATE_HZ, None, InterruptAfter(2))
    assert "run.npz.kept contains the part computed so far" in stopped.value.__notes__[0]
    assert [file.name for file in tmp_path.glob("run*")] == ["run.npz.kept"]
    reported: list[int] = []

    simulate_to_file(
        tmp_path / "run.npz", scene, DURATION_S, RATE_HZ, None, lambda n_completed, total: reported.append(n_completed)
    )

    # A run from the start would report its first section, which ends earlier.
    assert min(reported) > 30, "completed steps were repeated"
    assert [file.name for file in tmp_path.glob("run*")] == ["run.npz"]
    assert (tmp_path / "run.npz").read_bytes() == (tmp_path / "whole.npz").read_bytes()


def test_checkpoint_of_other_run_names_the_difference(tmp_path: Path) -> None:
    stored = tmp_path / "kept"
    rig.simulate(with_grains(), 0.01, RATE_HZ, keep=stored)

    for scene, duration, frequency, difference in (
        (with_grains(mass="0.4 g"), 0.01, None, "scene"),
        (with_grains(seed=2), 0.01, None, "scene"),
        (with_grains(), 0.02, None, "duration"),
        (with_grains(), 0.01, 31.0, "drive"),
    ):
        with pytest.raises(RunError, match=f"kept contains .* a different {difference}"):
            rig.simulate(scene, duration, RATE_HZ, frequency=frequency, keep=stored)


@pytest.mark.parametrize("damage", [lambda content: content[:-200], lambda _: b"", lambda _: b"x" * 300])
def test_damaged_checkpoint_is_reported_and_kept(tmp_path: Path, damage: object) -> None:
    stored = tmp_path / "kept"
    rig.simulate(with_grains(), 0.005, RATE_HZ, keep=stored)
    stored.write_bytes(damage(stored.read_bytes()))  # type: ignore[operator]
    damaged = stored.read_bytes()

    with pytest.raises(RunError, match="Delete the file to start again"):
        rig.simulate(with_grains(), 0.005, RATE_HZ, keep=stored)

    assert stored.read_bytes() == damaged
