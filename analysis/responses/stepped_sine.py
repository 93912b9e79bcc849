"""Stepped sine and constant tones: lock-in detection over every window marked as measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

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

# Largest number of harmonics that are fitted with the tone.
HARMONICS = 10
# Largest number of parts of a window, whose scatter determines the uncertainty of its mean.
PARTS = 20
# A transient below this part of the tolerance of settling is not detectable in the parts of a window.
_UNDETECTED_TRANSIENT = 0.05
# Reason for the omission of a window.
_TOO_SHORT = "shorter than a period"

# Level and direction of a sweep.
_Setting = tuple[float, str]


class _Point(NamedTuple):
    """Measurement of a window."""

    tone: ToneFit
    window: tuple[int, int]  # first sample, and one past the last
    steady: bool


class _Omission(NamedTuple):
    """A window that was not evaluated."""

    frequency: float  # Hz
    reason: str  # the same for all windows with the same flaw
    details: str  # with the times of the flaws


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
    points: dict[_Setting, list[_Point]] = {}
    omissions: dict[_Setting, list[_Omission]] = {}
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
        window_flaws = flaws(rec, names, first, stop)
        if (stop - first) * frequency < 0.99 * rec.rate:
            omissions.setdefault(key, []).append(_Omission(frequency, _TOO_SHORT, _TOO_SHORT))
        elif window_flaws:
            reason = ", ".join(dict.fromkeys(f"{flaw.channel} {flaw.reason}" for flaw in window_flaws))
            omissions.setdefault(key, []).append(_Omission(frequency, reason, describe_flaws(rec, window_flaws)))
        else:
            shortest = min(end - begin for begin, end in group)
            harmonics = int(max(1, min(HARMONICS, 0.45 * rec.rate / frequency, (shortest - 2) // 4)))
            lockin = LockIn(frequency, rec.rate, harmonics)
            for part in samples:
                lockin.add(part)
            steady = marker.fields.get("settled") is not False
            points.setdefault(key, []).append(_Point(lockin.tone(), (first, stop), steady))
        # The samples of an omitted window are skipped.
        for _ in samples:
            pass
        if progress is not None:
            progress(n_completed, len(markers))
    if not points:
        reasons = [omission.reason for sweep_omissions in omissions.values() for omission in sweep_omissions]
        raise RecordingError(f"{rec.path}: {_reason_without_result(rec, reasons)}")
    several = len(points.keys() | omissions.keys()) > 1
    notes = {key: _notes(key, points.get(key, []), omissions.get(key, []), several) for key in {**points, **omissions}}
    # A sweep without any point is not returned; the first sweep reports its notes.
    notes[next(iter(points))] += [note for key in notes if key not in points for note in notes[key]]
    return [
        _sweep(rec, key, sweep_points, notes[key], omissions.get(key, []), several, tuple(names))
        for key, sweep_points in points.items()
    ]


def _notes(key: _Setting, points: list[_Point], omissions: list[_Omission], several: bool) -> list[str]:
    """Describe the discarded frequencies of a sweep, with reasons, and those without steady-state motion."""
    setting = f"{format_number(key[0])} N {key[1]}: " if several else ""
    out = []
    for reason in dict.fromkeys(omission.reason for omission in omissions):
        group = [omission for omission in omissions if omission.reason == reason]
        low, high = (limit(omission.frequency for omission in group) for limit in (min, max))
        if len(group) == 1:
            out.append(f"{setting}{low:.4g} Hz left out: {group[0].details} in its window.")
        elif low == high:
            out.append(f"{setting}{low:.4g} Hz left out {len(group)} times: {reason} in their windows.")
        else:
            frequencies = f"{len(group)} frequencies from {low:.4g} to {high:.4g} Hz"
            out.append(f"{setting}{frequencies} left out: {reason} in their windows.")
    if not points:
        out.append(f"{setting}no frequency of this sweep is usable.")
    unsteady = [not point.steady for point in points]
    if any(unsteady):
        frequencies = format_frequencies([point.tone.frequency for point in points], unsteady)
        out.append(
            f"{setting}No steady state at {frequencies}: these points are marked. The motion is irregular or needs a "
            "longer test.settle."
        )
    return out


def _reason_without_result(rec: Recording, reasons: list[str]) -> str:
    duration = f"{rec.samples / rec.rate:.3g} s"
    for marker in rec.markers:
        if marker.kind == "abort":
            return f"nothing was measured in these {duration}, as the test ended early: {marker.fields['reason']}"
    if any("overloaded" in reason for reason in reasons):
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
    omissions: list[_Omission],
    several: bool,
    names: tuple[str, ...],
) -> Sweep:
    level, direction = key
    tones = tuple(point.tone for point in points)
    windows = np.array([point.window for point in points])
    # With moving dampers, a transient decays differently from the prediction by steady responses.
    is_linear = not any(damper.moves for damper in rec.scene.dampers)
    settle = getattr(rec.scene.test, "settle", None)
    undetected = 0.0 if is_linear or settle is None else _UNDETECTED_TRANSIENT * settle.tolerance
    wait = (windows[:, 0] - np.concatenate([[0], windows[:-1, 1]])) / rec.rate
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
            [
                np.maximum(remainder(tone.parts[:, :, None])[:, 0], undetected * abs(tone.amplitude[:, 0]))
                for tone in tones
            ],
            axis=1,
        ),
        resolution=np.stack([_resolution(rec, names, tone) for tone in tones], axis=1),
        unsteady=np.array([not point.steady for point in points]),
        left_out=np.array([omission.frequency for omission in omissions]),
        wait=wait if is_linear else None,
        duration=np.diff(windows)[:, 0] / rec.rate if is_linear else None,
    )
    return Sweep(lines, tones, level, direction, windows)


def _resolution(rec: Recording, names: Sequence[str], tone: ToneFit) -> NDArray[np.float64]:
    """Compute the largest error of each amplitude of a tone by rounding to counts, shape (channels,).

    A tone below half a count is not recorded. The error of a larger tone, with an amplitude of a counts, is at most
    ``2 / pi^2 / sqrt(a)``: the first term of the quantizer's series in Bessel functions (B. Widrow, I. Kollár,
    Quantization Noise, Cambridge University Press 2008, sections 4 and 16). Noise reduces it.
    """
    count = counts_of(rec, names)
    step = np.where(count > 0.0, count, 1.0)
    size = np.maximum(abs(tone.amplitude[:, 0]) / step, 1e-300)
    first_term = np.minimum(2.0 / np.pi**2 / np.sqrt(size), 0.5) * reproducible_rounding((tone.residual / step) ** 2)
    # Factor 2: bound of all terms of the series.
    return np.asarray(count * np.minimum(2.0 * first_term, 0.5))
