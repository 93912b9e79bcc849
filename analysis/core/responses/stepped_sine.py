"""Stepped sine and constant tones: lock-in detection of the tone in every measured window.

A *window* is a measured interval of a tone. A tone, its harmonics, an offset and a slope are fitted to the window by
least squares. Simultaneous tones have the same window; each tone is fitted after the other tones are subtracted. The
window is split into *parts* of whole periods, whose scatter determines the uncertainty. A *sweep* is a pass through the
frequencies at one *level* (nominal amplitude of the force or drive) in one *direction*, up or down.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
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
from analysis.core.responses.spectral_lines import Lines, residual_transient
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError, SceneError
from rig.core.base.progress import CountProgress
from rig.core.results import format_frequencies, format_number
from rig.core.results.response import Response

# Maximum number of fitted harmonics, including the tone.
HARMONICS = 10
# A window is divided into at most this number of parts; their scatter determines the uncertainty of the mean.
PARTS = 20
# A transient below this fraction of the settling tolerance is not detectable in the parts of a window.
_UNDETECTED_TRANSIENT = 0.05
# Reasons for the omission of a window that is too short.
_TOO_SHORT = "shorter than a period of its tone"
_TOO_CLOSE = "shorter than a period of the beat with another tone"
_LENGTHS = (_TOO_SHORT, _TOO_CLOSE)
# Samples per matrix product, so few that they and the terms of the fit are cached in a processor core.
_SAMPLES_PER_PRODUCT = 2048
# A wait for the steady state begins with the transition to its tone, which usually ends within this time [s].
_TRANSITION_S = 0.5


@dataclass(frozen=True)
class ToneFit:
    """Tone, harmonics and residual of one window."""

    frequency: float  # Hz
    # x(t) = offset + slope t + sum_k Re(amplitude[:, k-1] e^{i k w t}), t counted from the window's first
    # sample; complex, shape (channels, harmonics)
    amplitude: ComplexArray
    # amplitude of the tone in each part of the window; complex, shape (parts, channels)
    parts: ComplexArray
    residual: Array  # root mean square of the residual; shape (channels,)
    # lower estimate of the root mean square of noise, which does not repeat from period to period; shape (channels,)
    noise: Array

    def scatter(self) -> ComplexArray:
        """Compute a square-root factor of the covariance of the tone's amplitudes, shape (parts, channels)."""
        count = len(self.parts)
        if count < 2:
            return np.full(self.parts.shape, np.nan, dtype=complex)
        return np.asarray((self.parts - self.parts.mean(axis=0)) / np.sqrt((count - 1.0) * count))


class _Parts(NamedTuple):
    """Successive parts of the window, and a separate least-squares fit to each part."""

    firsts: NDArray[np.int64]  # first sample of each part, shape (parts,)
    lengths: NDArray[np.int64]  # samples of each part, shape (parts,)
    projections: Array  # scalar products of the fitted terms with the samples, shape (parts, terms, channels)
    coefficients: Array  # coefficients of the fit to each part, shape (parts, terms, channels)
    residual: Array  # sum of squares of the residual, shape (parts, channels)
    ends: Array  # first and last sample, shape (parts, 2, channels)


