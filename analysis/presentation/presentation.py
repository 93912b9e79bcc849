"""Recordings in, figures and tables out: what the commands `frf`, `decay` and `modes` do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.decays.free_decay import FIRST_FALL, Decay, decay
from analysis.modal.identification import identify
from analysis.modal.modes import Modes, mac
from analysis.presentation.expectations import expect, expect_all, repeats
from analysis.presentation.output_names import check_outputs, of_part, output_stem, with_ending
from analysis.recordings.names import opened, relabelled, scene_labels
from analysis.responses.branch_jumps import jumps
from analysis.responses.frequency_responses import Blocks, frequency_responses, kind_of
from analysis.responses.frf import SENSITIVITY, Frf
from analysis.responses.frf_files import is_frf_file, read_frfs
from analysis.responses.systematic import tolerance
from rig.errors import RecordingError
from rig.results import bounded, rounded
from rig.scene.presets import origin

if TYPE_CHECKING:
    from analysis.decays.modal_decay import ModalDecay
    from daq.recording.recording import Recording

#: From this modal assurance criterion on two shapes are usually taken for the same.
SAME_SHAPE = 0.9

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
    overlap: float | None = None,
    window: str | None = None,
    unit: str | None = None,
) -> Result:
    """Draw and tabulate frequency responses; several files are overlaid, one figure per response."""
    from analysis.presentation.tables import frf_table

    curves: list[Frf] = []
    exact: list[Frf] = []
    blocks = Blocks(estimator, block, overlap, window)
    notes = expect_all(paths, "frf", blocks, theory, unit)
    check_outputs(paths, output, "frf", "csv")
    doubts: list[str] = []
    for path, label in zip(paths, _labels(paths), strict=True):
        if is_frf_file(path):
            read = _read(path, reference, channels, unit)
            curves += [replace(frf.to(motion), label=label) for frf in read]
            notes += noted(path, read[0].warnings)
            continue
        with opened(path) as rec:
            acting = vars(blocks.acting_on(kind_of(rec)))
            groups = frequency_responses(rec, channels, reference, motion, progress=progress, **acting)
            curves += [relabelled(frf, rec.scene.name, label) for group in groups for frf in group]
            notes += noted(path, [note for group in groups for note in group[0].warnings])
            doubts += stated_tolerances(rec, [frf for group in groups for frf in group])
            if theory:
                exact += [linear_theory(rec, frf) for frf in groups[0]]
    with output_stem(paths, output, "frf", "csv") as stem:
        files = _drawn(curves, exact, stem)
        files.append(frf_table(with_ending(stem, "csv"), curves))
    return Result(tuple(files), (*(frf.summary() for frf in curves), *dict.fromkeys(doubts)), tuple(notes))


def _drawn(curves: Sequence[Frf], exact: Sequence[Frf], stem: Path) -> list[Path]:
    """Draw curves: those of one recording together, those of several by their outputs and inputs."""
    from analysis.figures.frf_figure import frf_figure
    from rig.figure_style import save

    settings = list(dict.fromkeys(frf.label for frf in curves))
    what = f"{curves[0].name.capitalize()}"
    groups = _by_ratio(curves)
    if len(settings) == 1:
        shown = [replace(frf, label=frf.ratio) for frf in curves]
        return save(frf_figure(shown, f"{what}: {settings[0]}", _once(exact), _marks(shown)), stem)
    inputs = {shown[0].input for shown in groups}
    files = []
    for shown in groups:
        first = shown[0]
        some = [frf for frf in exact if (frf.response, frf.input) == (first.response, first.input)]
        name = first.response if len(inputs) == 1 else first.ratio.replace(" / ", "-by-").replace(" ", "-")
        part = stem if len(groups) == 1 else of_part(stem, name)
        files += save(frf_figure(shown, f"{what}, {first.ratio}", _once(some), _marks(shown)), part)
    return files


def _by_ratio(curves: Sequence[Frf]) -> list[list[Frf]]:
    """Group curves by output and input; curves of files that name no input go with the first that has one."""
    groups: dict[tuple[str, str], list[Frf]] = {}
    for curve in sorted(curves, key=lambda one: not one.input_at):
        known = next((key for key in groups if key[0] == curve.response and not curve.input_at), None)
        groups.setdefault(known or (curve.response, curve.input), []).append(curve)
    return list(groups.values())


def stated_tolerances(rec: Recording, frfs: Sequence[Frf]) -> list[str]:
    """Say which sensors' tolerances make most of the bounds of curves, if they do, and where these figures are from."""
    largest = [part for frf in frfs for part in frf.parts()]
    if 2 * largest.count(SENSITIVITY) < len(largest):
        return []
    groups: dict[str, list[str]] = {}
    settings = {each.name: each.accelerometer or each.hammer for each in rec.scene.channels or ()}
    for name, info in rec.channels.items():
        if tolerance(info):
            source = origin(settings.get(name), "sensitivity_tolerance")
            groups.setdefault(f"{100 * tolerance(info):.2g} %{source}", []).append(name)
    stated = "; ".join(f"{', '.join(names)} {text}" for text, names in groups.items())
    return [
        f"{rec.scene.name}: most of these bounds is the tolerance of the sensors ({stated}); "
        "if they are calibrated, give it in the scene: sensitivity_tolerance: 1 %"
    ]


