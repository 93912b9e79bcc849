"""Simulation of scenes with beds of grains: the entry point `shotrig.grains`."""

from functools import partial
from pathlib import Path

import numpy as np

from rig.core.base.arrays import Array
from rig.core.base.progress import CountProgress
from rig.core.engine.trajectory import event_type
from rig.core.scene.scene import Scene
from rig.core.simulation.energy import total_energy
from rig.core.simulation.simulate import Run
from rig.core.system.open_loop_drive import ToneDrive
from rig.extras.grains.checkpoint import read_checkpoint, write_checkpoint
from rig.extras.grains.coupling import CoupledPropagator
from rig.extras.grains.grains_run import GrainsRun
from rig.extras.grains.lammps_library import lammps_version
from rig.extras.grains.ranks import rank_count


def propagator(scene: Scene, interval: float) -> tuple[CoupledPropagator, int]:
    """Return the propagator of a scene, and its number of steps in a sample interval [s]."""
    coupled = CoupledPropagator(scene, interval)
    return coupled, coupled.substeps


def simulate(
    scene: Scene, drive: ToneDrive | Array, samples: int, rate: float, keep: Path | None, progress: CountProgress | None
) -> Run:
    """Simulate beds of grains, starting from the checkpoint if it exists.

    `drive`: a tone, or samples (inputs, samples); `samples`, `rate`: number and rate [Hz] of the stored samples;
    `keep`: file of the checkpoint, None: no checkpoint; `progress`: called after each section.
    """
    tone = (drive.frequency, drive.amplitudes.tolist()) if isinstance(drive, ToneDrive) else None
    settings = {
        "scene": scene.to_si_yaml(),
        "duration": samples,
        "rate": rate,
        "drive": tone or drive,
        "version of LAMMPS": lammps_version(),
        "number of ranks": rank_count(),
    }
    checkpoint = None if keep is None else read_checkpoint(keep, settings)
    run = GrainsRun(scene, samples, rate, drive)
    state = run.start() if checkpoint is None else run.resume(checkpoint)
    while state.samples < samples:
        state = run.advance(state)
        if keep is not None:
            write_checkpoint(keep, settings, state)
        if progress is not None:
            progress(state.samples, samples)
    displacement, velocity, acceleration, gap = run.motion(state)
    return Run(
        scene=scene,
        points=run.coupled.system.points,
        time=np.arange(samples) / rate,
        displacement=displacement,
        velocity=velocity,
        acceleration=acceleration,
        gap=gap,
        contact=state.contact,
        events=state.events.astype(
            np.dtype(event_type(run.coupled.system).descr, metadata={"ambiguous": state.ambiguous})
        ),
        ambiguous=state.ambiguous,
        _energy_balance=partial(total_energy, state.energy),
    )