class LockIn:
    """Lock-in detection of a tone and its harmonics, with samples added in one or several parts at a time.

    All parts have a common fit; the deviation of each part from this fit determines the scatter. The normal equations
    of each part are stored, but not its samples. The *terms* of the fit are a constant, a slope, and cosine and
    negative sine of each harmonic. `frequency`: frequency of the tone [Hz]; `rate`: sample rate [Hz]; `harmonics`:
    largest number of harmonics, including the tone.

    >>> t = np.arange(4000) / 5120.0
    >>> lockin = LockIn(10.0, 5120.0, harmonics=3)
    >>> lockin.add(2.0 * np.cos(2 * np.pi * 10.0 * t - 0.5)[None] + 7.0, [1024, 1024, 976, 976])
    >>> tone = lockin.tone()
    >>> print(f"{abs(tone.amplitude[0, 0]):.6f}, {np.angle(tone.amplitude[0, 0]):.6f} rad")
    2.000000, -0.500000 rad
    """

    def __init__(self, frequency: float, rate: float, harmonics: int) -> None:
        if 2.0 * frequency >= rate:
            raise RecordingError(
                f"a tone of {frequency:.6g} Hz cannot be measured at {rate:.6g} samples per second. Record with "
                f"converter: {{rate: ...}} well above {2.0 * frequency:.6g} Hz."
            )
        # The fit excludes higher harmonics that would alias onto lower harmonics.
        harmonics = max(1, min(harmonics, int(np.ceil(rate / (2.0 * frequency))) - 1))
        self.frequency = frequency
        self.rate = rate
        self.harmonics = harmonics
        self._basis: dict[int, Array] = {}
        self._grams: dict[int, tuple[Array, Array]] = {}
        self._rotations: dict[int, Array] = {}
        self._parts: list[_Parts] = []
        self._samples = 0

    def add(self, samples: Array, lengths: Sequence[int]) -> None:
        """Add the next parts of the window: their samples, shape (channels, samples), and the length of each part."""
        part_lengths = np.array(lengths)
        stops = np.cumsum(part_lengths)
        firsts, n_terms = stops - part_lengths, 2 * self.harmonics + 2
        projections = np.zeros((len(lengths), n_terms, len(samples)))
        coefficients = np.empty_like(projections)
        squares = np.zeros((len(lengths), len(samples)))
        # Parts of equal length are fitted together.
        for length in set(lengths):
            is_equal = part_lengths == length
            parts = np.stack([samples[:, first : first + length] for first in firsts[is_equal]])
            pieces = list(self._pieces(length))
            projection = np.zeros((len(parts), n_terms, len(samples)))
            for start, rotation, basis in pieces:
                projection += rotation @ (basis @ parts[:, :, start : start + basis.shape[1]].mT)
            columns = np.linalg.solve(self._gram(length)[0], np.concatenate(list(projection), axis=1))
            fits = columns.reshape(n_terms, len(parts), -1).swapaxes(0, 1)
            residual_squares = np.zeros(parts.shape[:2])
            for start, rotation, basis in pieces:
                residual = parts[:, :, start : start + basis.shape[1]] - (fits.mT @ rotation) @ basis
                residual_squares += np.einsum("kij,kij->ki", residual, residual)
            projections[is_equal], coefficients[is_equal], squares[is_equal] = projection, fits, residual_squares
        ends = samples[:, [firsts, stops - 1]].T
        self._parts.append(_Parts(self._samples + firsts, part_lengths, projections, coefficients, squares, ends))
        self._samples += samples.shape[1]

    def tone(self) -> ToneFit:
        """Solve for the amplitudes over all parts added so far."""
        n_terms = 2 * self.harmonics + 2
        parts = _Parts(*map(np.concatenate, zip(*self._parts, strict=True)))
        firsts = parts.firsts
        window_to_part = self._window_to_part(firsts, parts.lengths)
        distinct_lengths, index = np.unique(parts.lengths, return_inverse=True)
        grams, factors = (
            np.stack(matrices) for matrices in zip(*map(self._gram, distinct_lengths.tolist()), strict=True)
        )
        normal_matrix = (window_to_part.mT @ grams[index] @ window_to_part).sum(axis=0)

        def solve(projections: Array) -> tuple[Array, Array]:
            """Solve the common fit; return its coefficients, and their values for the terms of each part."""
            solution = np.linalg.solve(normal_matrix, (window_to_part.mT @ projections).sum(axis=0))
            # The terms of a part are offset, slope, and harmonics with their phase at the first sample of the part.
            return solution, window_to_part @ solution

        # A drift that is not linear, such as the settling of a sensor's bias, would resemble a tone in each part.
        _, with_drift = solve(parts.projections)
        drift, curvature = _drift(parts, self._residual(parts, grams[index], with_drift)[:, 0])
        squares_of_slope = np.stack([self._square_of_slope(length) for length in distinct_lengths.tolist()])[index]
        parts = parts._replace(projections=parts.projections - squares_of_slope[:, :, None] * curvature[:, None])
        solution, common = solve(parts.projections - grams[index][:, :, :2] @ drift)
        common[:, :2] += drift
        amplitude = (solution[2::2] + 1j * solution[3::2]).T
        # Offset and slope of a single part are nearly collinear with its tone, which would increase the scatter. Only
        # the harmonics of each part are therefore fitted, to the residual of the common fit.
        residual = self._residual(parts, grams[index], common)[:, 1:]
        # Parts of equal length have the same inverse.
        local = np.linalg.inv(grams[:, 2:, 2:])[index] @ residual
        cycles = np.outer(self.frequency * firsts / self.rate, np.arange(1, self.harmonics + 1))
        rotation = np.exp(-2j * np.pi * np.fmod(cycles, 1.0))
        deviations = (local[:, ::2] + 1j * local[:, 1::2]) * rotation[:, :, None]
        amplitudes = amplitude[:, 0] + deviations[:, 0]
        # The residual of the common fit consists of the residual of the part's own fit and the difference of the two
        # fits.
        deviation = factors[index].mT @ (parts.coefficients - common)
        squares = parts.residual.sum(axis=0) + np.sum(np.square(deviation), axis=(0, 1))
        noise_power = np.zeros(len(amplitude))
        residual_power = squares / max(self._samples - n_terms, 1)
        if len(deviations) > 1:
            # The residual contains all harmonics that are not fitted, and these repeat in every period. White noise of
            # the power s² scatters each amplitude of n samples with the variance 4 s²/n. Irregular motion scatters some
            # harmonics more: the harmonic with the least scatter is nearest to the noise.
            least_variance = deviations.var(axis=0, ddof=1).min(axis=0)
            noise_power = np.minimum(least_variance * parts.lengths.mean() / 4.0, residual_power)
        return ToneFit(self.frequency, amplitude, amplitudes, np.sqrt(residual_power), np.sqrt(noise_power))

    def _residual(self, parts: _Parts, grams: Array, fits: Array) -> Array:
        """Return the scalar products of constant and harmonics with the residual of `fits` in each part."""
        residual = np.delete(parts.projections - grams @ fits, 1, axis=1)
        samples, moved = self._edges(parts, fits)
        for sign, edges in ((-1.0, slice(None, -1)), (1.0, slice(1, None))):
            tones = self._tones(samples[edges] - parts.firsts)
            terms = np.column_stack([np.ones(len(tones)), tones])
            residual += sign * terms[:, :, None] * moved[edges, None]
        return residual

    def _edges(self, parts: _Parts, fits: Array) -> tuple[NDArray[np.int64], Array]:
        """Return the sample at each edge of the parts, and the residual that is moved there from one part to the next.

        Whole periods end between two samples, but the ends of parts are rounded to samples. Without this correction,
        the parts would contain different fractions of periods of the harmonics that are not fitted. `fits`:
        coefficients of the common fit for each part. The results have the shapes (parts + 1,) and (parts + 1,
        channels).
        """
        firsts = parts.firsts
        edges = np.append(firsts, self._samples)
        period = self.rate / self.frequency
        missing_samples = np.round(edges / period) * period - edges
        # Whether the sample after the edge is used, which is in the next part, instead of the sample before the edge.
        after = (missing_samples > 0.0) & (np.arange(edges.size) < firsts.size)
        rows = np.arange(edges.size) - ~after
        samples = np.where(after, 0, parts.lengths[rows] - 1)
        ends = parts.ends[rows, np.where(after, 0, 1)]
        terms = np.column_stack([np.ones(edges.size), np.where(after, -1.0, 1.0), self._tones(samples)])
        residual = ends - (terms[:, None] @ fits[rows])[:, 0]
        is_rounded = (np.abs(missing_samples) > 0.0) & (np.abs(missing_samples) <= 0.5)
        return firsts[rows] + samples, np.where(is_rounded[:, None], missing_samples[:, None] * residual, 0.0)

    def _tones(self, samples: NDArray[np.int64]) -> Array:
        """Return the terms (cosine, negative sine) of the harmonics at samples, shape (samples, 2 harmonics)."""
        cycles = np.arange(1, self.harmonics + 1) * self.frequency * samples[:, None] / self.rate
        angle = 2 * np.pi * np.fmod(cycles, 1.0)
        return np.stack([np.cos(angle), -np.sin(angle)], axis=2).reshape(samples.size, -1)

    def _gram(self, length: int) -> tuple[Array, Array]:
        """Return the Gram matrix of the terms in a part of `length` samples, and its Cholesky factor (cached)."""
        if length not in self._grams:
            gram = np.asarray(
                sum(rotation @ basis @ basis.T @ rotation.T for _, rotation, basis in self._pieces(length))
            )
            self._grams[length] = gram, np.linalg.cholesky(gram)
        return self._grams[length]

    def _square_of_slope(self, length: int) -> Array:
        """Return the scalar products of the terms in a part of `length` samples with the square of the slope term."""
        square = np.linspace(-1.0, 1.0, length) ** 2
        return np.asarray(
            sum(
                rotation @ (basis @ square[start : start + basis.shape[1]])
                for start, rotation, basis in self._pieces(length)
            )
        )

    def _pieces(self, length: int) -> Iterator[tuple[int, Array, Array]]:
        """Yield for each piece of a part: first sample, matrix from its terms to those of the part, its terms.

        A piece has at most `_SAMPLES_PER_PRODUCT` samples. The terms of all pieces are equal except for the slope and a
        rotation of each harmonic. The terms of a single piece are therefore sufficient for a part of any length.
        """
        starts = np.arange(0, length, _SAMPLES_PER_PRODUCT)
        if length not in self._rotations:
            rotations = np.zeros((starts.size, 2 * self.harmonics + 2, 2 * self.harmonics + 2))
            # The slope of a part ranges from -1 to 1; the slope of a piece increases by 1 per sample.
            step = 2.0 / max(length - 1, 1)
            rotations[:, 0, 0], rotations[:, 1, 0], rotations[:, 1, 1] = 1.0, starts * step - 1.0, step
            self._rotate(rotations, starts)
            self._rotations[length] = rotations
        for start, rotation in zip(starts.tolist(), self._rotations[length], strict=True):
            piece_length = min(_SAMPLES_PER_PRODUCT, length - start)
            if piece_length not in self._basis:
                sample_numbers = np.arange(piece_length)
                tone = np.exp(2j * np.pi * np.fmod(self.frequency / self.rate * sample_numbers, 1.0))
                # The k-th harmonic is the k-th power of the tone (complex exponential).
                tones = np.cumprod(np.broadcast_to(tone, (self.harmonics, piece_length)), axis=0)
                basis = np.empty((2 * self.harmonics + 2, piece_length))
                basis[0], basis[1], basis[2::2], basis[3::2] = 1.0, sample_numbers, tones.real, -tones.imag
                self._basis[piece_length] = basis
            yield start, rotation, self._basis[piece_length]

    def _rotate(self, matrices: Array, firsts: NDArray[np.int64]) -> None:
        """Set the rotations of the harmonics from terms at the first sample to terms at the samples `firsts`."""
        tones, row = self._tones(firsts), 2 * np.arange(1, self.harmonics + 1)
        cos, minus_sin = tones[:, ::2], tones[:, 1::2]
        matrices[:, row, row], matrices[:, row, row + 1] = cos, -minus_sin
        matrices[:, row + 1, row], matrices[:, row + 1, row + 1] = minus_sin, cos

    def _window_to_part(self, firsts: NDArray[np.int64], lengths: NDArray[np.int64]) -> Array:
        """Return the matrices from coefficients of the window to coefficients of parts that begin at `firsts`."""
        matrices = np.zeros((firsts.size, 2 * self.harmonics + 2, 2 * self.harmonics + 2))
        # The slope of the window begins at 0 and increases by 1 per sample; the slope of a part ranges from -1 to 1.
        matrices[:, 0, 0] = 1.0
        matrices[:, 0, 1] = (firsts + (lengths - 1) / 2) / self._samples
        matrices[:, 1, 1] = (lengths - 1) / 2 / self._samples
        self._rotate(matrices, firsts)
        # Coefficients rotate in the opposite direction of the terms.
        matrices[:, 2:, 2:] = matrices[:, 2:, 2:].mT.copy()
        return matrices


