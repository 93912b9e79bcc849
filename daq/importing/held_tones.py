"""Where a tone was held: stretches of one frequency, and from where on all channels are steady in each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from daq.importing.signal import Array
from daq.importing.tone_track import HOPS, ComplexArray, Track
from rig.numerics.runs import runs_of

# Fewest blocks of a tone that is held, ten periods and more.
_FEWEST = 7
# What the phase may be off a straight line: so many times its scatter, between these, rad.
_SCATTERS, _LEAST, _MOST = 8.0, 0.02, 0.25
# At its ends a held tone leaves the line of its middle by more than so many times the scatter there, and by this, rad.
_OUT, _OUT_LEAST = 4.0, 0.01
# Change of an amplitude, as log ratio, that ends a tone from one block to the next.
_JUMP = 0.2
# By this, as log ratio, the amplitude of a tone that is held may still change in its second half.
_FADES = 0.2
# A tone that drifts by more than this part of its distance to the next is one that sweeps.
_DRIFT = 0.25
# Of the time in which there is more than silence, tones are held for this part at least.
_SHARE, _SILENCE = 0.3, 0.05
# Blocks that have half their samples in common scatter as if they had none.
_APART = 2
# A settled channel stays within so many times its scatter.
_STEADY = 3.0
# What is left out changes by more than this part of what may still change.
_WELL = 0.1
# What is late in a stretch, as parts of it: the next where the motion still changes in one.
_LATEST = (0.5, 0.25)
# Frequencies that differ by less, relative, are the same tone again.
_SAME = 2e-4


@dataclass(frozen=True)
class HeldTone:
    """A tone that was held.

    Attributes
    ----------
    first, stop : int
        Samples in which it is held and settled.
    frequency : float
        Periods per sample.
    amplitude : float
        Of the reference.
    settled : bool
        Whether all channels are seen to be steady.
    """

    first: int
    stop: int
    frequency: float
    amplitude: float
    settled: bool


def held_tones(tracks: Sequence[Track], tolerance: float) -> list[HeldTone]:
    """Find the tones that were held, one after the other; none where the signal holds something else.

    A tone is held while its phase runs evenly, for ten periods or more. A sweep's phase does so for a while, but its
    frequency moves on just as it does from one such stretch to the next; that of noise does so now and then.

    Parameters
    ----------
    tracks : sequence of Track
        Of one signal, see `ToneTracker`.
    tolerance : float
        Largest change that a settled amplitude still goes through, relative.

    Returns
    -------
    list of HeldTone
        In order of time; they do not overlap.
    """
    found = [piece for track in tracks for piece in _pieces(track) if not piece.fades]
    found.sort(key=lambda piece: piece.first - piece.stop)
    kept: list[_Piece] = []
    for piece in found:
        if all(piece.stop <= other.first or piece.first >= other.stop for other in kept):
            kept.append(piece)
    kept.sort(key=lambda piece: piece.first)
    # The shortest blocks average over the fewest samples: these see all tones.
    if not kept or _share(kept, tracks[-1]) < _SHARE or _sweeps(kept):
        return []
    return _last_ones([_settled(piece, tolerance) for piece in kept])


def _last_ones(tones: Sequence[HeldTone]) -> list[HeldTone]:
    """Of tones of one frequency in a row, between which a controller changed the level, keep the last that settled."""
    kept: list[HeldTone] = []
    for tone in tones:
        again = kept and abs(tone.frequency / kept[-1].frequency - 1.0) < _SAME
        if not again:
            kept.append(tone)
        elif tone.settled or not kept[-1].settled:
            kept[-1] = tone
    return kept


@dataclass(frozen=True)
class _Piece:
    """A stretch of even phase: blocks of a track."""

    track: Track
    begin: int
    """First block, and the one after the last, by their place in the track."""
    end: int

    @property
    def first(self) -> int:
        """Sample in the middle of the first block: what comes before may be another tone."""
        return _middle(self.track, self.begin)

    @property
    def stop(self) -> int:
        return _middle(self.track, self.end - 1)

    @property
    def phase(self) -> Array:
        """Phase, unwrapped, rad."""
        return _unwrapped(self.track, self.begin, self.end)

    @property
    def amplitude(self) -> float:
        return float(np.median(self.track.amplitude[self.begin : self.end]))

    @property
    def fades(self) -> bool:
        """Whether it dies away, or comes up, to its end."""
        late = np.log(self.track.amplitude[(self.begin + self.end) // 2 : self.end])
        slope = np.polyfit(np.linspace(0.0, 1.0, late.size), late, 1)[0]
        return bool(abs(slope) > _FADES)

    def frequencies(self) -> tuple[float, float, float]:
        """Frequency in the middle, and at either end by a parabola through the phase; periods per sample."""
        phase = self.phase
        _, slope, bend = np.polynomial.polynomial.polyfit(np.linspace(-1.0, 1.0, phase.size), phase, 2)
        scale = 2.0 / ((phase.size - 1) * self.track.hop * 2.0 * np.pi)
        return slope * scale, (slope - 2.0 * bend) * scale, (slope + 2.0 * bend) * scale


def _middle(track: Track, block: int) -> int:
    return int((track.number[block] + HOPS / 2) * track.hop)


def _unwrapped(track: Track, begin: int, end: int) -> Array:
    """Phase at successive blocks, whole turns between them added by the frequency of each."""
    phase = track.phase[begin:end]
    frequency = track.frequency[begin:end]
    expected = np.pi * (frequency[1:] + frequency[:-1])
    advance = np.diff(phase)
    advance += 2.0 * np.pi * np.round((expected - advance) / (2.0 * np.pi))
    return np.concatenate([phase[:1], phase[0] + np.cumsum(advance)])


def _pieces(track: Track) -> Iterator[_Piece]:
    """Cut a track into stretches of even phase."""
    if track.number.size < _FEWEST:
        return
    linked = (np.diff(track.number) == 1) & (abs(np.diff(np.log(track.amplitude))) < _JUMP)
    linked &= abs(np.diff(track.frequency)) < 1.0 / HOPS
    for first, last in runs_of(linked):
        if last + 1 - first >= _FEWEST:
            yield from _straight(track, first, last + 1)


def _straight(track: Track, begin: int, end: int) -> Iterator[_Piece]:
    phase = _unwrapped(track, begin, end)
    tolerance = float(np.clip(_SCATTERS * _scatter(phase), _LEAST, _MOST))
    windows = np.lib.stride_tricks.sliding_window_view(phase, _FEWEST)
    even = abs(windows @ _beside_a_line(_FEWEST)).max(axis=1) < tolerance
    at = 0
    while at < even.size:
        if not even[at]:
            at += 1
            continue
        stop, more = at + _FEWEST, _FEWEST
        while more:
            if stop + more <= phase.size and _is_line(phase[at : stop + more], tolerance):
                stop, more = stop + more, 2 * more
            else:
                more //= 2
        first, last = _ends(phase[at:stop])
        if last - first >= _FEWEST:
            yield _Piece(track, begin + at + first, begin + at + last)
        at = stop


def _beside_a_line(size: int) -> Array:
    """Matrix that leaves of values what is beside the straight line through them; symmetric."""
    line = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, size), 2))[0]
    return np.eye(size) - line @ line.T


def _is_line(phase: Array, tolerance: float) -> bool:
    at = np.linspace(-1.0, 1.0, phase.size)
    slope = float(at @ phase) / float(at @ at)
    return float(abs(phase - phase.mean() - slope * at).max()) < tolerance


def _scatter(phase: Array) -> float:
    """Scatter of phases by their third differences, which neither a tone nor a sweep has."""
    third = np.diff(phase[::_APART], 3)
    return float(np.median(abs(third))) / (0.6745 * 20**0.5) if third.size else 0.0


def _ends(phase: Array) -> tuple[int, int]:
    """First block, and the one after the last, that belong to the tone of the middle half."""
    size = phase.size
    middle = slice(size // 4, size - size // 4)
    at = np.arange(size)
    off = phase - np.polyval(np.polyfit(at[middle], phase[middle], 1), at)
    out = np.flatnonzero(abs(off) > max(_OUT * float(off[middle].std()), _OUT_LEAST))
    before, after = out[out < size // 2], out[out >= size // 2]
    return (int(before[-1]) + 1 if before.size else 0), (int(after[0]) if after.size else size)


def _share(pieces: Sequence[_Piece], track: Track) -> float:
    """For how much of the time with a signal a tone is held."""
    silence = _SILENCE * float(np.median([piece.amplitude for piece in pieces]))
    return sum(piece.stop - piece.first for piece in pieces) / (
        track.hop * max(int(np.sum(track.levels > silence)), 1)
    )


def _sweeps(pieces: Sequence[_Piece]) -> bool:
    """Whether the frequency moves within stretches as it does from one to the next."""
    middle, begins, ends = np.array([piece.frequencies() for piece in pieces]).T
    apart = abs(np.diff(middle))
    apart[apart < _SAME * middle[1:]] = np.inf
    nearest = np.minimum(np.append(apart, np.inf), np.insert(apart, 0, np.inf))
    return bool(np.median(abs(ends - begins) / nearest) > _DRIFT)


def _settled(piece: _Piece, tolerance: float) -> HeldTone:
    """Leave out what is seen to settle.

    A channel is settled from where it stays as near to what it is late in the stretch as it is there, and not at all
    where both halves of what is late differ by more than the tolerance, or chance.
    """
    track, blocks = piece.track, slice(piece.begin, piece.end)
    size = track.amplitude[blocks]
    looks = np.vstack([track.ratio[:, blocks], (size / np.median(size))[None]])
    looks = looks[np.isfinite(looks).all(axis=1)]
    steady, begin = False, 0
    for share in _LATEST:
        if not steady and size.size * share >= _FEWEST:
            steady, begin = _steady_from(looks, round(size.size * (1.0 - share)), tolerance)
    frequency = float(np.polyfit(np.arange(size.size - begin), piece.phase[begin:], 1)[0])
    return HeldTone(
        _middle(track, piece.begin + begin),
        piece.stop,
        frequency / (2.0 * np.pi * track.hop),
        float(np.median(size[begin:])),
        steady,
    )


def _steady_from(looks: ComplexArray, late: int, tolerance: float) -> tuple[bool, int]:
    """Return whether amplitudes, shape (channels, blocks), are steady from a block on, and since when."""
    latest = looks[:, late:]
    mean = latest.mean(axis=1, keepdims=True)
    allowed, scatter = tolerance * abs(mean[:, 0]), np.sqrt(np.mean(abs(latest - mean) ** 2, axis=1))
    within = abs(looks - mean) <= np.maximum(_WELL * allowed, _STEADY * scatter)[:, None]
    begin = int(np.max(np.flatnonzero(~within[:, :late].all(axis=0)), initial=-1)) + 1
    half = latest.shape[1] // 2
    drift = abs(latest[:, :half].mean(axis=1) - latest[:, half:].mean(axis=1))
    by_chance = _STEADY * scatter * np.sqrt(2.0 * _APART / max(half, 1))
    return bool(np.all(drift <= np.maximum(allowed, by_chance))), begin
