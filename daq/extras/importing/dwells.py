"""Detection of dwells and their steady parts in a track of frequency and phase (see `tone_track`).

A dwell is a tone of constant frequency, so its phase is linear in time. Segments of a track are extended as
long as a straight line fits their phase, and rejected if the frequency drifts as in a sweep.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from daq.extras.importing.tone_track import HOPS_PER_BLOCK, Track
from rig.core.base.arrays import Array, ComplexArray
from rig.core.numerics.runs import runs_of

# A dwell has at least this number of blocks: about ten periods.
_MIN_BLOCKS = 7
# The phase of a dwell deviates from a straight line by at most this multiple of its scatter, limited to the range
# from `_MIN_TOLERANCE_RAD` to `_MAX_TOLERANCE_RAD`.
_MAX_RESIDUAL_SIGMAS = 8.0
_MIN_TOLERANCE_RAD = 0.02
_MAX_TOLERANCE_RAD = 0.25
# A dwell ends where the phase deviates from the line through the middle half by this multiple of the scatter, but at
# least `_END_MIN_RAD`.
_END_SIGMAS = 4.0
_END_MIN_RAD = 0.01
# A dwell ends where the natural logarithm of the amplitude changes by more than this from one block to the next.
_MAX_AMPLITUDE_STEP = 0.2
# In the second half of a dwell, the natural logarithm of the amplitude changes by at most this value.
_MAX_AMPLITUDE_CHANGE = 0.2
# The frequency of a dwell drifts by at most this fraction of the distance to the next dwell; the frequency of a sweep
# drifts more.
_MAX_DRIFT = 0.25
# Dwells take at least this fraction of the time with a signal; otherwise the signal is no stepped sine.
_MIN_DWELL_SHARE = 0.3
# Below this fraction of the median amplitude of the dwells, there is no signal; only noise and hum remain.
_SILENCE_RATIO = 0.05
# Blocks at this distance scatter independently, although neighboring blocks share half of their samples.
_INDEPENDENT_BLOCKS = 2
# A block is steady if no channel deviates from its mean by more than the larger of two limits. One limit is this
# multiple of the channel's scatter.
_STEADY_SIGMAS = 3.0
# The other limit is this fraction of the tolerance.
_STEADY_TOLERANCE_SHARE = 0.1
# The last half of a segment is tested for steady state; if it is not steady, the last quarter.
_FINAL_SHARES = (0.5, 0.25)
# Two dwells have the same frequency if their frequencies differ by less than this fraction: up and down sweeps repeat a
# frequency within this error.
_SAME_FREQUENCY = 2e-4


@dataclass(frozen=True)
class Dwell:
    """The steady samples [first, stop) of a dwell."""

    first: int
    stop: int
    frequency: float  # frequency [periods per sample]
    amplitude: float  # amplitude of the reference, in its unit
    steady: bool  # whether all channels are in steady state


def dwells(tracks: Sequence[Track], tolerance: float) -> list[Dwell]:
    """Return the dwells in order of time; an empty list for other kinds of signals.

    The phase of a sweep is linear for a short time only, and its frequency drifts within a segment. The phase of noise
    is rarely linear. `tolerance` is the largest relative change of a steady amplitude.
    """
    segments = [segment for track in tracks for segment in _segments(track) if not _is_amplitude_changing(segment)]
    # If segments overlap, only the longest is used.
    segments.sort(key=lambda segment: segment.stop_sample - segment.first_sample, reverse=True)
    disjoint: list[Track] = []
    for segment in segments:
        overlaps = (
            kept.first_sample < segment.stop_sample and segment.first_sample < kept.stop_sample for kept in disjoint
        )
        if not any(overlaps):
            disjoint.append(segment)
    disjoint.sort(key=lambda segment: segment.first_sample)
    # The levels of the shortest blocks are used: they average over the fewest samples and therefore resolve all tones.
    if not disjoint or _dwell_share(disjoint, tracks[-1]) < _MIN_DWELL_SHARE:
        return []
    # In a sweep the frequency drifts within a segment as much as from one segment to the next.
    middle_frequency, start_frequency, end_frequency = np.array([_frequencies(segment) for segment in disjoint]).T
    spacing = abs(np.diff(middle_frequency))
    spacing[spacing < _SAME_FREQUENCY * middle_frequency[1:]] = np.inf
    smaller_spacing = np.minimum(np.append(spacing, np.inf), np.insert(spacing, 0, np.inf))
    if np.median(abs(end_frequency - start_frequency) / smaller_spacing) > _MAX_DRIFT:
        return []
    # Between successive dwells at one frequency a controller changed the level. Only the last steady dwell is
    # returned.
    tones: list[Dwell] = []
    for tone in (_measure_dwell(segment, tolerance) for segment in disjoint):
        if not tones or abs(tone.frequency / tones[-1].frequency - 1.0) >= _SAME_FREQUENCY:
            tones.append(tone)
        elif tone.steady or not tones[-1].steady:
            tones[-1] = tone
    return tones


def _is_amplitude_changing(segment: Track) -> bool:
    """Return whether the amplitude changes in the second half."""
    log_amplitude = np.log(segment.amplitude[segment.amplitude.size // 2 :])
    slope = np.polyfit(np.linspace(0.0, 1.0, log_amplitude.size), log_amplitude, 1)[0]
    return bool(abs(slope) > _MAX_AMPLITUDE_CHANGE)


def _frequencies(segment: Track) -> tuple[float, float, float]:
    """Return the frequency (periods per sample) in the middle, at the start and at the end, by a parabola fit."""
    phase = segment.phase
    _, slope, curvature = np.polynomial.polynomial.polyfit(np.linspace(-1.0, 1.0, phase.size), phase, 2)
    scale = 2.0 / ((phase.size - 1) * segment.hop * 2.0 * np.pi)
    return slope * scale, (slope - 2.0 * curvature) * scale, (slope + 2.0 * curvature) * scale


def _segments(track: Track) -> Iterator[Track]:
    """Cut a track into segments of linear phase."""
    if track.number.size < _MIN_BLOCKS:
        return
    is_continuous = (np.diff(track.number) == 1) & (abs(np.diff(np.log(track.amplitude))) < _MAX_AMPLITUDE_STEP)
    is_continuous &= abs(np.diff(track.frequency)) < 1.0 / HOPS_PER_BLOCK
    # Symmetric matrix that yields the residuals of values from a straight line.
    line_basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, _MIN_BLOCKS), 2))[0]
    to_residual = np.eye(_MIN_BLOCKS) - line_basis @ line_basis.T
    for begin, end in runs_of(is_continuous):
        if end + 1 - begin < _MIN_BLOCKS:
            continue
        phase = track.phase[begin : end + 1]
        tolerance = float(np.clip(_MAX_RESIDUAL_SIGMAS * _scatter(phase), _MIN_TOLERANCE_RAD, _MAX_TOLERANCE_RAD))
        windows = np.lib.stride_tricks.sliding_window_view(phase, _MIN_BLOCKS)
        is_linear = abs(windows @ to_residual).max(axis=1) < tolerance
        start = 0
        while start < is_linear.size:
            if not is_linear[start]:
                start += 1
                continue
            # Extend the segment by doubled lengths while its phase is linear, then by halved lengths.
            stop, extension = start + _MIN_BLOCKS, _MIN_BLOCKS
            while extension:
                if stop + extension <= phase.size and _is_linear(phase[start : stop + extension], tolerance):
                    stop, extension = stop + extension, 2 * extension
                else:
                    extension //= 2
            first, last = _constant_range(phase[start:stop])
            if last - first >= _MIN_BLOCKS:
                yield track.part(begin + start + first, begin + start + last)
            start = stop


def _is_linear(phase: Array, tolerance: float) -> bool:
    abscissa = np.linspace(-1.0, 1.0, phase.size)
    slope = float(abscissa @ phase) / float(abscissa @ abscissa)
    return float(abs(phase - phase.mean() - slope * abscissa).max()) < tolerance


def _scatter(phase: Array) -> float:
    """Return the standard deviation of phases [rad], from third differences, which are zero for tones and sweeps."""
    third = np.diff(phase[::_INDEPENDENT_BLOCKS], 3)
    # Normal distribution: the median magnitude is 0.6745 sigma. A third difference has (1 + 9 + 9 + 1) sigma^2.
    return float(np.median(abs(third))) / (0.6745 * 20**0.5) if third.size else 0.0


def _constant_range(phase: Array) -> tuple[int, int]:
    """Return the range of blocks [first, stop) whose phase agrees with the tone in the middle half."""
    size = phase.size
    middle = slice(size // 4, size - size // 4)
    block = np.arange(size)
    deviation = phase - np.polyval(np.polyfit(block[middle], phase[middle], 1), block)
    max_deviation = max(_END_SIGMAS * float(deviation[middle].std()), _END_MIN_RAD)
    outside = np.flatnonzero(abs(deviation) > max_deviation)
    first_half, second_half = outside[outside < size // 2], outside[outside >= size // 2]
    return (int(first_half[-1]) + 1 if first_half.size else 0), (int(second_half[0]) if second_half.size else size)


def _dwell_share(segments: Sequence[Track], track: Track) -> float:
    """Return the total duration of the dwells, relative to the time with a signal."""
    silence = _SILENCE_RATIO * float(np.median([np.median(segment.amplitude) for segment in segments]))
    return sum(segment.stop_sample - segment.first_sample for segment in segments) / (
        track.hop * max(int(np.sum(track.levels > silence)), 1)
    )


def _measure_dwell(segment: Track, tolerance: float) -> Dwell:
    """Return the dwell in a segment, without the transient at the beginning of the segment."""
    amplitude = segment.amplitude
    channels = np.vstack([segment.ratio, (amplitude / np.median(amplitude))[None]])
    channels = channels[np.isfinite(channels).all(axis=1)]
    is_steady, first_steady = False, 0
    for share in _FINAL_SHARES:
        if not is_steady and amplitude.size * share >= _MIN_BLOCKS:
            is_steady, first_steady = _steady_range(channels, round(amplitude.size * (1.0 - share)), tolerance)
    steady = segment.part(first_steady)
    frequency = float(np.polyfit(np.arange(steady.phase.size), steady.phase, 1)[0]) / (2.0 * np.pi * segment.hop)
    return Dwell(steady.first_sample, steady.stop_sample, frequency, float(np.median(steady.amplitude)), is_steady)


def _steady_range(channels: ComplexArray, late_block: int, tolerance: float) -> tuple[bool, int]:
    """Return whether amplitudes, shape (channels, blocks), are steady from `late_block` on, and the first steady block.

    Amplitudes are steady if the means of the two halves after `late_block` agree within the tolerance or the scatter.
    Earlier blocks that agree with the mean of the late blocks are steady too.
    """
    late = channels[:, late_block:]
    mean = late.mean(axis=1, keepdims=True)
    allowed, scatter = tolerance * abs(mean[:, 0]), np.sqrt(np.mean(abs(late - mean) ** 2, axis=1))
    within = abs(channels - mean) <= np.maximum(_STEADY_TOLERANCE_SHARE * allowed, _STEADY_SIGMAS * scatter)[:, None]
    first_steady = int(np.max(np.flatnonzero(~within[:, :late_block].all(axis=0)), initial=-1)) + 1
    half = late.shape[1] // 2
    drift = abs(late[:, :half].mean(axis=1) - late[:, half:].mean(axis=1))
    random_drift = _STEADY_SIGMAS * scatter * np.sqrt(2.0 * _INDEPENDENT_BLOCKS / max(half, 1))
    return bool(np.all(drift <= np.maximum(allowed, random_drift))), first_steady
