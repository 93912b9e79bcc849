"""Swept sine: local rational method on the stretch around each frequency in which the tone is near it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.recordings.slices import read_slices
from analysis.responses.clean_stretches import cure, describe_flaws, flaws
from analysis.responses.local_models.local_rational import ORDER
from analysis.responses.local_models.local_spectra import SIDE, LocalSpectra
from analysis.responses.measurands import motion_of, reference_of
from analysis.responses.random_errors import LocalErrors
from analysis.responses.systematic import UNSETTLED, in_counts, scattered, tolerance, tone_gain
from analysis.responses.whole_stretches import dampers_move
from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError
from rig.results.response import MOTIONS, Response

if TYPE_CHECKING:
    from daq.recording.markers import Marker
    from daq.recording.recording import Recording


# A stretch covers at least this frequency ratio of the sweep, which is small enough to exclude the harmonics of a
# nonlinear structure. It is extended by this factor until enough of its lines are excited on either side.
_RATIO, _GROWTH = 1.35, 1.1
_POINTS = 400
# Lines of a spectrum per fitted value: lines of a fit over its number of parameters.
_PER_VALUE = (2 * SIDE + 1) / (3 * ORDER + 2)
# A damper lifts if the downward acceleration of its body exceeds g. Below this part of g it certainly stays on the
# floor.
_RIDES = 0.7
# The sweep is too fast for dampers in flight if more than this share of the lines has more than this relative error;
# `_SLOWER` is the recommended factor for the duration.
_FAST, _FAST_SHARE, _SLOWER = 0.3, 0.05, 10
# The amplitude of readings in counts is evaluated over at least this number of periods.
_FEWEST_PERIODS = 3.0


@dataclass(frozen=True)
class SweptTone:
    """A sweep: at each frequency, the spectra of the stretch in which the tone is near it."""

    spectra: LocalSpectra
    speed: Array  # sweep rate at each frequency, Hz/s; shape (lines,)
    label: str
    warnings: tuple[str, ...]
    # frequencies at which no damper lifts, so that the structure is linear; shape (lines,)
    riding: NDArray[np.bool_]
    shared: float = 1.0  # number of neighbouring frequencies that use the same lines of their spectra

    def frf(
        self, rec: Recording, response: str, reference: str = "force", motion: str = "displacement"
    ) -> Response:
        """Estimate the frequency response with coherence, random and systematic errors."""
        above, below = motion_of(rec, response, motion), reference_of(rec, reference)
        found = self.spectra.frf(rec, above, below, reference, motion, self.label, self.warnings)
        budget = found.uncertainty
        assert isinstance(budget.errors, LocalErrors)
        # Stretches of neighbouring frequencies overlap in time although their bins are counted as independent.
        errors = replace(budget.errors, one_reference=False, shared=self.shared)
        found = replace(found, uncertainty=replace(budget, shared=self.shared, errors=errors))
        if not dampers_move(rec):
            return found
        lag = np.where(self.riding, 0.0, self._lag(found))
        found = found.with_limits({UNSETTLED: lag})
        fast = lag / abs(found.value) > _FAST
        if not np.sum(fast) > _FAST_SHARE * np.sum(lag > 0.0):
            return found
        ends = found.frequency[np.flatnonzero(fast)[[0, -1]]]
        return found.warn(
            f"Between {ends[0]:.4g} and {ends[1]:.4g} Hz this sweep is too fast to reach steady state with dampers in "
            f"flight, so the curve is a transient response there. Sweep {_SLOWER} times slower, or use stepped sine."
        )

    def _lag(self, found: Response) -> Array:
        """Estimate the error of a nonlinear response by the finite sweep rate.

        The response to a sweep differs from the steady-state response by half the sweep rate (in rad/s²) times the
        curvature of the response (J. R. Carson, T. C. Fry, Variable frequency electric circuit theory, Bell System
        Technical Journal 16 (1937) 513-540). The fit corrects this for a linear structure; for a nonlinear structure
        it is a possible error.
        """
        if found.frequency.size < 3:
            return np.full(found.frequency.size, np.inf)
        slope = np.gradient(found.value, found.frequency)
        return np.asarray(self.speed / (4.0 * np.pi) * abs(np.gradient(slope, found.frequency)), dtype=float)


def tracked(
    rec: Recording,
    marker: Marker,
    channels: Sequence[str],
    progress: Callable[[int, int], None] | None = None,
) -> SweptTone:
    """Compute the spectra of a sweep around each frequency, over the stretch in which the tone is near it.

    The transients at the beginning and end of a stretch are part of the fit, so that neither the sweep rate nor the
    length of the stretch limits the resolution. `marker`: the ``measure`` marker of the sweep.
    """
    first = marker.first_sample
    stop = rec.samples if marker.last_sample is None else min(rec.samples, marker.stop)
    names = tuple(channels)
    low, high = sorted(float(marker.fields[key]) for key in ("from", "to"))
    frequency = np.geomspace(low, high, _POINTS)
    bounds = [_stretch(marker, f, rec.rate, first, stop) for f in frequency]
    found = flaws(rec, names, first, stop)
    clean = [
        not any(flaw.first < end and flaw.stop > begin for flaw in found) and end - begin > 4 * SIDE
        for begin, end in bounds
    ]
    notes = []
    if not all(clean):
        notes.append(f"{clean.count(False)} of {_POINTS} frequencies left out: {describe_flaws(rec, found)}.")
    if not any(clean):
        raise RecordingError(
            f"{rec.path}: no part of the sweep can be used ({describe_flaws(rec, found) or 'it is too short'}). "
            f"{cure(rec, found)}, or sweep for longer."
        )
    if marker.fields.get("settled") is False:
        notes.append("The sweep began before steady state at its first frequency. Increase test: settle.")
    order = sorted(np.flatnonzero(clean), key=lambda index: bounds[index])
    around = np.arange(-SIDE, SIDE + 1)
    samples = np.empty((_POINTS, len(names), around.size), dtype=complex)
    at = np.empty((_POINTS, around.size))
    squares = np.empty((len(names), _POINTS))
    ahead = 1 if marker.fields["to"] > marker.fields["from"] else -1
    quiet = []
    blocks = read_slices(rec, names, [bounds[index] for index in order])
    for done, (index, block) in enumerate(zip(order, blocks, strict=True), 1):
        if progress is not None:
            progress(done, len(order))
        size = block.shape[1]
        line = max(int(frequency[index] * size / rec.rate), SIDE + 1)
        # Frequency shift that places the frequency exactly on a line.
        shift = frequency[index] * size / rec.rate - line
        # The noise is read beyond the range and leakage of the tone.
        place = line + ahead * (int(_GROWTH * max((_RATIO**0.5 - 1.0) * line, SIDE)) + 2 * SIDE)
        seen = SIDE < place < size // 2 - SIDE
        beside = np.arange(place - SIDE - 1, place + SIDE + 2) if seen else np.zeros(0, dtype=np.int64)
        lines = np.concatenate([line + around, beside])
        spectrum = at_lines(block - block.mean(axis=1, keepdims=True), lines, shift)
        samples[index] = spectrum[:, : around.size]
        at[index] = frequency[index] + around * rec.rate / size
        begin, width = bounds[index][0], SIDE * rec.rate / size
        # A logarithmic sweep has only positive frequencies.
        ends = [max(frequency[index] + off, 1e-6 * frequency[index]) for off in (-width, width)]
        near = [first + _passes(marker, end, rec.rate) - begin for end in ends]
        squares[:, index] = _near(block, near, rec.rate / frequency[index]).var(axis=1)
        if seen:
            noise = _noise(spectrum[:, around.size :]) / size
            quiet.append((at[index, SIDE] + (place - line) * rec.rate / size, *noise))
    kept, lengths = np.array(sorted(order)), np.array([end - begin for begin, end in bounds])
    noise = _interpolated(quiet, frequency[kept], len(names))
    # The smallest noise over all frequencies determines the randomization of the rounding error.
    counts = in_counts(rec, names, noise.min(axis=1))
    gain = scattered(counts)[:, None] * tone_gain(in_counts(rec, names, squares[:, kept]))
    spectra = LocalSpectra(
        names,
        np.moveaxis(samples[kept], 0, 1).reshape(1, len(names), -1),
        np.ones((1, kept.size * around.size), dtype=complex),
        at[kept].ravel(),
        np.arange(kept.size) * around.size + SIDE,
        SIDE,
        1.0,
        gain,
        noise * lengths[kept],
        np.zeros((len(names), len(names))),
    )
    speed = abs(np.gradient(frequency, [_passes(marker, f, rec.rate) / rec.rate for f in frequency]))
    shared = max(float(np.median(_PER_VALUE * rec.rate / lengths / np.gradient(frequency))), 1.0)
    riding = _riding(rec, names, frequency[kept], squares[:, kept])
    return SweptTone(spectra, speed[kept], rec.scene.name, tuple(notes), riding, shared)


def _riding(rec: Recording, names: Sequence[str], frequency: Array, squares: Array) -> NDArray[np.bool_]:
    """Frequencies at which no damper lifts, from the mean squares of the channels on their bodies."""
    riding = np.ones(frequency.size, dtype=bool)
    infos = [rec.channels[name] for name in names]
    for damper in rec.scene.dampers:
        largest = np.full(frequency.size, np.inf)
        for info, square in zip(infos, squares, strict=True):
            if info.at != f"body {damper.body}" or info.quantity not in MOTIONS:
                continue
            order = 2 - MOTIONS.index(info.quantity)
            size = (2.0 * square) ** 0.5 / abs(info.response(frequency)) * (2 * np.pi * frequency) ** order
            largest = np.minimum(largest, size * (1.0 + tolerance(info)))
        riding &= damper.locked | (largest < _RIDES * rec.scene.gravity)
    return riding


def _stretch(marker: Marker, frequency: float, rate: float, first: int, stop: int) -> tuple[int, int]:
    """Return the first and one-past-last sample of the stretch around a frequency."""
    ratio = _RATIO
    while True:
        edges = frequency / ratio**0.5, frequency * ratio**0.5
        ends = sorted(first + _passes(marker, edge, rate) for edge in edges)
        begin, end = max(first, int(ends[0])), min(stop, int(ends[1]))
        driven = (ratio**0.5 - 1.0) * frequency * (end - begin) / rate
        if driven >= SIDE or (begin == first and end == stop):
            return begin, end
        ratio *= _GROWTH


def at_lines(block: Array, lines: NDArray[np.int64], shift: float) -> ComplexArray:
    """Compute a few lines of the frequency-shifted spectrum of a long stretch.

    The stretch is folded into rows and multiplied by a small matrix of phases, much faster than a whole transform.
    `block` has the shape (channels, samples); `shift`: frequency shift above each line, in lines.

    >>> block = np.random.default_rng(1).standard_normal((1, 1000))
    >>> moved = np.fft.fft(block * np.exp(-2j * np.pi * 0.3 / 1000 * np.arange(1000)))
    >>> np.allclose(at_lines(block, np.array([3, 80]), 0.3), moved[:, [3, 80]], rtol=1e-12)
    True
    """
    size = block.shape[1]
    columns = max(1, int(size**0.5))
    rows = size // columns

    def turn(at: NDArray[np.int64]) -> ComplexArray:
        # Integer arithmetic keeps the phase of late samples as exact as that of early samples.
        return np.exp(-2j * np.pi * (np.outer(lines, at) % size + shift * at) / size)

    far, near = turn(columns * np.arange(rows)), turn(np.arange(columns))
    parts = np.concatenate([far.real, far.imag])
    found = []
    for row in block:
        real, imaginary = np.split(parts @ row[: rows * columns].reshape(rows, columns), 2)
        found.append(np.sum((real + 1j * imaginary) * near, axis=1))
    rest = np.arange(rows * columns, size)
    return np.array(found) + block[:, rest] @ turn(rest).T


def _noise(near: ComplexArray) -> Array:
    """Estimate the noise power of each channel from lines without excitation or leakage."""
    windowed = 0.5 * near[:, 1:-1] - 0.25 * (near[:, :-2] + near[:, 2:])
    # A Hann window reduces the power to 3/8; the median of the power is ln 2 of its mean and excludes hum.
    return np.asarray(np.median(abs(windowed) ** 2, axis=1) / (0.375 * np.log(2.0)))


def _interpolated(quiet: Sequence[tuple[float, ...]], frequency: Array, channels: int) -> Array:
    """Interpolate the noise of each channel between the frequencies of its estimates; constant beyond them."""
    if not quiet:
        return np.zeros((channels, frequency.size))
    at, *power = np.array(sorted(quiet)).T
    smooth = [scipy.ndimage.uniform_filter1d(row, 2 * SIDE + 1, mode="nearest") for row in power]
    return np.array([np.interp(frequency, at, row) for row in smooth])


def _near(block: Array, ends: Sequence[float], period: float) -> Array:
    """Return the samples between two positions of a stretch, or a few periods about their middle if longer.

    The readings may be far larger in other parts of the stretch.
    """
    middle, half = sum(ends) / 2.0, max(abs(ends[1] - ends[0]) / 2.0, _FEWEST_PERIODS / 2.0 * period)
    return block[:, max(int(middle - half), 0) : max(int(middle + half), int(period)) + 1]


def _passes(marker: Marker, frequency: float, rate: float) -> float:
    """Sample number, from the beginning of the sweep, at which the sweep reaches a frequency."""
    low, high, duration = (float(marker.fields[key]) for key in ("from", "to", "duration"))
    if marker.fields.get("spacing") == "linear":
        return (frequency - low) / (high - low) * duration * rate
    return float(np.log(frequency / low) / np.log(high / low) * duration * rate)
