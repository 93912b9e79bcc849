"""Stepped sine and constant tones: lock-in detection over every window marked as measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.recordings.slices import read_slices
from analysis.responses.clean_segments import describe_flaws, flaws
from analysis.responses.lock_in import LockIn, ToneFit, parts_of_whole_periods
from analysis.responses.scatter import Scatter, stacked
from analysis.responses.spectral_lines import Lines, remainder
from analysis.responses.systematic import counts_of, reproducible_rounding
from rig.errors import RecordingError
from rig.progress import CountProgress
from rig.results import format_frequencies, format_number

if TYPE_CHECKING:
    from daq.recording.recording import Recording

HARMONICS = 10
PARTS = 20
# A transient below this part of the tolerance of settling is not detectable in the parts of a window.
_HIDDEN_TRANSIENT = 0.05

# Tones of a window, its samples, and whether its motion was steady.
_Point = tuple[ToneFit, tuple[int, int], bool]
# Level and direction of a sweep; a frequency without a point, with the reason and its details.
_Setting = tuple[float, str]
_LeftOut = tuple[float, str, str]
_TOO_SHORT = "shorter than a period"


@dataclass(frozen=True)
class Sweep:
    """A pass through the frequencies at a constant level."""

    lines: Lines  # fundamental of every channel
    tones: tuple[ToneFit, ...]  # lock-in results, in the same order
    level: float  # nominal level: amplitude of the force, or of the drive
    direction: str  # ``"up"`` or ``"down"``
    windows: NDArray[np.int64]  # first and one-past-last sample of each window; int, shape (n, 2)


def sweeps(rec: Recording, channels: Sequence[str] | None = None, progress: CountProgress | None = None) -> list[Sweep]:
    """Apply lock-in detection to every window marked ``measure``; group the results by level and direction."""
    markers = sorted(
        (m for m in rec.markers if m.kind == "measure" and "frequency" in m.fields), key=lambda m: m.first_sample
    )
    names = list(rec.channels if channels is None else channels)
    runs: dict[_Setting, list[_Point]] = {}
    left_out: dict[_Setting, list[_LeftOut]] = {}
    windows = []
    for marker in markers:
        stop = rec.samples if marker.last_sample is None else marker.stop
        windows.append((int(marker.first_sample), min(stop, rec.samples)))
    parts = [
        parts_of_whole_periods(*window, float(marker.fields["frequency"]), rec.rate, PARTS)
        for marker, window in zip(markers, windows, strict=True)
    ]
    source = read_slices(rec, names, (part for group in parts for part in group))
    for n_completed, (marker, (first, stop), group) in enumerate(zip(markers, windows, parts, strict=True), 1):
        samples = (next(source) for _ in group)
        frequency = float(marker.fields["frequency"])
        key = float(marker.fields.get("level", np.nan)), str(marker.fields.get("direction", "up"))
        spoilt = flaws(rec, names, first, stop)
        if (stop - first) * frequency < 0.99 * rec.rate:
            left_out.setdefault(key, []).append((frequency, _TOO_SHORT, _TOO_SHORT))
        elif spoilt:
            why = ", ".join(dict.fromkeys(f"{flaw.channel} {flaw.reason}" for flaw in spoilt))
            left_out.setdefault(key, []).append((frequency, why, describe_flaws(rec, spoilt)))
        else:
            shortest = min(end - begin for begin, end in group)
            harmonics = int(max(1, min(HARMONICS, 0.45 * rec.rate / frequency, (shortest - 2) // 4)))
            lockin = LockIn(frequency, rec.rate, harmonics)
            for part in samples:
                lockin.add(part)
            steady = marker.fields.get("settled") is not False
            runs.setdefault(key, []).append((lockin.tone(), (first, stop), steady))
        # The samples of a window that is left out are skipped.
        for _ in samples:
            pass
        if progress is not None:
            progress(n_completed, len(markers))
    if not runs:
        raise RecordingError(f"{rec.path}: {_why_nothing(rec, [each for some in left_out.values() for each in some])}")
    several = len(runs.keys() | left_out.keys()) > 1
    notes = {key: _notes(key, runs.get(key, []), left_out.get(key, []), several) for key in {**runs, **left_out}}
    # A sweep without any point cannot have notes of its own; the first sweep reports them.
    notes[next(iter(runs))] += [note for key, lost in notes.items() if key not in runs for note in lost]
    return [
        _sweep(rec, key, points, notes[key], [each[0] for each in left_out.get(key, [])], several, tuple(names))
        for key, points in runs.items()
    ]


def _notes(key: _Setting, points: list[_Point], left_out: list[_LeftOut], several: bool) -> list[str]:
    """Describe the discarded frequencies of a sweep, with reasons, and those without steady-state motion."""
    setting = f"{format_number(key[0])} N {key[1]}: " if several else ""
    out = []
    for why in dict.fromkeys(each[1] for each in left_out):
        places = [each for each in left_out if each[1] == why]
        low, high = min(each[0] for each in places), max(each[0] for each in places)
        which = f"{len(places)} frequencies from {low:.4g} to {high:.4g} Hz left out"
        if len(places) == 1:
            which, why = f"{low:.4g} Hz left out", places[0][2]
        elif low == high:
            which = f"{low:.4g} Hz left out {len(places)} times"
        out.append(f"{setting}{which}: {why} in {'its window' if len(places) == 1 else 'their windows'}.")
    if not points:
        out.append(f"{setting}no frequency of this sweep is usable.")
    unsteady = [not steady for _, _, steady in points]
    if any(unsteady):
        where = format_frequencies([tone.frequency for tone, _, _ in points], unsteady)
        out.append(
            f"{setting}No steady state at {where}: these points are marked. The motion is irregular or needs a longer "
            "test.settle."
        )
    return out


def _why_nothing(rec: Recording, left_out: list[_LeftOut]) -> str:
    duration = f"{rec.samples / rec.rate:.3g} s"
    for marker in rec.markers:
        if marker.kind == "abort":
            return f"nothing was measured in these {duration}, as the test ended early: {marker.fields['reason']}"
    reasons = [why for _, why, _ in left_out]
    if any("overloaded" in why for why in reasons):
        return (
            "the channels were overloaded in every measured window. Lower the level, widen the converter's range, or "
            "lower the sensitivity in the scene."
        )
    if _TOO_SHORT in reasons:
        return "every measured window is shorter than a period of its tone. Measure longer (test: measure: periods)."
    if reasons:
        return "every measured window has lost samples. Record again, or repair the file with `daq recover`."
    if rec.source:
        return (
            f"no step was detected in these {duration} when they were imported: no tone lasts for ten periods. Import "
            "it with the kind of its test (test: kind: swept_sine, random)."
        )
    return (
        f"no steady state was measured in these {duration}: no window is marked 'measure'. Let the test run to its "
        "first measurement (test: settle, measure)."
    )


def _sweep(
    rec: Recording,
    key: _Setting,
    points: list[_Point],
    notes: list[str],
    left_out: list[float],
    several: bool,
    names: tuple[str, ...],
) -> Sweep:
    level, direction = key
    tones = tuple(tone for tone, _, _ in points)
    windows = np.array([window for _, window, _ in points])
    # Where dampers move, the transient decays differently from what steady responses predict.
    alone = not any(damper.moves for damper in rec.scene.dampers)
    settle = getattr(rec.scene.test, "settle", None)
    hidden = 0.0 if alone or settle is None else _HIDDEN_TRANSIENT * settle.tolerance
    waited = (windows[:, 0] - np.concatenate([[0], windows[:-1, 1]])) / rec.rate
    lines = Lines(
        channels=names,
        frequency=np.array([tone.frequency for tone in tones]),
        mean=np.stack([tone.amplitude[:, 0] for tone in tones], axis=1),
        scatter=Scatter(
            stacked([tone.scatter() for tone in tones]), np.array([2.0 * (len(tone.parts) - 1.0) for tone in tones])
        ),
        label=f"{rec.scene.name}{f', {format_number(level)} N {direction}' if several else ''}",
        warnings=tuple(notes),
        remainder=np.stack(
            [np.maximum(remainder(tone.parts[:, :, None])[:, 0], hidden * abs(tone.amplitude[:, 0])) for tone in tones],
            axis=1,
        ),
        resolution=np.stack([_resolution(rec, names, tone) for tone in tones], axis=1),
        unsteady=np.array([not steady for _, _, steady in points]),
        left_out=np.array(left_out),
        waited=waited if alone else None,
        lasted=np.diff(windows)[:, 0] / rec.rate if alone else None,
    )
    return Sweep(lines, tones, level, direction, windows)


def _resolution(rec: Recording, names: Sequence[str], tone: ToneFit) -> NDArray[np.float64]:
    """Compute the largest error of each amplitude of a tone by rounding to counts, shape (channels,).

    A tone below half a count is not recorded. The error of a larger tone, with an amplitude of a counts, is at most
    ``2 / pi^2 / sqrt(a)`` (first term of the quantiser's series in Bessel functions (B. Widrow, I. Kollár,
    Quantization Noise, Cambridge University Press 2008, sections 4 and 16)); noise reduces it.
    """
    count = counts_of(rec, names)
    step = np.where(count > 0.0, count, 1.0)
    size = np.maximum(abs(tone.amplitude[:, 0]) / step, 1e-300)
    off = np.minimum(2.0 / np.pi**2 / np.sqrt(size), 0.5) * reproducible_rounding((tone.residual / step) ** 2)
    # Factor 2: bound of all terms of the series.
    return np.asarray(count * np.minimum(2.0 * off, 0.5))
