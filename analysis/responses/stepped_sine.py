"""Stepped sine and held tones: lock-in over every window that the test marked as measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.recordings.slices import read_slices
from analysis.responses.lock_in import LockIn, ToneFit, parts_of_whole_periods
from analysis.responses.spectral_lines import Lines
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.recording.recording import Recording

HARMONICS = 10
PARTS = 20
# A window that is clipped for more than this part has no amplitude worth reporting.
MOST_CLIPPED = 0.01


@dataclass(frozen=True)
class Sweep:
    """One pass through the frequencies at one level."""

    lines: Lines
    """Fundamental of every channel."""
    tones: tuple[ToneFit, ...]
    """Everything the lock-in found, in the same order."""
    level: float
    """Level that the test asked for: amplitude of the force, or of the drive."""
    direction: str  # ``"up"`` or ``"down"``
    windows: NDArray[np.int64]
    """First and one-past-last sample of each window; int, shape (n, 2)."""

    def distortion(self) -> NDArray[np.float64]:
        """Total harmonic distortion, shape (channels, n), of the channels as recorded."""
        return np.stack([tone.distortion() for tone in self.tones], axis=1)


def sweeps(rec: Recording, progress: Callable[[int, int], None] | None = None) -> list[Sweep]:
    """Lock in on every window marked ``measure``, and sort them by level and direction.

    Parameters
    ----------
    rec : daq.recording.Recording
        A stepped-sine or sine recording.
    progress : callable, optional
        Called with (windows done, windows in all).

    Returns
    -------
    list of Sweep
        In the order in which the test ran them.
    """
    markers = sorted(
        (m for m in rec.markers if m.kind == "measure" and "frequency" in m.fields),
        key=lambda m: m.first_sample,
    )
    names = list(rec.channels)
    clipped = _clipped(rec)
    overloaded = short = 0
    unsteady: dict[tuple[float, str], list[str]] = {}
    runs: dict[tuple[float, str], list[tuple[ToneFit, tuple[int, int]]]] = {}
    notes: dict[tuple[float, str], list[str]] = {}
    windows = [_window(rec, marker) for marker in markers]
    parts = [
        parts_of_whole_periods(first, stop, frequency, rec.rate, PARTS) for frequency, first, stop in windows
    ]
    source = read_slices(rec, names, (part for group in parts for part in group))
    for index, (marker, (frequency, first, stop), group) in enumerate(
        zip(markers, windows, parts, strict=True)
    ):
        key = _setting(marker)
        if (stop - first) * frequency < 0.99 * rec.rate:
            short += 1
            for _ in group:
                next(source)
            note = notes.setdefault(key, [])
            note.append(f"{frequency:.4g} Hz left out: its window is shorter than a period.")
            continue
        shortest = min(end - begin for begin, end in group)
        harmonics = int(max(1, min(HARMONICS, 0.45 * rec.rate / frequency, (shortest - 2) // 4)))
        lockin = LockIn(frequency, rec.rate, harmonics)
        whole = True
        for _ in group:
            samples = next(source)
            whole = whole and bool(np.isfinite(samples).all())
            if whole:
                lockin.add(samples)
        if progress is not None:
            progress(index + 1, len(markers))
        note = notes.setdefault(key, [])
        if not whole:
            note.append(f"{frequency:.4g} Hz left out: samples were lost in its window.")
            continue
        hit = [name for name in names if _overlaps(clipped.get(name), first, stop)]
        worst = max((_covered(clipped[name], first, stop) for name in hit), default=0.0)
        if worst > MOST_CLIPPED:
            note.append(
                f"{frequency:.4g} Hz left out: {', '.join(hit)} overloaded for {worst:.0%} of the window."
            )
            overloaded += 1
            continue
        if hit:
            note.append(
                f"{frequency:.4g} Hz: {', '.join(hit)} overloaded; lower the level or widen the range."
            )
        if marker.fields.get("settled") is False:
            unsteady.setdefault(key, []).append(f"{frequency:.4g}")
        runs.setdefault(key, []).append((lockin.tone(), (first, stop)))
    if not runs:
        raise RecordingError(_why_nothing(rec, bool(markers), overloaded, short))
    for key, points in unsteady.items():
        notes[key].append(
            f"No steady state at {', '.join(points)} Hz: the motion is irregular there, or needs longer to "
            "settle."
        )
    return [_sweep(rec, key, found, notes[key], len(runs) > 1) for key, found in runs.items()]


def _window(rec: Recording, marker: Any) -> tuple[float, int, int]:
    frequency = float(marker.fields["frequency"])
    stop = rec.samples if marker.last_sample is None else marker.stop
    return frequency, int(marker.first_sample), min(stop, rec.samples)


def _setting(marker: Any) -> tuple[float, str]:
    return float(marker.fields.get("level", np.nan)), str(marker.fields.get("direction", "up"))


def _clipped(rec: Recording) -> dict[str, NDArray[np.int64]]:
    """Overloaded samples of each channel as rows [first, stop)."""
    found: dict[str, list[tuple[int, int]]] = {}
    for marker in rec.overloads:
        found.setdefault(str(marker.fields.get("channel", "")), []).append((marker.first_sample, marker.stop))
    return {name: np.array(rows) for name, rows in found.items()}


def _overlaps(ranges: NDArray[np.int64] | None, first: int, stop: int) -> bool:
    return ranges is not None and bool(np.any((ranges[:, 0] < stop) & (ranges[:, 1] > first)))


def _covered(ranges: NDArray[np.int64], first: int, stop: int) -> float:
    """Part of the window ``[first, stop)`` that the ranges cover."""
    inside = np.minimum(ranges[:, 1], stop) - np.maximum(ranges[:, 0], first)
    return float(np.maximum(inside, 0).sum() / max(stop - first, 1))


def _why_nothing(rec: Recording, marked: bool, overloaded: int, short: int) -> str:
    if overloaded:
        return (
            "the channels were overloaded in every measured window: lower the level, or widen the "
            "converter's range "
            "or lower the sensitivity in the scene"
        )
    if short:
        return (
            "every measured window is too short: it holds less than a period of its tone; measure longer "
            "(test: measure: periods)"
        )
    if marked:
        return "every measured window has lost samples: record again, or repair the file with `daq recover`"
    duration = rec.samples / rec.rate
    return (
        f"no steady state was measured in this recording of {duration:.3g} s: it holds no window marked "
        "'measure'; "
        "let the test run to its first measurement (test: settle, measure)"
    )


def _sweep(
    rec: Recording,
    key: tuple[float, str],
    found: list[tuple[ToneFit, tuple[int, int]]],
    notes: list[str],
    several: bool,
) -> Sweep:
    level, direction = key
    tones = tuple(tone for tone, _ in found)
    setting = f", {level:.3g} {'N'} {direction}" if several else ""
    lines = Lines(
        channels=tuple(rec.channels),
        frequency=np.array([tone.frequency for tone in tones]),
        mean=np.stack([tone.amplitude[:, 0] for tone in tones], axis=1),
        covariance=np.stack([tone.covariance() for tone in tones]),
        averages=np.array([float(len(tone.parts)) for tone in tones]),
        label=f"{rec.scene.name}{setting}",
        warnings=tuple(notes),
    )
    return Sweep(lines, tones, level, direction, np.array([window for _, window in found]))
