"""Recordings in, figures and tables out: what the commands `frf`, `decay` and `modes` do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from analysis.dampers.nonlinearity import jumps
from analysis.decays.free_decay import Decay, decay
from analysis.modal.identification import identify
from analysis.modal.modes import Modes, mac
from analysis.presentation.expectations import expect
from analysis.presentation.output_names import output_stem, with_ending
from analysis.recordings.names import opened, relabelled, scene_labels
from analysis.responses.frequency_responses import frequency_responses
from analysis.responses.frf import Frf

if TYPE_CHECKING:
    from analysis.decays.modal_decay import ModalDecay
    from daq.recording.recording import Recording

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Result:
    """What a command has to say."""

    files: tuple[Path, ...]
    lines: tuple[str, ...]  # Findings, one to a line
    warnings: tuple[str, ...]
    """Doubts, each with the recording it concerns."""


def present_frf(
    paths: Sequence[Path],
    output: Path | None = None,
    channels: Sequence[str] | None = None,
    reference: str = "force",
    motion: str = "displacement",
    estimator: str | None = None,
    block: float | None = None,
    theory: bool = False,
    progress: Progress | None = None,
) -> Result:
    """Draw and tabulate frequency responses; several recordings are overlaid, one figure per response."""
    from analysis.figures.frf_figure import frf_figure
    from analysis.presentation.tables import frf_table
    from rig.figure_style import save

    curves: list[Frf] = []
    exact: list[Frf] = []
    notes: list[str] = []
    for path, label in zip(paths, scene_labels(paths), strict=True):
        with opened(path) as rec:
            expect(rec, path, "frf")
            groups = frequency_responses(rec, channels, reference, motion, estimator, block, progress)
            curves += [relabelled(frf, rec.scene.name, label) for group in groups for frf in group]
            notes += _noted(path, [note for group in groups for note in group[0].warnings])
            if theory:
                exact += [linear_theory(rec, frf) for frf in groups[0]]
    stem = output_stem(paths, output, "frf")
    names = list(dict.fromkeys(frf.response for frf in curves))
    settings = list(dict.fromkeys(frf.label for frf in curves))
    what = f"{curves[0].name.capitalize()}"
    files: list[Path] = []
    if len(settings) == 1:
        shown = [replace(frf, label=frf.response) for frf in curves]
        files += save(frf_figure(shown, f"{what}: {settings[0]}", _once(exact), _marks(shown)), stem)
    else:
        for name in names:
            shown = [frf for frf in curves if frf.response == name]
            some = [frf for frf in exact if frf.response == name]
            part = stem if len(names) == 1 else stem.with_name(f"{stem.name}-{name}")
            files += save(frf_figure(shown, f"{what} of {name}", _once(some), _marks(shown)), part)
    files.append(frf_table(stem.with_name(stem.name + ".csv"), curves))
    return Result(tuple(files), tuple(frf.summary() for frf in curves), tuple(notes))


def linear_theory(rec: Recording, frf: Frf) -> Frf:
    """Exact linear curve of the scene's structure without dampers, for the same response and reference."""
    from rig.system.receptance import receptance

    low, high = float(frf.frequency.min()), float(frf.frequency.max())
    frequency = np.geomspace(low, high, 3000)
    rows = receptance(rec.scene, frequency, attached=frf.reference == "table")
    body = int(rec.channels[frf.response].at.split()[1])
    nothing = np.zeros(frequency.size)
    curve = Frf(
        frequency, rows[body - 1], nothing, nothing + 1.0, nothing, frf.response, frf.reference,
        label="linear theory, no dampers",
    )  # fmt: skip
    return curve.to(frf.motion)


def present_decay(
    paths: Sequence[Path], output: Path | None = None, channel: str | None = None, hit: int = 1
) -> Result:
    """Draw and tabulate free decays, several recordings overlaid."""
    from analysis.figures.decay_figure import decay_figure
    from analysis.presentation.tables import damping_table, envelope_table
    from rig.figure_style import save

    decays: list[Decay] = []
    notes: list[str] = []
    for path, label in zip(paths, scene_labels(paths), strict=True):
        with opened(path) as rec:
            expect(rec, path, "decay")
            decays.append(relabelled(decay(rec, channel, hit), rec.scene.name, label))
        notes += _noted(path, decays[-1].warnings)
    stem = output_stem(paths, output, "decay")
    first = decays[0]
    files = save(decay_figure(decays, f"Free decay of {first.channel} after hit {hit}"), stem)
    files.append(envelope_table(stem.with_name(stem.name + "-envelope.csv"), decays))
    files.append(damping_table(stem.with_name(stem.name + "-damping.csv"), decays))
    return Result(tuple(files), tuple(line for one in decays for line in describe_decay(one)), tuple(notes))