def _drift(parts: _Parts, sums: Array) -> tuple[Array, Array]:
    """Estimate the drift in each part, from the sums of the residual of each part.

    Returns coefficients of constant and slope, shape (parts, 2, channels), and of the square of the slope.
    """
    if len(sums) < 3:
        return np.zeros((len(sums), 2, sums.shape[1])), np.zeros(sums.shape)
    mean, half_lengths = sums / parts.lengths[:, None], (parts.lengths - 1)[:, None] / 2
    centers = parts.firsts + half_lengths[:, 0]
    slope = np.gradient(mean, centers, axis=0, edge_order=2)
    curvature = np.gradient(slope, centers, axis=0) * half_lengths**2 / 2
    # The mean of the square of the slope term, which ranges from -1 to 1, is 1/3.
    return np.stack([mean - curvature / 3, slope * half_lengths], axis=1), curvature


def parts_of_whole_periods(
    first: int, last: int, frequency: float, rate: float, max_parts: int = PARTS
) -> list[tuple[int, int]]:
    """Split the window ``[first, last)`` into at most `max_parts` parts of the same whole number of periods each.

    A remainder shorter than a part is discarded. Ends of parts are rounded to samples. A window shorter than one period
    is a single part.

    >>> parts_of_whole_periods(0, 1000, 10.0, 1000.0, max_parts=4)
    [(0, 300), (300, 600), (600, 900)]
    """
    period = rate / frequency
    periods = int((last - first + 0.5) / period)
    if periods < 1:
        return [(first, last)]
    periods_per_part = -(-periods // max_parts)  # rounded up
    count = periods // periods_per_part
    edges = [first + round(index * periods_per_part * period) for index in range(count + 1)]
    return list(pairwise(edges))


def _batches(parts: Sequence[tuple[int, int]]) -> list[Sequence[tuple[int, int]]]:
    """Group parts that are read together, in bounded memory."""
    size = max(1, PIECE_SAMPLES // max(stop - first for first, stop in parts))
    return [parts[index : index + size] for index in range(0, len(parts), size)]


# Level (N, or the unit of the drive) and direction of a sweep, which identify it.
_SweepKey = tuple[float, str]


class _Point(NamedTuple):
    """Amplitudes of a tone, fitted in a window of samples."""

    tone: ToneFit
    window: tuple[int, int]  # first sample, and one past the last
    steady: bool  # whether steady state was reached


class _Omission(NamedTuple):
    """A measured window whose amplitudes were not estimated."""

    frequency: float  # Hz
    reason: str  # reason without times: equal for all windows with the same flaw
    details: str  # reason with the times of the flaws


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
    points: dict[_SweepKey, list[_Point]] = {}
    omissions: dict[_SweepKey, list[_Omission]] = {}
    windows = []
    for marker in markers:
        stop = rec.samples if marker.last_sample is None else marker.stop
        windows.append((int(marker.first_sample), min(stop, rec.samples)))
    # Frequencies of simultaneous tones, by their common window.
    simultaneous: dict[tuple[int, int], list[float]] = {}
    for marker, window in zip(markers, windows, strict=True):
        simultaneous.setdefault(window, []).append(float(marker.fields["frequency"]))
    batches = [
        _batches(parts_of_whole_periods(*window, float(marker.fields["frequency"]), rec.rate))
        for marker, window in zip(markers, windows, strict=True)
    ]
    batch_samples = read_slices(
        rec,
        names,
        (
            (batch[0][0], batch[-1][1])
            for window, group in zip(windows, batches, strict=True)
            for batch in group
            if len(simultaneous[window]) == 1
        ),
    )
    for n_completed, (marker, (first, stop), group) in enumerate(zip(markers, windows, batches, strict=True), 1):
        frequency = float(marker.fields["frequency"])
        others = [other for other in simultaneous[first, stop] if other != frequency]
        samples: Iterator[Array] = (next(batch_samples) for _ in group)
        if others:  # the samples of this window are read for each of its tones
            samples = read_slices(rec, names, ((batch[0][0], batch[-1][1]) for batch in group))
        key = float(marker.fields.get("level", np.nan)), str(marker.fields.get("direction", "up"))
        window_flaws = find_flaws(rec, names, first, stop)
        if (stop - first) * frequency < 0.99 * rec.rate:
            omissions.setdefault(key, []).append(_Omission(frequency, _TOO_SHORT, _TOO_SHORT))
        elif any((stop - first) * abs(frequency - other) < 0.99 * rec.rate for other in others):
            omissions.setdefault(key, []).append(_Omission(frequency, _TOO_CLOSE, _TOO_CLOSE))
        elif window_flaws:
            reason = ", ".join(dict.fromkeys(flaw.description for flaw in window_flaws))
            omissions.setdefault(key, []).append(_Omission(frequency, reason, describe_flaws(rec, window_flaws)))
        else:
            # Harmonics are fitted below half the sample rate, with at most half as many terms as samples of a part.
            lengths = [[end - begin for begin, end in batch] for batch in group]
            shortest_part = min(map(min, lengths))
            harmonics = int(max(1, min(HARMONICS, 0.45 * rec.rate / frequency, (shortest_part - 2) // 4)))
            lockin = LockIn(frequency, rec.rate, harmonics)
            tones = _tones_at_once(rec, names, (first, stop), [frequency, *others]) if others else None
            for (begin, *_), batch, batch_lengths in zip(group, samples, lengths, strict=True):
                if tones is not None:
                    terms = _terms(others, rec.rate, (first, stop), begin[0], batch.shape[1])
                    batch = batch - tones[4:].T @ terms[2:]
                lockin.add(batch, batch_lengths)
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
    names_of_sweeps = {key: sweep_name(rec, key) if several else "" for key in {**points, **omissions}}
    notes = {key: _notes(name, points.get(key, []), omissions.get(key, [])) for key, name in names_of_sweeps.items()}
    # A sweep without any point is not returned; the first sweep reports its notes.
    notes[next(iter(points))] += [note for key in notes if key not in points for note in notes[key]]
    return [
        _sweep(rec, key, names_of_sweeps[key], _ordered(sweep_points), notes[key], omissions.get(key, []), names)
        for key, sweep_points in points.items()
    ]


def _ordered(points: list[_Point]) -> list[_Point]:
    """Return points in the order of the test, or of ascending frequency if tones were driven simultaneously."""
    if len({point.window for point in points}) == len(points):
        return points
    return sorted(points, key=lambda point: point.tone.frequency)


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
    """Describe level and direction of a sweep; a level of the drive is stated without its unit (V, m or N)."""
    level, direction = key
    test = rec.scene.test
    if test is None or test.held_motion is None:
        name = f"level {format_number(level)}" if rec.scene.level_key == "drive" else f"{format_number(level)} N"
        return f"{name} {direction}"
    unit = test.level_unit(None)
    factor, prefix = (1.0, "") if unit.endswith("^2") else (1e3, "m")  # displacements and velocities are small
    return f"{format_number(factor * level)} {prefix}{unit.replace('^2', '²')} {direction}"


def _notes(sweep_name: str, points: list[_Point], omissions: list[_Omission]) -> list[str]:
    """Describe the discarded frequencies of a sweep, with reasons, and the frequencies without steady-state motion."""
    prefix = f"{sweep_name}: " if sweep_name else ""
    notes = []
    for reason in dict.fromkeys(omission.reason for omission in omissions):
        group = [omission for omission in omissions if omission.reason == reason]
        low, high = (limit(omission.frequency for omission in group) for limit in (min, max))
        cause = f"their windows are {reason}" if reason in _LENGTHS else f"{reason} in their windows"
        if len(group) == 1:
            details = f"its window is {reason}" if reason in _LENGTHS else f"{group[0].details} in its window"
            notes.append(f"{prefix}{low:.4g} Hz omitted: {details}.")
        elif low == high:
            notes.append(f"{prefix}{low:.4g} Hz omitted {len(group)} times: {cause}.")
        else:
            notes.append(f"{prefix}{len(group)} frequencies from {low:.4g} to {high:.4g} Hz omitted: {cause}.")
    if not points:
        notes.append(f"{prefix}no frequency of this sweep is usable.")
    unsteady = [not point.steady for point in points]
    if any(unsteady):
        frequencies = format_frequencies([point.tone.frequency for point in points], unsteady)
        notes.append(
            f"{prefix}No steady state at {frequencies}: these points are marked. Increase test.settle.longest of a "
            "stepped sine, or choose another level."
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
    points: list[_Point],
    notes: list[str],
    omissions: list[_Omission],
    channels: tuple[str, ...],
) -> Sweep:
    """Combine the windows of one level and direction to a sweep."""
    level, direction = key
    tones = tuple(point.tone for point in points)
    mean = np.stack([tone.amplitude[:, 0] for tone in tones], axis=1)
    windows = np.array([point.window for point in points])
    # With moving dampers, the decay of a transient cannot be predicted from the steady responses.
    test = rec.scene.test
    undetected = 0.0 if rec.scene.is_linear or test is None else _UNDETECTED_TRANSIENT * test.accepted_transient
    last_stops = [windows[windows[:, 1] <= first, 1].max(initial=0) for first in windows[:, 0]]
    wait = (windows[:, 0] - np.array(last_stops)) / rec.rate
    lines = Lines(
        channels=channels,
        frequency=np.array([tone.frequency for tone in tones]),
        mean=mean,
        scatter=Scatter(
            stacked([tone.scatter() for tone in tones]), np.array([2.0 * (len(tone.parts) - 1.0) for tone in tones])
        ),
        label=f"{rec.scene.name}{f', {sweep_name}' if sweep_name else ''}",
        warnings=tuple(notes),
        residual_transient=np.maximum(_residual_transients(tones), undetected * abs(mean)),
        resolution=_resolution(rec, channels, mean, np.stack([tone.noise for tone in tones], axis=1)),
        unsteady=np.array([not point.steady for point in points]),
        omitted=np.array([omission.frequency for omission in omissions]),
        wait=wait if rec.scene.is_linear else None,
        duration=np.diff(windows)[:, 0] / rec.rate if rec.scene.is_linear else None,
    )
    return Sweep(lines, tones, level, direction, windows)


def _residual_transients(tones: Sequence[ToneFit]) -> Array:
    """Estimate the maximum error of each tone due to a decaying transient, shape (channels, tones)."""
    counts = np.array([len(tone.parts) for tone in tones])
    transients = np.empty((tones[0].parts.shape[1], len(tones)))
    # Tones with the same number of parts are evaluated together, because a call takes as long for many tones as for
    # one.
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
    """Estimate the response of each requested sweep."""
    return request.compute(sweep.lines for sweep in _selected_sweeps(request))


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