def linear_theory(rec: Recording, frf: Frf) -> Frf:
    """Exact linear curve of the scene's structure without dampers, for the same response and reference."""
    from rig.system.structural_model import receptance

    low, high = float(frf.frequency.min()), float(frf.frequency.max())
    frequency = np.geomspace(low, high, 3000)
    rows = receptance(rec.scene, frequency, attached=frf.reference == "table")
    body = int(rec.channels[frf.response].at.split()[1])
    nothing = np.zeros(frequency.size)
    curve = Frf(
        frequency, rows[body - 1], nothing, nothing + 1.0, nothing, frf.response, frf.reference,
        label="linear theory, no dampers",
    )  # fmt: skip
    return replace(curve.to(frf.motion), output_at=frf.output_at, input_at=frf.input_at)


def present_decay(
    paths: Sequence[Path], output: Path | None = None, channel: str | None = None, hit: int = 1
) -> Result:
    """Draw and tabulate free decays, several recordings overlaid."""
    from analysis.figures.decay_figure import decay_figure
    from analysis.presentation.tables import damping_table, envelope_table
    from rig.figure_style import save

    decays: list[Decay] = []
    notes = repeats(paths)
    check_outputs(paths, output, "decay", "png", "svg")
    for path, label in zip(paths, scene_labels(paths), strict=True):
        with opened(path) as rec:
            expect(rec, path, "decay")
            decays.append(relabelled(decay(rec, channel, hit), rec.scene.name, label))
            struck = getattr(rec.scene.test, "kind", "") != "free"
        notes += noted(path, decays[-1].warnings)
    first = decays[0]
    title = f"Free decay of {first.channel}{f' after hit {hit}' if struck else ''}"
    with output_stem(paths, output, "decay", "png", "svg") as stem:
        files = save(decay_figure(decays, title), stem)
        files.append(envelope_table(stem.with_name(stem.name + "-envelope.csv"), decays))
        files.append(damping_table(stem.with_name(stem.name + "-damping.csv"), decays))
    return Result(tuple(files), tuple(line for one in decays for line in describe_decay(one)), tuple(notes))


