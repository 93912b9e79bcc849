"""Lock-in detection of a tone in a window of samples.

A tone, its harmonics, an offset and a slope are fitted to the window by least squares. The window is split into *parts*
of whole periods, whose scatter determines the uncertainty.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array, ComplexArray
from rig.core.base.errors import RecordingError

# A window is divided into at most this number of parts; their scatter determines the uncertainty of the mean.
PARTS = 20
# Number of samples per matrix product: they and the terms of the fit are cached in a processor core.
_SAMPLES_PER_PRODUCT = 2048


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
    residual: Array  # sum of squares of the residual of this fit, shape (parts, channels)
    # scalar product of this residual with the square of the slope term, shape (parts, channels)
    curved: Array
    ends: Array  # first and last sample, shape (parts, 2, channels)


class _PartTerms(NamedTuple):
    """Terms of the fit in a part of a given length, in pieces of at most `_SAMPLES_PER_PRODUCT` samples."""

    # first sample of each piece, matrix from its terms to those of the part, and its terms
    pieces: list[tuple[int, Array, Array]]
    gram: Array  # Gram matrix of the terms
    factor: Array  # its Cholesky factor
    square_of_slope: Array  # scalar products of the terms with the square of the slope term


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
        self._basis = np.empty((2 * harmonics + 2, 0))  # terms at the first samples of a piece
        self._part_terms: dict[int, _PartTerms] = {}
        self._parts: list[_Parts] = []
        self._samples = 0

    def add(self, samples: Array, lengths: Sequence[int]) -> None:
        """Add the next parts of the window: their samples, shape (channels, samples), and the length of each part."""
        part_lengths = np.array(lengths)
        stops = np.cumsum(part_lengths)
        firsts, n_terms = stops - part_lengths, 2 * self.harmonics + 2
        projections = np.zeros((len(lengths), n_terms, len(samples)))
        coefficients = np.empty_like(projections)
        squares, curved = np.zeros((2, len(lengths), len(samples)))
        # Parts of equal length are fitted together.
        for length in set(lengths):
            is_equal = part_lengths == length
            parts = np.stack([samples[:, first : first + length] for first in firsts[is_equal]])
            pieces, gram, *_ = self._terms_of(length)
            projection = np.zeros((len(parts), n_terms, len(samples)))
            for start, rotation, basis in pieces:
                projection += rotation @ (basis @ parts[:, :, start : start + basis.shape[1]].mT)
            columns = np.linalg.solve(gram, np.concatenate(list(projection), axis=1))
            fits = columns.reshape(n_terms, len(parts), -1).swapaxes(0, 1)
            residual_squares, products = np.zeros((2, *parts.shape[:2]))
            square_of_slope = np.linspace(-1.0, 1.0, length) ** 2
            for start, rotation, basis in pieces:
                residual = parts[:, :, start : start + basis.shape[1]] - (fits.mT @ rotation) @ basis
                residual_squares += np.einsum("kij,kij->ki", residual, residual)
                products += residual @ square_of_slope[start : start + basis.shape[1]]
            projections[is_equal], coefficients[is_equal] = projection, fits
            squares[is_equal], curved[is_equal] = residual_squares, products
        ends = samples[:, [firsts, stops - 1]].T
        self._parts.append(
            _Parts(self._samples + firsts, part_lengths, projections, coefficients, squares, curved, ends)
        )
        self._samples += samples.shape[1]

    def tone(self) -> ToneFit:
        """Solve for the amplitudes over all parts added so far."""
        n_terms = 2 * self.harmonics + 2
        parts = _Parts(*map(np.concatenate, zip(*self._parts, strict=True)))
        firsts = parts.firsts
        window_to_part = self._window_to_part(firsts, parts.lengths)
        distinct_lengths, index = np.unique(parts.lengths, return_inverse=True)
        terms = map(self._terms_of, distinct_lengths.tolist())
        grams, factors, squares_of_slope = map(np.stack, list(zip(*terms, strict=True))[1:])
        normal_matrix = (window_to_part.mT @ grams[index] @ window_to_part).sum(axis=0)

        def solve(projections: Array) -> tuple[Array, Array]:
            """Solve the common fit; return its coefficients, and their values for the terms of each part."""
            solution = np.linalg.solve(normal_matrix, (window_to_part.mT @ projections).sum(axis=0))
            # The terms of a part are offset, slope, and harmonics with their phase at the first sample of the part.
            return solution, window_to_part @ solution

        # A drift that is not linear, such as the settling of a sensor's bias, would resemble a tone in each part.
        _, with_drift = solve(parts.projections)
        drift, curvature = _drift(parts, self._residual(parts, grams[index], with_drift)[:, 0])
        parts = _without_curvature(parts, curvature, grams, squares_of_slope, index)
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
        # The residual of the common fit is that of the part's own fit plus the difference of the two fits.
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

    def _terms_of(self, length: int) -> _PartTerms:
        """Return the terms of the fit in a part of `length` samples (cached).

        The terms of all pieces are equal except for the slope and a rotation of each harmonic. The terms of a single
        piece are therefore sufficient for a part of any length.
        """
        if length not in self._part_terms:
            starts = np.arange(0, length, _SAMPLES_PER_PRODUCT)
            rotations = np.zeros((starts.size, 2 * self.harmonics + 2, 2 * self.harmonics + 2))
            # The slope of a part ranges from -1 to 1; the slope of a piece increases by 1 per sample.
            step = 2.0 / max(length - 1, 1)
            rotations[:, 0, 0], rotations[:, 1, 0], rotations[:, 1, 1] = 1.0, starts * step - 1.0, step
            self._rotate(rotations, starts)
            lengths = np.diff([*starts, length]).tolist()
            if self._basis.shape[1] < lengths[0]:
                sample_numbers = np.arange(lengths[0])
                tone = np.exp(2j * np.pi * np.fmod(self.frequency / self.rate * sample_numbers, 1.0))
                # The k-th harmonic is the k-th power of the tone (complex exponential).
                tones = np.cumprod(np.broadcast_to(tone, (self.harmonics, lengths[0])), axis=0)
                basis = self._basis = np.empty((2 * self.harmonics + 2, lengths[0]))
                basis[0], basis[1], basis[2::2], basis[3::2] = 1.0, sample_numbers, tones.real, -tones.imag
            pieces = [
                (start, rotation, self._basis[:, :count])
                for start, rotation, count in zip(starts.tolist(), rotations, lengths, strict=True)
            ]
            gram = np.asarray(sum(rotation @ basis @ basis.T @ rotation.T for _, rotation, basis in pieces))
            square = np.linspace(-1.0, 1.0, length) ** 2
            products = [rotation @ (basis @ square[start:][: basis.shape[1]]) for start, rotation, basis in pieces]
            self._part_terms[length] = _PartTerms(pieces, gram, np.linalg.cholesky(gram), np.asarray(sum(products)))
        return self._part_terms[length]

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
    """Estimate constant and slope of the drift in each part, (parts, 2, channels), and of the square of the slope."""
    if len(sums) < 3:
        return np.zeros((len(sums), 2, sums.shape[1])), np.zeros(sums.shape)
    mean, half_lengths = sums / parts.lengths[:, None], (parts.lengths - 1)[:, None] / 2
    centers = parts.firsts + half_lengths[:, 0]
    slope = np.gradient(mean, centers, axis=0, edge_order=2)
    curvature = np.gradient(slope, centers, axis=0) * half_lengths**2 / 2
    # The mean of the square of the slope term, which ranges from -1 to 1, is 1/3.
    return np.stack([mean - curvature / 3, slope * half_lengths], axis=1), curvature


def _without_curvature(
    parts: _Parts, curvature: Array, grams: Array, squares_of_slope: Array, index: NDArray[np.int64]
) -> _Parts:
    """Subtract the square of the slope term, with a factor for each part and channel, from the samples of the parts.

    `grams`, `squares_of_slope`: Gram matrix, and scalar products of the terms with the square, for each distinct
    length; `index`: length of each part.
    """
    fits = np.linalg.solve(grams, squares_of_slope[:, :, None])[:, :, 0]
    squared_norms = [np.sum(np.linspace(-1.0, 1.0, length) ** 4) for length in parts.lengths.tolist()]
    remaining = np.array(squared_norms) - np.sum(fits * squares_of_slope, axis=1)[index]
    return parts._replace(
        projections=parts.projections - squares_of_slope[index, :, None] * curvature[:, None],
        coefficients=parts.coefficients - fits[index, :, None] * curvature[:, None],
        residual=parts.residual - 2.0 * curvature * parts.curved + curvature**2 * remaining[:, None],
    )


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
