"""Detect held tones in a track of frequency and phase (see `tone_track`), and their part in steady state.

A held tone is a tone of constant frequency, so that its phase is linear in time. Segments of a track are extended as
long as a straight line fits their phase, and rejected if the frequency drifts as in a sweep.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from daq.importing.tone_track import HOPS_PER_BLOCK, Track
from rig.arrays import Array, ComplexArray
from rig.numerics.runs import runs_of

# Minimum number of blocks of a held tone: about ten periods.
_MIN_BLOCKS = 7
# Largest deviation of the phase from a straight line: a multiple of its scatter, within two bounds.
_MAX_RESIDUAL_SIGMAS = 8.0
_MIN_TOLERANCE_RAD = 0.02
_MAX_TOLERANCE_RAD = 0.25
# Deviation from the line through the middle half at which a tone ends: a multiple of the scatter, and a lower bound.
_END_SIGMAS = 4.0
_END_MIN_RAD = 0.01
# Change of the amplitude from one block to the next that ends a tone, as natural logarithm of the ratio.
_MAX_AMPLITUDE_STEP = 0.2
# Largest change of the amplitude in the second half of a held tone, as natural logarithm of the ratio.
_MAX_AMPLITUDE_CHANGE = 0.2
# Largest drift of the frequency within a tone, as a share of the distance to the next tone; a sweep drifts more.
_MAX_DRIFT = 0.25
# Minimum share of held tones in the time with a signal.
_MIN_HELD_SHARE = 0.3
# Largest level without a signal, as a ratio to the amplitude of the held tones.
_SILENCE_RATIO = 0.05
# Distance at which blocks scatter independently, although they share half of their samples.
_INDEPENDENT_BLOCKS = 2
# Largest deviation of a settled channel from its mean, as a multiple of its scatter.
_STEADY_SIGMAS = 3.0
# Share of the tolerance within which samples count as settled.
_SETTLED_TOLERANCE_SHARE = 0.1
# Shares of a segment, at its end, that are tested for steady state; the second only if the first is not steady.
_LATE_SHARES = (0.5, 0.25)
# Relative difference of frequency below which two tones are the same.
_SAME_FREQUENCY = 2e-4


@dataclass(frozen=True)
class HeldTone:
    """A held tone: its settled samples [first, stop), frequency (periods per sample), and amplitude of the reference.

    `settled` states whether all channels are steady.
    """

    first: int
    stop: int
    frequency: float
    amplitude: float
    settled: bool


def held_tones(tracks: Sequence[Track], tolerance: float) -> list[HeldTone]:
    """Return the tones that were held one after the other, in order of time; an empty list for other kinds of signals.

    The phase of a held tone is linear in time for ten periods or more. The phase of a sweep is linear for a short time
    only, and its frequency drifts within a segment. The phase of noise is rarely linear.
    `tolerance` is the largest relative change of a settled amplitude.
    """
    intervals = [
        interval for track in tracks for interval in _tone_intervals(track) if not interval.is_amplitude_changing
    ]
    intervals.sort(key=lambda interval: interval.first - interval.stop)
    disjoint: list[_ToneInterval] = []
    for interval in intervals:
        if all(interval.stop <= other.first or interval.first >= other.stop for other in disjoint):
            disjoint.append(interval)
    disjoint.sort(key=lambda interval: interval.first)
    # The levels of the shortest blocks are used: they average over the fewest samples and therefore resolve all tones.
    if not disjoint or _held_share(disjoint, tracks[-1]) < _MIN_HELD_SHARE:
        return []
    # In a sweep the frequency drifts within a segment as much as from one segment to the next.
    middle_frequency, start_frequency, end_frequency = np.array([interval.frequencies() for interval in disjoint]).T
    distance = abs(np.diff(middle_frequency))
    distance[distance < _SAME_FREQUENCY * middle_frequency[1:]] = np.inf
    nearest = np.minimum(np.append(distance, np.inf), np.insert(distance, 0, np.inf))
    if np.median(abs(end_frequency - start_frequency) / nearest) > _MAX_DRIFT:
        return []
    # Between successive tones of one frequency a controller changed the level. The last settled tone is measured.
    tones: list[HeldTone] = []
    for tone in (_settled(interval, tolerance) for interval in disjoint):
        if not tones or abs(tone.frequency / tones[-1].frequency - 1.0) >= _SAME_FREQUENCY:
            tones.append(tone)
        elif tone.settled or not tones[-1].settled:
            tones[-1] = tone
    return tones


@dataclass(frozen=True)
class _ToneInterval:
    """Successive blocks of a track whose phase is linear in time."""

    track: Track
    begin: int  # first block, by its position in the track
    end: int  # block after the last one

    def middle(self, block: int) -> int:
        """Return the number of the sample in the middle of a block."""
        return int((self.track.number[block] + HOPS_PER_BLOCK / 2) * self.track.hop)

    @property
    def first(self) -> int:
        """Sample in the middle of the first block, before which another tone may be held."""
        return self.middle(self.begin)

    @property
    def stop(self) -> int:
        return self.middle(self.end - 1)

    @property
    def phase(self) -> Array:
        """Unwrapped phase of each block, rad."""
        return _unwrapped(self.track, self.begin, self.end)

    @property
    def amplitude(self) -> float:
        return float(np.median(self.track.amplitude[self.begin : self.end]))

    @property
    def is_amplitude_changing(self) -> bool:
        """Whether the amplitude changes in the second half."""
        log_amplitude = np.log(self.track.amplitude[(self.begin + self.end) // 2 : self.end])
        slope = np.polyfit(np.linspace(0.0, 1.0, log_amplitude.size), log_amplitude, 1)[0]
        return bool(abs(slope) > _MAX_AMPLITUDE_CHANGE)

    def frequencies(self) -> tuple[float, float, float]:
        """Frequency in the middle, and at either end by a parabola through the phase; periods per sample."""
        phase = self.phase
        _, slope, curvature = np.polynomial.polynomial.polyfit(np.linspace(-1.0, 1.0, phase.size), phase, 2)
        scale = 2.0 / ((phase.size - 1) * self.track.hop * 2.0 * np.pi)
        return slope * scale, (slope - 2.0 * curvature) * scale, (slope + 2.0 * curvature) * scale


def _unwrapped(track: Track, begin: int, end: int) -> Array:
    """Return the phase of successive blocks (rad), unwrapped by the frequency in each."""
    phase = track.phase[begin:end]
    frequency = track.frequency[begin:end]
    expected = np.pi * (frequency[1:] + frequency[:-1])
    advance = np.diff(phase)
    advance += 2.0 * np.pi * np.round((expected - advance) / (2.0 * np.pi))
    return np.concatenate([phase[:1], phase[0] + np.cumsum(advance)])


def _tone_intervals(track: Track) -> Iterator[_ToneInterval]:
    """Cut a track into segments of linear phase."""
    if track.number.size < _MIN_BLOCKS:
        return
    is_continuous = (np.diff(track.number) == 1) & (abs(np.diff(np.log(track.amplitude))) < _MAX_AMPLITUDE_STEP)
    is_continuous &= abs(np.diff(track.frequency)) < 1.0 / HOPS_PER_BLOCK
    # Symmetric matrix from values to their residuals from a straight line.
    line_basis = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, _MIN_BLOCKS), 2))[0]
    to_residual = np.eye(_MIN_BLOCKS) - line_basis @ line_basis.T
    for begin, end in runs_of(is_continuous):
        if end + 1 - begin < _MIN_BLOCKS:
            continue
        phase = _unwrapped(track, begin, end + 1)
        tolerance = float(np.clip(_MAX_RESIDUAL_SIGMAS * _scatter(phase), _MIN_TOLERANCE_RAD, _MAX_TOLERANCE_RAD))
        windows = np.lib.stride_tricks.sliding_window_view(phase, _MIN_BLOCKS)
        is_linear = abs(windows @ to_residual).max(axis=1) < tolerance
        start = 0
        while start < is_linear.size:
            if not is_linear[start]:
                start += 1
                continue
            # Extend the segment by growing steps, then by shrinking ones.
            stop, extension = start + _MIN_BLOCKS, _MIN_BLOCKS
            while extension:
                if stop + extension <= phase.size and _is_linear(phase[start : stop + extension], tolerance):
                    stop, extension = stop + extension, 2 * extension
                else:
                    extension //= 2
            first, last = _constant_range(phase[start:stop])
            if last - first >= _MIN_BLOCKS:
                yield _ToneInterval(track, begin + start + first, begin + start + last)
            start = stop


def _is_linear(phase: Array, tolerance: float) -> bool:
    abscissa = np.linspace(-1.0, 1.0, phase.size)
    slope = float(abscissa @ phase) / float(abscissa @ abscissa)
    return float(abs(phase - phase.mean() - slope * abscissa).max()) < tolerance


def _scatter(phase: Array) -> float:
    """Return the standard deviation of phases (rad), from third differences, which are zero for tones and sweeps."""
    third = np.diff(phase[::_INDEPENDENT_BLOCKS], 3)
    return float(np.median(abs(third))) / (0.6745 * 20**0.5) if third.size else 0.0


def _constant_range(phase: Array) -> tuple[int, int]:
    """Return the range of blocks [first, stop) whose phase agrees with the tone in the middle half."""
    size = phase.size
    middle = slice(size // 4, size - size // 4)
    block = np.arange(size)
    deviation = phase - np.polyval(np.polyfit(block[middle], phase[middle], 1), block)
    limit = max(_END_SIGMAS * float(deviation[middle].std()), _END_MIN_RAD)
    outside = np.flatnonzero(abs(deviation) > limit)
    first_half, second_half = outside[outside < size // 2], outside[outside >= size // 2]
    return (int(first_half[-1]) + 1 if first_half.size else 0), (int(second_half[0]) if second_half.size else size)


def _held_share(intervals: Sequence[_ToneInterval], track: Track) -> float:
    """Return the share of the time with a signal in which a tone is held."""
    silence = _SILENCE_RATIO * float(np.median([interval.amplitude for interval in intervals]))
    return sum(interval.stop - interval.first for interval in intervals) / (
        track.hop * max(int(np.sum(track.levels > silence)), 1)
    )


def _settled(interval: _ToneInterval, tolerance: float) -> HeldTone:
    """Return the tone of a segment without the transient at its beginning."""
    track, blocks = interval.track, slice(interval.begin, interval.end)
    amplitude = track.amplitude[blocks]
    channels = np.vstack([track.ratio[:, blocks], (amplitude / np.median(amplitude))[None]])
    channels = channels[np.isfinite(channels).all(axis=1)]
    steady, begin = False, 0
    for share in _LATE_SHARES:
        if not steady and amplitude.size * share >= _MIN_BLOCKS:
            steady, begin = _steady_range(channels, round(amplitude.size * (1.0 - share)), tolerance)
    frequency = float(np.polyfit(np.arange(amplitude.size - begin), interval.phase[begin:], 1)[0])
    return HeldTone(
        interval.middle(interval.begin + begin),
        interval.stop,
        frequency / (2.0 * np.pi * track.hop),
        float(np.median(amplitude[begin:])),
        steady,
    )


def _steady_range(channels: ComplexArray, late_block: int, tolerance: float) -> tuple[bool, int]:
    """Return whether amplitudes, shape (channels, blocks), are steady from `late_block` on, and the first steady block.

    They are steady if the means of the halves after `late_block` agree within the tolerance or the scatter. Earlier
    blocks that agree with the mean of the late blocks belong to the steady state.
    """
    latest = channels[:, late_block:]
    mean = latest.mean(axis=1, keepdims=True)
    allowed, scatter = tolerance * abs(mean[:, 0]), np.sqrt(np.mean(abs(latest - mean) ** 2, axis=1))
    within = abs(channels - mean) <= np.maximum(_SETTLED_TOLERANCE_SHARE * allowed, _STEADY_SIGMAS * scatter)[:, None]
    begin = int(np.max(np.flatnonzero(~within[:, :late_block].all(axis=0)), initial=-1)) + 1
    half = latest.shape[1] // 2
    drift = abs(latest[:, :half].mean(axis=1) - latest[:, half:].mean(axis=1))
    by_chance = _STEADY_SIGMAS * scatter * np.sqrt(2.0 * _INDEPENDENT_BLOCKS / max(half, 1))
    return bool(np.all(drift <= np.maximum(allowed, by_chance))), begin