def describe_decay(one: Decay) -> list[str]:
    """Describe when dampers come to rest in a decay, and the damping of each mode."""
    quiet = one.quiet_from
    until = "not within the recording" if np.isnan(quiet) else f"after {quiet:.3g} s"
    falls = (
        f"does not fall by {-FIRST_FALL[1]:.0f} dB within the recording"
        if np.isnan(one.halving)
        else f"falls by 6 dB in {one.halving:.3g} s (slope from -1 to -11 dB)"
    )
    out = [f"{one.label}, {one.channel}: below 1 g {until}; backward-integrated energy {falls}"]
    for mode in one.modes:
        if mode.damping.size:
            ends = ", ".join(_damping_at(mode, index) for index in (0, -1))
            out.append(f"  {mode.frequency_text()}: damping ratio {ends}; noise {mode.noise:.1g} m/s²")
        else:
            out.append(
                f"  {mode.frequency_text()}: too short, or too near its noise of {mode.noise:.1g} m/s², for a "
                "damping ratio"
            )
    return out


def _damping_at(mode: ModalDecay, index: int) -> str:
    """Write the damping ratio at one amplitude with its 95 % bound from noise."""
    ratio, bound = 100.0 * mode.damping[index], 200.0 * mode.damping_error[index]
    return f"{bounded(ratio, bound, '%')} at {mode.amplitude[index]:.3g} m/s²"


def present_modes(
    paths: Sequence[Path],
    output: Path | None = None,
    reference: str = "force",
    count: int | None = None,
    block: float | None = None,
    progress: Progress | None = None,
    unit: str | None = None,
) -> Result:
    """Identify modes, draw and tabulate them; of recordings, or of responses that other programs have estimated."""
    from analysis.figures.modes_figure import modes_figure
    from analysis.presentation.tables import modes_table
    from rig.figure_style import save

    found: list[Modes] = []
    files: list[Path] = []
    lines: list[str] = []
    notes = expect_all(paths, "modes", Blocks(block=block), unit=unit)
    check_outputs(paths, output, "modes", "csv")
    for path, label in zip(paths, _labels(paths), strict=True):
        if is_frf_file(path):
            curves = _read(path, reference, None, unit)
            modes = replace(identify(curves, count), label=label)
            found.append(modes)
            with output_stem([path], output, "modes", "png", "svg") as stem:
                files += save(modes_figure(curves, modes, f"Modes: {modes.label}"), stem)
            lines += describe_modes(modes)
            notes += noted(path, modes.warnings)
            continue
        with opened(path) as rec:
            acting = vars(Blocks(block=block).acting_on(kind_of(rec)))
            groups = frequency_responses(rec, None, reference, progress=progress, **acting)
            for number, group in enumerate(groups):
                modes = relabelled(identify(group, count), rec.scene.name, label)
                found.append(modes)
                with output_stem([path], output, "modes", "png", "svg") as first:
                    stem = first if number == 0 else first.with_name(f"{first.name}-{number + 1}")
                    files += save(modes_figure(group, modes, f"Modes: {modes.label}"), stem)
                theory = theoretical_shapes(rec, modes) if reference == "force" else None
                lines += describe_modes(modes, theory)
                notes += noted(path, [*modes.warnings, *unlike_theory(modes, theory)])
    with output_stem(paths, output, "modes", "csv") as stem:
        files.append(modes_table(with_ending(stem, "csv"), found))
    return Result(tuple(files), tuple(lines), tuple(notes))


def _labels(paths: Sequence[Path]) -> list[str]:
    """Name recordings after their scenes, and other programs' files after themselves."""
    recordings = [path for path in paths if not is_frf_file(path)]
    named = dict(zip(recordings, scene_labels(recordings), strict=True))
    return [named.get(path, path.stem) for path in paths]


def _read(path: Path, reference: str, channels: Sequence[str] | None, unit: str | None) -> list[Frf]:
    """Read the curves of another program; `reference` is then the force's node and direction."""
    curves = read_frfs(path, None if reference == "force" else reference, unit)
    missing = [name for name in channels or () if name not in {curve.response for curve in curves}]
    if missing:
        has = ", ".join(curve.response for curve in curves)
        raise RecordingError(f"{path} has no response {', '.join(missing)}; it has {has[:300]}")
    return [curve for curve in curves if not channels or curve.response in channels]


