"""Stepped sine and constant tones: lock-in detection of the tone in every measured window.

A *window* is a measured interval of a tone (see `lock_in`). Simultaneous tones have the same window; each tone is
fitted after the other tones are subtracted. A *sweep* is a pass through the frequencies at one *level* (nominal
amplitude of the force or drive) in one *direction*, up or down.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from analysis.core.recordings.slices import PIECE_SAMPLES, read_slices
from analysis.core.responses.checks.clean_segments import describe_flaws, find_flaws
from analysis.core.responses.checks.tone_steps import ToneInterval
from analysis.core.responses.errors.scatter import Scatter, stacked
from analysis.core.responses.errors.systematic import quantization_steps, reproducible_rounding
from analysis.core.responses.estimator import Estimator, Request
from analysis.core.responses.lock_in import LockIn, ToneFit, parts_of_whole_periods
from analysis.core.responses.spectral_lines import Lines, residual_transient
from daq.core.recording.markers import Marker
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.progress import CountProgress
from rig.core.results import format_frequencies, format_number
from rig.core.results.response import Response

# Maximum number of fitted harmonics, including the tone.
HARMONICS = 10
# A transient below this fraction of the settling tolerance is not detectable in the parts of a window.
_UNDETECTED_TRANSIENT = 0.05
# Reasons for the omission of a window that is too short.
_TOO_SHORT = "shorter than a period of its tone"
_TOO_CLOSE = "shorter than a period of the beat with another tone"
_LENGTHS = (_TOO_SHORT, _TOO_CLOSE)
# A wait for the steady state begins with the transition to its tone, which usually ends within this time [s].
_TRANSITION_S = 0.5


# Level (N, or the unit of the drive) and direction of a sweep, which identify it.
_SweepKey = tuple[float, str]


class _Window(NamedTuple):
    """A measured window: the fitted amplitudes of its tone, or the reason why they are not estimated."""

    frequency: float  # Hz
    bounds: tuple[int, int]  # first sample, and one past the last
    is_steady: bool  # whether steady state was reached
    tone: ToneFit | None = None
    omission: str = ""  # reason without times: equal for all windows with the same flaw
    details: str = ""  # reason with the times of the flaws


@dataclass(frozen=True)
class Sweep:
    """A pass through the frequencies at a constant level."""

    lines: Lines  # amplitude of the tone in every channel, at each frequency
    tones: tuple[ToneFit, ...]  # lock-in results, in the order of the frequencies
    level: float  # nominal level: amplitude of the force, or of the drive
    direction: str  # ``"up"`` or ``"down"``
    windows: NDArray[np.int64]  # first and one-past-last sample of each window; int, shape (n, 2)


# Computed sweeps of the open recordings, by channels; responses and damper motion use the same sweeps.
_sweeps_of: WeakKeyDictionary[Recording, dict[tuple[str, ...], list[Sweep]]] = WeakKeyDictionary()


def sweeps(rec: Recording, channels: Sequence[str] | None = None, progress: CountProgress | None = None) -> list[Sweep]:
    """Return the sweeps of a recording; they are computed once while it is open."""
    names = tuple(rec.channels if channels is None else channels)
    computed = _sweeps_of.setdefault(rec, {})
    if names not in computed:
        computed[names] = _measured_sweeps(rec, names, progress)
    return list(computed[names])


def _measured_sweeps(rec: Recording, names: tuple[str, ...], progress: CountProgress | None) -> list[Sweep]:
    """Apply lock-in detection to every window marked ``measure``, and group the windows by level and direction."""
    markers = sorted(
        (marker for marker in rec.markers if marker.kind == "measure" and "frequency" in marker.fields),
        key=lambda marker: marker.first_sample,
    )
    simultaneous: dict[tuple[int, int], list[float]] = {}  # frequencies of the tones of each window
    for marker in markers:
        simultaneous.setdefault(_bounds(rec, marker), []).append(float(marker.fields["frequency"]))
    windows: dict[_SweepKey, list[_Window]] = {}
    for n_completed, marker in enumerate(markers, 1):
        key = float(marker.fields.get("level", np.nan)), str(marker.fields.get("direction", "up"))
        window = _measured_window(rec, names, marker, simultaneous[_bounds(rec, marker)])
        windows.setdefault(key, []).append(window)
        if progress is not None:
            progress(n_completed, len(markers))
    measured = [key for key, group in windows.items() if any(window.tone for window in group)]
    if not measured:
        reasons = [window.omission for group in windows.values() for window in group]
        raise RecordingError(f"{rec.path}: {_reason_without_result(rec, reasons)}")
    sweep_names = {key: sweep_name(rec, key) if len(windows) > 1 else "" for key in windows}
    # A sweep without any measured window is not returned; the first sweep reports its notes.
    unmeasured = [note for key in windows if key not in measured for note in _notes(sweep_names[key], windows[key])]
    return [
        _sweep(rec, key, sweep_names[key], windows[key], unmeasured if key == measured[0] else [], names)
        for key in measured
    ]


def _bounds(rec: Recording, marker: Marker) -> tuple[int, int]:
    """Return the first sample of a measured window, and one past the last."""
    stop = rec.samples if marker.last_sample is None else marker.stop
    return int(marker.first_sample), min(stop, rec.samples)


def _measured_window(rec: Recording, names: Sequence[str], marker: Marker, frequencies: Sequence[float]) -> _Window:
    """Fit the tone of a marker to its window, or describe why this is impossible; `frequencies`: all tones there."""
    frequency, (first, stop) = float(marker.fields["frequency"]), _bounds(rec, marker)
    others = [other for other in frequencies if other != frequency]
    window = _Window(frequency, (first, stop), marker.fields.get("settled") is not False)
    flaws = find_flaws(rec, names, first, stop)
    if (stop - first) * frequency < 0.99 * rec.rate:
        return window._replace(omission=_TOO_SHORT, details=_TOO_SHORT)
    if any((stop - first) * abs(frequency - other) < 0.99 * rec.rate for other in others):
        return window._replace(omission=_TOO_CLOSE, details=_TOO_CLOSE)
    if flaws:
        reason = ", ".join(dict.fromkeys(flaw.description for flaw in flaws))
        return window._replace(omission=reason, details=describe_flaws(rec, flaws))
    parts = parts_of_whole_periods(first, stop, frequency, rec.rate)
    lengths = [end - begin for begin, end in parts]
    # Harmonics are fitted below half the sample rate, with at most half as many terms as samples of a part.
    harmonics = int(max(1, min(HARMONICS, 0.45 * rec.rate / frequency, (min(lengths) - 2) // 4)))
    lockin = LockIn(frequency, rec.rate, harmonics)
    tones = _tones_at_once(rec, names, (first, stop), [frequency, *others]) if others else None
    # Parts are read together, in bounded memory.
    size = max(1, PIECE_SAMPLES // max(lengths))
    batches = [parts[index : index + size] for index in range(0, len(parts), size)]
    samples = read_slices(rec, names, ((batch[0][0], batch[-1][1]) for batch in batches))
    for batch, block in zip(batches, samples, strict=True):
        if tones is not None:
            terms = _terms(others, rec.rate, (first, stop), batch[0][0], block.shape[1])
            block = block - tones[4:].T @ terms[2:]
        lockin.add(block, [end - begin for begin, end in batch])
    return window._replace(tone=lockin.tone())


def _tones_at_once(
    rec: Recording, names: Sequence[str], window: tuple[int, int], frequencies: Sequence[float]
) -> Array:
    """Fit a constant, a slope and tones to a window by least squares; return the coefficients of `_terms`."""
    edges = [*range(window[0], window[1], PIECE_SAMPLES), window[1]]
    n_terms = 2 * len(frequencies) + 2
    gram, projections = np.zeros((n_terms, n_terms)), np.zeros((n_terms, len(names)))
    for first, samples in zip(edges, read_slices(rec, names, pairwise(edges)), strict=False):
        terms = _terms(frequencies, rec.rate, window, first, samples.shape[1])
        gram += terms @ terms.T
        projections += terms @ samples.T
    return np.asarray(np.linalg.solve(gram, projections))


def _terms(frequencies: Sequence[float], rate: float, window: tuple[int, int], first: int, count: int) -> Array:
    """Return constant, slope, and cosine and sine of each tone at samples of a window, shape (terms, count)."""
    samples = np.arange(first, first + count) - window[0]
    angle = 2.0 * np.pi * np.fmod(np.outer(frequencies, samples) / rate, 1.0)
    tones = np.stack([np.cos(angle), np.sin(angle)], axis=1).reshape(-1, count)
    return np.vstack([np.ones(count), samples / (window[1] - window[0]) - 0.5, tones])


def sweep_name(rec: Recording, key: _SweepKey) -> str:
    """Describe level and direction of a sweep; a level of the drive is stated without its unit [V, m or N]."""
    level, direction = key
    test = rec.scene.test
    if test is None or test.held_motion is None:
        name = f"level {format_number(level)}" if rec.scene.level_key == "drive" else f"{format_number(level)} N"
        return f"{name} {direction}"
    unit = test.level_unit(None)
    factor, prefix = (1.0, "") if unit.endswith("^2") else (1e3, "m")  # displacements and velocities are small
    return f"{format_number(factor * level)} {prefix}{unit.replace('^2', '²')} {direction}"


def _notes(sweep_name: str, windows: Sequence[_Window]) -> list[str]:
    """Describe the discarded frequencies of a sweep, with reasons, and the frequencies without steady-state motion."""
    prefix = f"{sweep_name}: " if sweep_name else ""
    notes = []
    for reason in dict.fromkeys(window.omission for window in windows if window.omission):
        group = [window for window in windows if window.omission == reason]
        low, high = (limit(window.frequency for window in group) for limit in (min, max))
        cause = f"their windows are {reason}" if reason in _LENGTHS else f"{reason} in their windows"
        if len(group) == 1:
            details = f"its window is {reason}" if reason in _LENGTHS else f"{group[0].details} in its window"
            notes.append(f"{prefix}{low:.4g} Hz omitted: {details}.")
        elif low == high:
            notes.append(f"{prefix}{low:.4g} Hz omitted {len(group)} times: {cause}.")
        else:
            notes.append(f"{prefix}{len(group)} frequencies from {low:.4g} to {high:.4g} Hz omitted: {cause}.")
    measured = [window for window in windows if window.tone]
    if not measured:
        notes.append(f"{prefix}no frequency of this sweep is usable.")
    if not all(window.is_steady for window in measured):
        frequencies = format_frequencies(
            [window.frequency for window in measured], [not window.is_steady for window in measured]
        )
        notes.append(
            f"{prefix}No steady state at {frequencies}: these points are marked. Increase test.settle.longest of a "
            "stepped sine, or lower the level."
        )
    return notes


def _reason_without_result(rec: Recording, reasons: list[str]) -> str:
    """Describe why no window was evaluated, and the remedy; `reasons`: reasons of the omissions."""
    duration = f"{rec.samples / rec.rate:.3g} s"
    for marker in rec.markers:
        if marker.kind == "abort":
            return f"nothing was measured in these {duration}, as the test ended early: {marker.fields['reason']}"
    if any("overloaded" in reason for reason in reasons):
        return (
            "the channels were overloaded in every measured window. Lower the level, widen the converter's range, or "
            "lower the sensitivity in the scene."
        )
    for reason in _LENGTHS:
        if reason in reasons:
            return f"every measured window is {reason}. Measure longer (test: measure: periods)."
    if reasons:
        return "samples are lost in every measured window. Record again, or repair the file with `daq recover`."
    if rec.source:
        return (
            f"no dwell was detected in these {duration}. No tone lasts at least ten periods, so this may not be a "
            "stepped sine. Set the actual test in the scene (test: {kind: swept_sine} or {kind: random}) and import "
            "the file again."
        )
    return (
        f"no steady state was measured in these {duration}: no window is marked 'measure'. Record again, and let "
        "the test run to its first measurement."
    )


def _sweep(
    rec: Recording,
    key: _SweepKey,
    sweep_name: str,
    windows: Sequence[_Window],
    further_notes: Sequence[str],
    channels: tuple[str, ...],
) -> Sweep:
    """Combine the windows of one level and direction to a sweep."""
    measured = [window for window in windows if window.tone]
    if len({window.bounds for window in measured}) < len(measured):
        # Simultaneous tones are in ascending order, all others in the order of the test.
        measured.sort(key=lambda window: window.frequency)
    tones = tuple(window.tone for window in measured if window.tone)
    mean = np.stack([tone.amplitude[:, 0] for tone in tones], axis=1)
    bounds = np.array([window.bounds for window in measured])
    # With moving dampers, the decay of a transient cannot be predicted from the steady responses.
    test = rec.scene.test
    undetected = 0.0 if rec.scene.is_linear or test is None else _UNDETECTED_TRANSIENT * test.accepted_transient
    last_stops = [bounds[bounds[:, 1] <= first, 1].max(initial=0) for first in bounds[:, 0]]
    wait = (bounds[:, 0] - np.array(last_stops)) / rec.rate
    lines = Lines(
        channels=channels,
        frequency=np.array([tone.frequency for tone in tones]),
        mean=mean,
        scatter=Scatter(
            stacked([tone.scatter() for tone in tones]), np.array([2.0 * (len(tone.parts) - 1.0) for tone in tones])
        ),
        label=f"{rec.scene.name}{f', {sweep_name}' if sweep_name else ''}",
        warnings=(*_notes(sweep_name, windows), *further_notes),
        residual_transient=np.maximum(_residual_transients(tones), undetected * abs(mean)),
        resolution=_resolution(rec, channels, mean, np.stack([tone.noise for tone in tones], axis=1)),
        unsteady=np.array([not window.is_steady for window in measured]),
        omitted=np.array([window.frequency for window in windows if not window.tone]),
        timing=(wait, np.diff(bounds)[:, 0] / rec.rate) if rec.scene.is_linear else None,
        # The last changes of the drive by feedback are unknown, so their transients cannot be predicted.
        accepted_transient=test.accepted_transient if test is not None and test.follows_motion else 0.0,
    )
    return Sweep(lines, tones, *key, bounds)


def _residual_transients(tones: Sequence[ToneFit]) -> Array:
    """Estimate the maximum error of each tone due to a decaying transient, shape (channels, tones)."""
    counts = np.array([len(tone.parts) for tone in tones])
    transients = np.empty((tones[0].parts.shape[1], len(tones)))
    # Tones with equal numbers of parts are evaluated in one call, which takes as long as for one tone.
    for count in np.unique(counts):
        indices = np.flatnonzero(counts == count)
        parts = np.concatenate([tones[index].parts for index in indices.tolist()], axis=1)
        transients[:, indices] = residual_transient(parts[..., None]).reshape(indices.size, -1).T
    return transients


def _resolution(rec: Recording, names: Sequence[str], mean: ComplexArray, noise: Array) -> Array:
    """Compute the maximum error of the amplitudes of tones due to rounding to counts, shape (channels, tones).

    `mean`, `noise`: amplitudes, and root mean squares of the noise, of the same shape. A tone below half a count
    is not recorded. The error of a larger tone, with an amplitude of a counts, is at most ``2 / pi^2 / sqrt(a)``: the
    first term of the quantizer's series in Bessel functions (B. Widrow, I. Kollár, Quantization Noise, Cambridge
    University Press 2008, sections 4 and 16). Noise reduces the error.
    """
    steps = quantization_steps(rec, names)[:, None]
    step = np.where(steps > 0.0, steps, 1.0)
    amplitude_counts = np.maximum(abs(mean) / step, 1e-300)
    first_term = np.minimum(2.0 / np.pi**2 / np.sqrt(amplitude_counts), 0.5) * reproducible_rounding(
        (noise / step) ** 2
    )
    # Twice the first term is an upper bound of the sum of all terms.
    return np.asarray(steps * np.minimum(2.0 * first_term, 0.5))


def _compute(request: Request) -> list[Response]:
    selected = _selected_sweeps(request)
    responses = request.compute(sweep.lines for sweep in selected)
    return [_add_simultaneous(response, sweep.windows) for response, sweep in zip(responses, selected, strict=True)]


def _add_simultaneous(response: Response, windows: NDArray[np.int64]) -> Response:
    """Replace the loading of each tone with the sum of the tones in its window, whose peaks coincide at some time."""
    if response.loading is None:
        return response
    _, window = np.unique(windows[:, 0], return_inverse=True)
    sums = np.asarray(np.bincount(window, response.loading), dtype=np.float64)
    return replace(response, loading=sums[window])


def _selected_sweeps(request: Request) -> list[Sweep]:
    """Return the sweeps of the requested level and direction; raise `SceneError` if there is none."""
    all_sweeps = sweeps(request.rec, request.channels, request.progress)
    selected = [
        sweep
        for sweep in all_sweeps
        if (request.level is None or abs(sweep.level - request.level) <= 1e-6 * abs(request.level))
        and (request.direction is None or sweep.direction == request.direction)
    ]
    if all_sweeps and not selected:
        raise SceneError(f"{request.rec.path}: no sweep matches. Choose one of {describe_sweeps(all_sweeps)}.")
    return selected


def describe_sweeps(all_sweeps: Iterable[Sweep]) -> str:
    """List levels and directions of sweeps, as arguments."""
    return "; ".join(f"level={sweep.level:g}, direction={sweep.direction!r}" for sweep in all_sweeps)


def _peak_remedy(needed: float) -> str:
    """Return the remedy for too few tones in a peak; `needed`: required spacing of the tones [Hz]."""
    return f"Measure every {needed:.1g} Hz there" if np.isfinite(needed) else "Measure with smaller steps there"


def _tone_intervals(request: Request) -> list[ToneInterval]:
    """Return the tones, each from the end of the transition to its frequency to the end of its measurement."""
    rec, intervals = request.rec, list[ToneInterval]()
    for marker in rec.markers:
        if marker.kind not in ("settle", "measure") or "frequency" not in marker.fields:
            continue
        tone = float(marker.fields["frequency"]) / rec.rate
        first = marker.first_sample + (round(_TRANSITION_S * rec.rate) if marker.kind == "settle" else 0)
        if intervals and intervals[-1].stop == first and intervals[-1].start == tone:
            first = intervals.pop().first
        intervals.append(ToneInterval(first, min(marker.stop, rec.samples), tone))
    return intervals


ESTIMATOR = Estimator(
    _compute,
    "steady tones are averaged over whole periods",
    "fits in whole periods",
    jumps=True,
    tones=_tone_intervals,
    peak_remedy=_peak_remedy,
)
