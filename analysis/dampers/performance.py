"""Energy that dampers take out of a period of a steady tone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.responses.measurands import motion_of, reference_of, responses
from rig.errors import RecordingError

if TYPE_CHECKING:
    from analysis.responses.stepped_sine import Sweep
    from daq.recording.recording import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CycleEnergy:
    """Energy balance of one period of a steady tone."""

    frequency: Array  # Hz; shape (n,)
    supplied: Array
    """Work of the force on the structure, J; shape (n,)."""
    structure: Array
    """Dissipated in the structure's own damping, J; shape (n,)."""

    @property
    def dampers(self) -> Array:
        """What is left: lost in the dampers' impacts, J."""
        return self.supplied - self.structure


def energy_per_cycle(rec: Recording, sweep: Sweep) -> CycleEnergy:
    """Energy that force, structure and dampers exchange in a period, from the channels.

    Force and motion of the driven body, harmonics included, give the work; the motion of all bodies and the
    structure's damping matrix, known from the scene, give what the structure dissipates.

    Parameters
    ----------
    rec : daq.recording.Recording
        A stepped sine with a channel on every body.
    sweep : Sweep
        One of `analysis.responses.stepped_sine.sweeps`.
    """
    from rig.system.structure import structure_matrices

    names = sweep.lines.channels
    _, damping, _ = structure_matrices(rec.scene.structure)
    bodies = {rec.channels[name].at: name for name in responses(rec)}
    count = len(damping)
    missing = [body for body in range(1, count + 1) if f"body {body}" not in bodies]
    if missing:
        raise RecordingError(
            f"no channel on body {', '.join(map(str, missing))}: the energy balance needs all {count} bodies"
        )
    shaker = rec.scene.driven_shaker
    driven = shaker.body if shaker is not None and isinstance(shaker.body, int) else 1
    supplied, structure = [], []
    for tone in sweep.tones:
        orders = np.arange(1, tone.amplitude.shape[1] + 1)
        frequency = orders * tone.frequency
        force = np.sum(reference_of(rec, "force").row(rec, names, frequency) * tone.amplitude, axis=0)
        motion = np.array(
            [
                np.sum(
                    motion_of(rec, bodies[f"body {body}"]).row(rec, names, frequency) * tone.amplitude, axis=0
                )
                for body in range(1, count + 1)
            ]
        )
        supplied.append(np.pi * np.sum(orders * np.imag(force * motion[driven - 1].conj())))
        power = np.einsum("ik,ij,jk->k", motion.conj(), damping, motion).real
        structure.append(np.pi * 2 * np.pi * tone.frequency * np.sum(orders**2 * power))
    return CycleEnergy(sweep.lines.frequency, np.array(supplied), np.array(structure))


def impact_energy_per_cycle(rec: Recording, sweep: Sweep) -> Array:
    """Energy truly lost in impacts in a period of each tone, J, where the truth was recorded.

    Each impact takes (1 - e²) of half the reduced mass of damper and body times the closing speed squared; a landing
    that lasts is taken for one that nothing else disturbs.
    """
    from rig.system.assembly import assemble
    from rig.system.structure import damper_masses, structure_matrices

    mass, _, _ = structure_matrices(rec.scene.structure)
    bodies = np.array([damper.body - 1 for damper in rec.scene.dampers])
    rebound = np.array([damper.restitution for damper in rec.scene.dampers])
    system = assemble(rec.scene)
    for j in np.flatnonzero(system.lasting):
        rebound[system.damper_number[j] - 1] = system.landing(int(j), 1)[1]
    damper, body = np.asarray(damper_masses(rec.scene)), np.diag(mass)[bodies]
    factor = 0.5 * damper * body / (damper + body) * (1.0 - rebound**2)
    events = rec.events
    events = events[np.isin(events["kind"], ("floor", "ceiling", "touch"))]
    loss = factor[events["damper"] - 1] * events["speed"] ** 2
    out = []
    for frequency, (first, stop) in zip(sweep.lines.frequency, sweep.windows, strict=True):
        inside = (events["time"] >= first / rec.rate) & (events["time"] < stop / rec.rate)
        out.append(loss[inside].sum() / ((stop - first) / rec.rate * frequency))
    return np.array(out)