def describe_modes(modes: Modes, theory: np.ndarray | None = None) -> list[str]:
    """List frequency, damping and shape of each mode, and how near it comes to the shapes of theory."""
    out = [
        f"{modes.label}{f', {modes.input}' * bool(modes.input)}: "
        f"{modes.frequency.size} mode{'s' * (modes.frequency.size != 1)}"
    ]
    bodies = modes.of_bodies()
    for i, frequency in enumerate(modes.frequency):
        known = zip(bodies.names, bodies.shapes[:, i].real, 2.0 * bodies.errors[:, i], strict=True)
        shape = ", ".join(f"{name} {_element(value, bound)}" for name, value, bound in known)
        line = (
            f"  {bounded(frequency, 2 * modes.frequency_error[i], 'Hz')}, damping ratio "
            f"{modes.damping_text(i)}, shape ({shape})"
        )
        if theory is not None:
            line += f", MAC with theory {nearest_mac(modes, theory)[i]:.4f}"
        out.append(line)
    return out


def nearest_mac(modes: Modes, theory: np.ndarray) -> NDArray[np.float64]:
    """Give the MAC of each mode's shape with the shape of theory that is most like it, shape (modes,)."""
    return np.asarray(mac(modes.shapes, theory).max(axis=1))


def unlike_theory(modes: Modes, theory: np.ndarray | None) -> list[str]:
    """Doubt that channels and scene are those of the recording where shapes are known, and none of the scene's."""
    if theory is None:
        return []
    nearest = nearest_mac(modes, theory)
    # By so much at most what a shape may be off by lowers its MAC.
    uncertain = np.sum((2.0 * modes.shape_error) ** 2, axis=0) / np.sum(abs(modes.shapes) ** 2, axis=0)
    off = nearest + uncertain < SAME_SHAPE
    if not off.any():
        return []
    pairs = zip(modes.frequency[off], nearest[off], strict=True)
    which = ", ".join(f"{f:.4g} Hz (MAC {m:.2f})" for f, m in pairs)
    return [
        f"{which}: like no shape of the scene's structure, which takes a MAC above {SAME_SHAPE:g}: look whether "
        "channels are swapped, or one has the wrong sign or place, whether the scene is that of this structure "
        "(analysis fit finds its values), and where dampers fly, at a lower level."
    ]


def _element(value: float, bound: float) -> str:
    """Write an element of a shape with its bound, the largest one, by which all are scaled, without."""
    if not bound:
        return f"{value:.3g}"
    return (
        f"{rounded(value, bound)} ± {rounded(bound, bound)}"
        if np.isfinite(bound)
        else f"{value:.3f} (no bound)"
    )


def theoretical_shapes(rec: Recording, modes: Modes) -> np.ndarray | None:
    """Shapes of the scene's structure at the measured points, shape (responses, bodies)."""
    from rig.system.structural_model import structural_model

    shapes = structural_model(rec.scene).modes.shapes
    bodies = [int(rec.channels[name].at.split()[1]) - 1 for name in modes.responses]
    return np.asarray(shapes)[bodies] if len(bodies) > 1 else None


def _marks(curves: Sequence[Frf]) -> list[tuple[float, str]]:
    """Jumps of all curves, each place once."""
    found = {(round(frequency, 6), text) for curve in curves for frequency, text in jumps(curve)}
    return sorted(found)


def _once(curves: Sequence[Frf]) -> list[Frf]:
    """Keep one legend entry for theory and one curve for each output and input."""
    out: list[Frf] = []
    for curve in curves:
        if all(curve.ratio != other.ratio for other in out):
            out.append(replace(curve, label=curve.label if not out else ""))
    return out


def noted(path: Path, notes: Sequence[str]) -> list[str]:
    """Put the recording's name before each of its doubts."""
    return [f"{path.name}: {note}" for note in notes]
