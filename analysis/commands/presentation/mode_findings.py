"""Output of `analysis modes`: modal parameters as text, figures and tables."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.commands.presentation.frf_findings import missing_tolerances
from analysis.commands.presentation.inputs import check_inputs, labels, read_curves
from analysis.commands.presentation.outputs import (
    CommandOutput,
    output_stem,
    separate_stems,
    with_ending,
    with_recording_name,
    with_sweep_name,
)
from analysis.commands.presentation.theory import TheoreticalModes
from analysis.core.modal.identification import identify
from analysis.core.modal.mode_warnings import extrapolates_damping
from analysis.core.modal.modes import Modes, mac
from analysis.core.modal.roving_hammer import exchange_points
from analysis.core.recordings.descriptions import full_test_text, validity_texts
from analysis.core.recordings.names import relabel
from analysis.core.recordings.opening import OpenRecordings, with_recordings
from analysis.core.responses.estimator import Blocks
from analysis.core.responses.frequency_responses import frequency_responses
from analysis.core.responses.measurands import default_reference
from analysis.extras.formats.frf_files import is_frf_file
from daq.core.recording.recording import Recording
from rig.core.base.output_files import prepare_outputs
from rig.core.base.progress import CountProgress
from rig.core.results.response import Response
from rig.core.results.uncertainty import expand

#: Two mode shapes with at least this modal assurance criterion (MAC) are usually considered the same.
MIN_SAME_SHAPE_MAC = 0.9
# An identified mode is compared with the nearest model mode, and with all model modes within this frequency ratio: with
# the nearest one alone, two close modes could be interchanged, because their spacing may be smaller than the error of
# the model frequencies. Distant modes are omitted, because a channel of wrong sign can resemble their shapes.
_MAX_FREQUENCY_RATIO = 1.25
# The scene does not describe the structure if all frequencies differ by more than this factor: a stiffness by four.
_MAX_THEORY_RATIO = 2.0
# Largest order (sum of the factors) of a combination; with higher orders, nearly any frequency is a combination.
_MAX_COMBINATION_ORDER = 5
# Largest relative error of a combination: natural frequencies depend on amplitude if dampers move.
_MAX_COMBINATION_ERROR = 0.015


class _Sweep(NamedTuple):
    """Curves from which modes are identified, and their recording."""

    curves: Sequence[Response]
    recording: Recording | None = None


@with_recordings
def present_modes(
    recordings: OpenRecordings,
    paths: Sequence[Path],
    output: Path | None = None,
    reference: str | None = None,
    count: int | None = None,
    block: float | None = None,
    progress: CountProgress | None = None,
    unit: str | None = None,
    *,
    exponential_window: float | None = None,
    roving: bool = False,
    response: Sequence[str] | None = None,
) -> CommandOutput:
    """Identify, draw and tabulate the modes of recordings or of FRF files of other programs.

    `output`: folder or stem of the files; `reference`: force or table; `count`: number of modes, by default estimated;
    `block`: length of a block [s]; `unit`: unit of FRFs whose file states none; `exponential_window`: time constant [s]
    whose damping is subtracted; `roving`: the files are impacts at different points with the same sensors; `response`:
    channels, by default all on bodies.
    """
    from analysis.commands.figures.modes_figure import modes_figure
    from analysis.commands.presentation.tables import modes_table
    from rig.core.base.figure_style import save_figure

    all_modes: list[Modes] = []
    files: list[Path] = []
    lines: list[str] = []
    warnings = check_inputs(recordings, paths, "modes", Blocks(block=block), unit=unit)
    common = output_stem(paths, output, "modes")
    stems, table = [common] if roving else separate_stems(paths, output, "modes"), with_ending(common, "csv")
    figures = [with_ending(stem, extension) for stem in stems for extension in ("png", "svg")]
    prepare_outputs(*dict.fromkeys([*figures, table]))
    names = labels(recordings, paths)
    tests: Iterator[list[_Sweep]] = (
        _sweeps(recordings, path, name, response, reference, block, progress, unit)
        for path, name in zip(paths, names, strict=True)
    )
    if roving:
        exchanged = exchange_points([curve for test in tests for sweep in test for curve in sweep.curves])
        tests, names = iter([[_Sweep(exchanged)]]), [exchanged.label]
    for path, first, label, test in zip(paths, stems, names, tests, strict=False):
        for number, (frfs, rec) in enumerate(test, 1):
            modes = identify(frfs, count)
            if exponential_window is not None:
                modes = modes.without_exponential_window(exponential_window)
            theory = None
            if rec is not None and reference in (None, default_reference(rec)):
                from analysis.commands.presentation.theory import theoretical_modes

                theory = theoretical_modes(rec, modes)
            all_modes.append(modes)
            stem = first if number == 1 else first.with_name(f"{first.name}-{number}")
            details = "; ".join(filter(None, ["" if rec is None else full_test_text(rec), modes.input]))
            title = f"Modes: {modes.label} ({details})" if details else f"Modes: {modes.label}"
            remarks = [] if rec is None else [f"{text[0].upper()}{text[1:]}." for text in validity_texts(rec)]
            files += save_figure(modes_figure(frfs, modes, title, remarks), stem)
            unlike = theory is not None and not _has_near_frequency(modes, theory)
            theory = None if unlike else theory
            lines += [*describe_modes(modes, theory, frfs), *(f"  {text}" for text in missing_tolerances(frfs))]
            if unlike:
                lines.append("  shapes are not compared with the scene, which has no natural frequency near a mode")
            notes = [*modes.warnings, *theory_warnings(modes, theory)]
            warnings += with_recording_name(path, with_sweep_name(modes.label, label, notes, frfs[0].warnings))
    files.append(modes_table(table, all_modes))
    return CommandOutput(tuple(files), tuple(lines), tuple(warnings))


def _sweeps(
    recordings: OpenRecordings,
    path: Path,
    label: str,
    response: Sequence[str] | None,
    reference: str | None,
    block: float | None,
    progress: CountProgress | None,
    unit: str | None,
) -> list[_Sweep]:
    """Return the curves of each sweep of a recording, or the curves in a file of another program."""
    if is_frf_file(path):
        return [_Sweep([replace(curve, label=label) for curve in read_curves(path, reference, response, unit)])]
    rec = recordings.of(path)
    options = vars(Blocks(block=block).for_kind(rec.test.kind))
    responses = frequency_responses(rec, response, reference, progress=progress, **options)
    return [_Sweep(relabel(response, rec.scene.name, label), rec) for response in responses]


def describe_modes(modes: Modes, theory: TheoreticalModes | None = None, frfs: Sequence[Response] = ()) -> list[str]:
    """Return a table of natural frequency, damping ratio, shape, and MAC with the scene (`theory`) of each mode.

    `frfs`: responses of the modes, whose lines may not resolve the peak of a mode.
    """
    count = modes.frequency.size
    mac_texts = [] if theory is None else [f"{mac_value:.4f}" for mac_value in nearest_mac(modes, theory)]
    reference = f", {modes.input}" if modes.input else ""
    heading = f"{modes.label}{reference}: {count} mode{'s' * (count != 1)}{modes.uncertain_count_text()}"
    is_extrapolated = extrapolates_damping(modes, frfs).tolist() if frfs else []
    notes = [", extrapolated" * extrapolated for extrapolated in is_extrapolated]
    return [heading, *modes.table(mac_texts, notes).lines("  ")]


def _has_near_frequency(modes: Modes, theory: TheoreticalModes) -> bool:
    """Return whether any mode is near a mode of the scene; masses and springs of imports may be placeholders."""
    ratios = modes.frequency[:, None] / theory.frequency
    return bool(np.any((ratios < _MAX_THEORY_RATIO) & (ratios > 1.0 / _MAX_THEORY_RATIO)))


def nearest_mac(modes: Modes, theory: TheoreticalModes) -> NDArray[np.float64]:
    """Return the largest MAC of each mode shape with a theoretical shape of similar frequency, shape (modes,)."""
    with np.errstate(divide="ignore"):
        distance = abs(np.log(modes.frequency[:, None] / theory.frequency))
    is_similar = distance <= np.maximum(np.log(_MAX_FREQUENCY_RATIO), distance.min(axis=1, keepdims=True))
    return np.where(is_similar, mac(modes.shapes, theory.shapes), 0.0).max(axis=1)


def theory_warnings(modes: Modes, theory: TheoreticalModes | None) -> list[str]:
    """Warn about mode shapes that match no theoretical shape: the channels or the scene may be wrong."""
    if theory is None:
        return []
    nearest = nearest_mac(modes, theory)
    # Upper bound of the decrease of the MAC due to the uncertainty of the shape.
    mac_uncertainty = np.sum(expand(modes.shape_std) ** 2, axis=0) / np.sum(abs(modes.shapes) ** 2, axis=0)
    is_mismatched = nearest + mac_uncertainty < MIN_SAME_SHAPE_MAC
    mismatched = zip(modes.frequency[is_mismatched], nearest[is_mismatched], strict=True)
    matched = modes.frequency[~is_mismatched].tolist() if modes.model_error else []
    combined, others = [], []
    for f, largest_mac in mismatched:
        if combination := combination_of(f, matched):
            combined.append(f"{f:.4g} Hz (about {combination})")
        else:
            others.append(f"{f:.4g} Hz (MAC {largest_mac:.2f})")
    warnings = []
    if combined:
        warnings.append(
            f"{', '.join(combined)}: probably harmonics or combination frequencies of a nonlinear response, because "
            "the shape matches no mode of the scene's structure. Measure at a lower level."
        )
    if others:
        warnings.append(
            f"{', '.join(others)}: the shape matches no mode of the scene's structure near this frequency (a match has "
            f"a MAC above {MIN_SAME_SHAPE_MAC:g}). Check whether channels are swapped, reversed or at other locations. "
            "`analysis fit` checks the values of the scene. If dampers fly, measure at a lower level."
        )
    return warnings


def combination_of(frequency: float, natural: Sequence[float]) -> str:
    """Return the harmonic or combination of natural frequencies that is close to a frequency; "" if there is none.

    The response of a nonlinear structure contains these frequencies. The combination of lowest order is returned.

    >>> [combination_of(frequency, [80.0, 140.0]) for frequency in (240.0, 299.8, 60.2, 110.0)]
    ['3 x 80 Hz', '140 + 2 x 80 Hz', '140 - 80 Hz', '']
    """
    for order in range(2, _MAX_COMBINATION_ORDER + 1):
        candidates = [(order * f, f"{order} x {f:.4g} Hz") for f in natural]
        for first, second in combinations(natural, 2):
            for factor in range(1, order):
                multiples = [_multiple(factor, first), _multiple(order - factor, second)]
                (low, low_text), (high, high_text) = sorted(multiples)
                candidates.append((low + high, f"{low_text} + {high_text} Hz"))
                candidates.append((high - low, f"{high_text} - {low_text} Hz"))
        for value, text in candidates:
            if abs(value - frequency) < _MAX_COMBINATION_ERROR * frequency:
                return text
    return ""


def _multiple(factor: int, frequency: float) -> tuple[float, str]:
    """Return a multiple of a frequency [Hz] and its text."""
    return factor * frequency, f"{factor} x {frequency:.4g}" if factor > 1 else f"{frequency:.4g}"