def describe_decay(one: Decay) -> list[str]:
    """Tell when a decay is over for the dampers, and what each mode's damping was."""
    quiet = one.quiet_from
    until = "never within the recording" if np.isnan(quiet) else f"after {quiet:.3g} s"
    out = [
        f"{one.label}, {one.channel}: below g {until}; energy falls by 6 dB every {one.halving:.3g} s at "
        "first"
    ]
    for mode in one.modes:
        if mode.damping.size:
            ends = ", ".join(_damping_at(mode, index) for index in (0, -1))
            out.append(f"  {mode.frequency:.2f} Hz: damping ratio {ends}; noise {mode.noise:.1g} m/s²")
        else:
            out.append(
                f"  {mode.frequency:.2f} Hz: too short, or too near its noise of {mode.noise:.1g} m/s², for a "
                "damping ratio"
            )
    return out


def _damping_at(mode: ModalDecay, index: int) -> str:
    """Tell the damping ratio at one amplitude, with its 95 % bound from noise."""
    ratio, bound = 100.0 * mode.damping[index], 200.0 * mode.damping_error[index]
    return f"{ratio:.3g} % ± {bound:.1g} % at {mode.amplitude[index]:.3g} m/s²"


def present_modes(
    paths: Sequence[Path],
    output: Path | None = None,
    reference: str = "force",
    count: int | None = None,
    block: float | None = None,
    progress: Progress | None = None,
) -> Result:
    """Identify modes, draw and tabulate them."""
    from analysis.figures.modes_figure import modes_figure
    from analysis.presentation.tables import modes_table
    from rig.figure_style import save

    found: list[Modes] = []
    files: list[Path] = []
    lines: list[str] = []
    notes: list[str] = []
    for path, label in zip(paths, scene_labels(paths), strict=True):
        with opened(path) as rec:
            expect(rec, path, "modes")
            first = output_stem([path], output, "modes")
            for number, group in enumerate(
                frequency_responses(rec, None, reference, block=block, progress=progress)
            ):
                modes = relabelled(identify(group, count), rec.scene.name, label)
                found.append(modes)
                stem = first if number == 0 else first.with_name(f"{first.name}-{number + 1}")
                files += save(modes_figure(group, modes, f"Modes: {modes.label}"), stem)
                lines += describe_modes(rec, modes, reference)
                notes += _noted(path, modes.warnings)
    files.append(modes_table(with_ending(output_stem(paths, output, "modes"), "csv"), found))
    return Result(tuple(files), tuple(lines), tuple(notes))


def describe_modes(rec: Recording, modes: Modes, reference: str) -> list[str]:
    """List frequency, damping and shape of each mode, and how near it comes to theory."""
    theory = theoretical_shapes(rec, modes) if reference == "force" else None
    out = [f"{modes.label}: {modes.frequency.size} modes"]
    for i, frequency in enumerate(modes.frequency):
        shape = ", ".join(f"{value:.3f}" for value in modes.shapes[:, i].real)
        line = (
            f"  {frequency:.4f} Hz ({2 * np.pi * frequency:.3f} rad/s), damping ratio "
            f"{100 * modes.damping[i]:.4f} % "
            f"± {200 * modes.damping_error[i]:.2g} %, shape ({shape})"
        )
        if theory is not None:
            line += f", MAC with theory {float(np.max(mac(modes.shapes[:, [i]], theory))):.4f}"
        out.append(line)
    return out


def theoretical_shapes(rec: Recording, modes: Modes) -> np.ndarray | None:
    """Shapes of the scene's structure at the measured points, shape (responses, bodies)."""
    from rig.system.structure import natural_modes, structure_matrices

    mass, _, stiffness = structure_matrices(rec.scene.structure)
    _, shapes = natural_modes(mass, stiffness)
    bodies = [int(rec.channels[name].at.split()[1]) - 1 for name in modes.responses]
    return np.asarray(shapes)[bodies] if len(bodies) > 1 else None


def _marks(curves: Sequence[Frf]) -> list[tuple[float, str]]:
    """Jumps of all curves, each place once."""
    found = {(round(frequency, 6), text) for curve in curves for frequency, text in jumps(curve)}
    return sorted(found)


def _once(curves: Sequence[Frf]) -> list[Frf]:
    """Keep one legend entry for theory and one curve per response."""
    out: list[Frf] = []
    for curve in curves:
        if all(curve.response != other.response for other in out):
            out.append(replace(curve, label=curve.label if not out else ""))
    return out


def _noted(path: Path, notes: Sequence[str]) -> list[str]:
    return [f"{path.name}: {note}" for note in notes]
