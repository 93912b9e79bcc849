"""What dampers are worth: peaks lowered, damping gained, mass added, energy taken out per cycle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.modal.identification import identify
from analysis.responses.frf import Frf
from analysis.responses.measurands import motion_of, reference_of, responses
from rig.errors import RecordingError

if TYPE_CHECKING:
    from analysis.responses.stepped_sine import Sweep
    from daq.recording.recording import Recording

Array = NDArray[np.float64]

# A damped peak is looked for within this part of the bare natural frequency below it, and half of it above.
_BELOW = 0.15


@dataclass(frozen=True)
class PeakChange:
    """What became of one resonance of one response."""

    response: str
    frequency: float
    damping: float
    """Natural frequency [Hz] and damping ratio without dampers."""
    bare: float
    damped: float
    """Largest receptance without and with dampers, m/N; the bare one between measured points, from its modal
    fit."""
    damped_frequency: float
    """Hz, where the damped one is largest."""

    @property
    def reduction(self) -> float:
        """Damped peak over bare peak."""
        return self.damped / self.bare

    @property
    def equivalent_damping(self) -> float:
        """Viscous damping ratio that would lower the bare peak as far."""
        return self.damping / self.reduction

    @property
    def added_mass(self) -> float:
        """Mass ratio that would shift the bare frequency as far (negative: shifted up)."""
        return (self.frequency / self.damped_frequency) ** 2 - 1.0


def peak_changes(bare: Sequence[Frf], damped: Sequence[Frf]) -> list[PeakChange]:
    """Compare every resonance of every response, without and with dampers.

    Parameters
    ----------
    bare, damped : sequence of Frf
        All responses of a recording without, and of one with dampers.

    Returns
    -------
    list of PeakChange
        By response, then by frequency.
    """
    modes = identify(bare)
    out = []
    for curve in damped:
        if curve.response not in modes.responses:
            continue
        row = modes.responses.index(curve.response)
        part = curve.to("displacement")
        for frequency, damping in zip(modes.frequency, modes.damping, strict=True):
            near = part.between(frequency * (1.0 - _BELOW), frequency * (1.0 + _BELOW / 2))
            if not near.frequency.size:
                continue
            top = int(np.argmax(abs(near.value)))
            at_peak = modes.receptance(np.array([frequency]))[row, 0]
            out.append(
                PeakChange(
                    curve.response,
                    float(frequency),
                    float(damping),
                    float(abs(at_peak)),
                    float(abs(near.value[top])),
                    float(near.frequency[top]),
                )
            )
    return out


def describe_changes(changes: Sequence[PeakChange]) -> list[str]:
    """One line for each resonance compared."""
    return [
        f"{one.response}, {one.frequency:.2f} Hz: peak {one.bare:.3g} -> {one.damped:.3g} m/N "
        f"({20 * np.log10(one.reduction):+.1f} dB), now at {one.damped_frequency:.2f} Hz; "
        f"as if damped by {100 * one.equivalent_damping:.2g} % of critical"
        for one in changes
    ]


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
