"""Dampers in stepped-sine tests: type of motion and dissipated energy at each frequency."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.core.damper_motion.energy_balance import EnergyBalance, energy_per_period
from analysis.core.damper_motion.impact_energy import impact_energy_per_period
from analysis.core.damper_motion.motion_types import DamperMotion, damper_motion, motion_table
from analysis.core.recordings.names import relabel
from analysis.core.responses.measurands import motion_channel_at
from analysis.core.responses.stepped_sine import Sweep, sweeps
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.base.figure_types import Axes
from rig.core.base.progress import CountProgress
from rig.core.results import Result, complete_style, format_percent
from rig.core.results.table import Table
from rig.core.scene.damper import Damper

#: Sentence on the impacts of a mass that does not fall freely: without walls, and with walls.
_IMPACT_TEXTS = (
    "{} has no impacts.",
    "channels cannot show the impacts of {} in this body, because the mass does not fall freely.",
)


@dataclass(frozen=True, repr=False)
class Dampers(Result):
    """Motion of the dampers and energy per period in one sweep.

    Attributes
    ----------
    label : str
        Scene name and, if there are several sweeps, level and direction.
    sweep : Sweep
        Fundamental and harmonic amplitudes of all channels.
    bodies : tuple of list of DamperMotion
        For each body with dampers that are not locked and with a channel, the motion at each frequency.
    energy : EnergyBalance or None
        Energy balance; None if a required channel is missing.
    true_impact_energy : ndarray, shape (n,), or None
        True energy loss in impacts per period [J] if the truth was recorded.
    missing : tuple of str
        What the results lack: bodies, joints and dampers that are not evaluated, with the reason.
    warnings : tuple of str
        Sentences on limits of the results.
    """

    label: str
    sweep: Sweep
    bodies: tuple[list[DamperMotion], ...]
    energy: EnergyBalance | None
    true_impact_energy: Array | None = None
    missing: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def columns(self) -> Mapping[str, NDArray[Any]]:
        """Return one row for each frequency and body, as in the table of `analysis dampers`."""
        frequency = self.sweep.lines.frequency
        unknown = np.full(frequency.size, np.nan)
        energies = [unknown] * 4
        if self.energy is not None:
            energies = [self.energy.supplied, self.energy.structure, self.energy.dampers, self.energy.expanded]
        energies.append(unknown if self.true_impact_energy is None else self.true_impact_energy)
        names = ("supplied_J", "structure_J", "dampers_J", "dampers_bound_J", "true_impacts_J")
        count, bodies = frequency.size, len(self.bodies)
        motions = [body[i] for i in range(count) for body in self.bodies]
        floor, ceiling = np.array([motion.impacts_per_period for motion in motions]).reshape(-1, 2).T
        if not self.bodies:
            return {"frequency_Hz": frequency} | dict(zip(names, energies, strict=True))
        return {
            "frequency_Hz": np.repeat(frequency, bodies),
            **{name: np.repeat(energy, bodies) for name, energy in zip(names, energies, strict=True)},
            "channel": np.array([motion.channel for motion in motions]),
            "motion": np.array([motion.name for motion in motions]),
            "floor_per_period": floor,
            "ceiling_per_period": ceiling,
        }

    def table(self) -> Table:
        """Return the motions in each body with their frequencies."""
        return motion_table(self.bodies, self.sweep.lines.omitted.tolist())

    def summary(self) -> str:
        """Return the frequency range, and the frequency at which the dampers dissipate most."""
        frequency = self.sweep.lines.frequency
        text = f"{self.label}: {frequency.size} frequencies, {frequency.min():.4g} to {frequency.max():.4g} Hz"
        if self.energy is None or not np.isfinite(self.energy.dampers).any():
            return text
        largest = int(np.nanargmax(self.energy.dampers))
        share = format_percent(self.energy.dampers[largest] / self.energy.supplied[largest])
        return f"{text}; the dampers dissipate most at {frequency[largest]:.4g} Hz ({share} of the energy supplied)"

    def draw(self, ax: Axes, **style: Any) -> None:
        """Draw supplied and dissipated energy per period against frequency."""
        if self.energy is not None:
            order = np.argsort(self.energy.frequency, kind="stable")
            for name, energy in (
                ("supplied", self.energy.supplied),
                ("dissipated by the dampers", self.energy.dampers),
                ("dissipated by the structure", self.energy.structure),
            ):
                values = 1e3 * np.where(energy > 0.0, energy, np.nan)[order]
                ax.semilogy(
                    self.energy.frequency[order], values, ".-", **complete_style(style, label=f"{self.label}: {name}")
                )
        ax.set(xlabel="frequency / Hz", ylabel="energy per period / mJ")


def _impact_text(damper: Damper) -> str:
    """Return a sentence that explains why no impacts of a mass on a spring or a sliding mass are reported."""
    name = "a mass on a spring" if damper.friction is None else "a sliding mass"
    return _IMPACT_TEXTS[damper.has_walls].format(name)


def dampers_in(rec: Recording, label: str | None = None, progress: CountProgress | None = None) -> list[Dampers]:
    """Estimate the motion of the dampers and the energy per period in each sweep of a recording.

    `rec`: recording of a sine or stepped-sine test; `label`: label instead of the scene name. Raises
    `RecordingError` if the recording contains no steady tone.
    """
    other = [damper for damper in rec.scene.dampers if not damper.falls_freely and damper.moves]
    unknown_impacts = {damper.body for damper in other if damper.has_walls}
    # The force of a joint changes as fast as the force of an impact, so impacts on its bodies cannot be detected.
    unknown_impacts |= {end + 1 for joint in rec.scene.joints for end in joint.ends if end is not None}
    beds = [damper for damper in rec.scene.dampers if not damper.locked and damper.falls_freely]
    bodies_with_dampers = sorted({damper.body for damper in beds} - unknown_impacts)
    results = []
    for sweep in sweeps(rec, progress=progress):
        bodies, warnings = [], list(sweep.lines.warnings)
        missing = [
            f"joint {number}, {joint.text(rec.scene.structure.label)}: its force is not measured, so the channels do "
            "not show when the joint acts. The force resembles damper impacts, so impacts on the bodies of the joint "
            "are not detected. The energy of the dampers includes the energy that the joint dissipates."
            for number, joint in enumerate(rec.scene.joints, 1)
        ]
        missing += [
            f"{rec.scene.structure.label(damper.body)}: {_impact_text(damper)} The energy of the dampers includes the "
            "energy that this mass dissipates."
            for damper in other
        ]
        for number in bodies_with_dampers:
            info = motion_channel_at(rec, f"body {number}")
            if info is None:
                name = rec.scene.structure.label(number)
                missing.append(
                    f"{name}: no channel measures its motion, so impacts are not detected. Mount a sensor on this body."
                )
                continue
            try:
                bodies.append(damper_motion(rec, sweep, info.name, progress))
            except RecordingError as error:
                missing.append(str(error))
        energy = None
        try:
            energy = energy_per_period(rec, sweep)
        except RecordingError as error:
            warnings.append(f"no energy balance: {error}")
        results.append(
            Dampers(
                relabel(sweep.lines, rec.scene.name, label or rec.scene.name).label,
                sweep,
                tuple(bodies),
                energy,
                impact_energy_per_period(rec, sweep) if rec.has_truth else None,
                tuple(missing),
                tuple(warnings),
            )
        )
    return results
