"""Lock-in detection: a tone, its harmonics, offset and slope fitted by least squares over whole periods."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import linalg

from rig.arrays import Array, ComplexArray
from rig.errors import RecordingError

# Samples per matrix product; they and the rows of the tones fit into the cache of a core.
_CACHED = 2048


@dataclass(frozen=True)
class ToneFit:
    """Tone, harmonics and residual of one window."""

    frequency: float  # Hz
    # x(t) = offset + slope t + sum_k Re(amplitude[:, k-1] e^{i k w t}), t counted from the window's first
    # sample; complex, shape (channels, harmonics)
    amplitude: ComplexArray
    # fundamental of each part of the window; the scatter of the parts determines the error of `amplitude`;
    # complex, shape (parts, channels)
    parts: ComplexArray
    residual: Array  # root mean square of the residual; shape (channels,)

    def scatter(self) -> ComplexArray:
        """Compute the square-root factor of the fundamentals' covariance from the parts, shape (parts, channels)."""
        count = len(self.parts)
        if count < 2:
            return np.full(self.parts.shape, np.nan, dtype=complex)
        return np.asarray((self.parts - self.parts.mean(axis=0)) / np.sqrt((count - 1.0) * count))


@dataclass(frozen=True)
class _Part:
    """A part of the window: its samples `first` to `first + length`, and the least-squares fit to them alone."""

    first: int
    length: int
    projection: Array  # products of the fitted terms with the samples, shape (terms, channels)
    coefficients: Array  # coefficients of the fit to this part, shape (terms, channels)
    residual: Array  # its sum of squares, shape (channels,)
    ends: Array  # first and last sample, shape (2, channels)


class LockIn:
    """Lock-in detection of a tone and its harmonics, with samples added part by part.

    All parts have a common fit; the deviation of each part from it determines the scatter. Only the normal equations
    are stored, so the memory does not depend on the length of the window.

    >>> t = np.arange(4000) / 5120.0
    >>> lockin = LockIn(10.0, 5120.0, harmonics=3)
    >>> for part in np.split(2.0 * np.cos(2 * np.pi * 10.0 * t - 0.5)[None] + 7.0, 4, axis=1):
    ...     lockin.add(part)
    >>> tone = lockin.tone()
    >>> print(f"{abs(tone.amplitude[0, 0]):.6f}, {np.angle(tone.amplitude[0, 0]):.6f} rad")
    2.000000, -0.500000 rad
    """

    def __init__(self, frequency: float, rate: float, harmonics: int) -> None:
        if 2.0 * frequency >= rate:
            raise RecordingError(
                f"a tone of {frequency:.6g} Hz is not resolved by {rate:.6g} samples a second. Record with "
                f"converter: {{rate: ...}} well above {2.0 * frequency:.6g} Hz."
            )
        # The fit excludes higher harmonics that would alias onto lower harmonics.
        harmonics = max(1, min(harmonics, int(np.ceil(rate / (2.0 * frequency))) - 1))
        self.frequency = frequency
        self.rate = rate
        self.harmonics = harmonics
        self._basis: dict[int, Array] = {}
        self._grams: dict[int, tuple[Array, Array]] = {}
        self._parts: list[_Part] = []
        self._samples = 0

    def add(self, samples: Array) -> None:
        """Add the next part of the window, shape (channels, samples); parts are contiguous."""
        length = samples.shape[1]
        projection = np.zeros((2 * self.harmonics + 2, len(samples)))
        for start, rotation, basis in self._sub_windows(length):
            projection += rotation @ (basis @ samples[:, start : start + basis.shape[1]].T)
        coefficients: Array = np.asarray(np.linalg.solve(self._gram(length)[0], projection), dtype=float)
        squares = np.zeros(len(samples))
        for start, rotation, basis in self._sub_windows(length):
            residual = samples[:, start : start + basis.shape[1]] - (coefficients.T @ rotation) @ basis
            squares += np.einsum("ij,ij->i", residual, residual)
        self._parts.append(_Part(self._samples, length, projection, coefficients, squares, samples[:, [0, -1]].T))
        self._samples += length

    def tone(self) -> ToneFit:
        """Solve for the amplitudes over all parts added so far."""
        size = 2 * self.harmonics + 2
        channels = self._parts[0].projection.shape[1]
        normal, right = np.zeros((size, size)), np.zeros((size, channels))
        to_local = [self._to_local(part.first, part.length) for part in self._parts]
        for matrix, part in zip(to_local, self._parts, strict=True):
            normal += matrix.T @ self._gram(part.length)[0] @ matrix
            right += matrix.T @ part.projection
        solution = linalg.solve(normal, right, assume_a="pos")
        amplitude = (solution[2::2] + 1j * solution[3::2]).T
        parts = np.empty((len(self._parts), channels), dtype=complex)
        squares = np.zeros(channels)
        fits = [matrix @ solution for matrix in to_local]
        edges = [self._edge(fits, number) for number in range(len(fits) + 1)]
        for row, (common, part) in enumerate(zip(fits, self._parts, strict=True)):
            gram, factor = self._gram(part.length)
            # Offset and slope of a single part would be nearly collinear with its tone, and its scatter too large:
            # only the residual of the common fit is fitted by the tones of the part.
            common_residual = (part.projection - gram @ common)[2:]
            for sign, (sample, share) in zip((-1.0, 1.0), edges[row : row + 2], strict=True):
                common_residual += sign * np.outer(self._tones(sample - part.first), share)
            local = np.linalg.solve(gram[2:, 2:], common_residual)
            rotation = np.exp(-2j * np.pi * np.fmod(self.frequency * part.first / self.rate, 1.0))
            parts[row] = amplitude[:, 0] + (local[0] + 1j * local[1]) * rotation
            # Residual of the common fit: residual of the part's own fit, and the difference of the two fits.
            squares += part.residual + np.sum(np.square(factor.T @ (part.coefficients - common)), axis=0)
        return ToneFit(self.frequency, amplitude, parts, np.sqrt(squares / max(self._samples - size, 1)))

    def _edge(self, fits: list[Array], number: int) -> tuple[int, Array]:
        """Return the sample at the edge before a part, and the share (channels,) of its residual that the part lacks.

        The edges of parts are rounded to samples, those of whole periods lie between two. Without this share, each
        part would contain another fraction of the harmonics that are not fitted.
        """
        last = len(self._parts) - 1
        edge = self._parts[number].first if number <= last else self._samples
        period = self.rate / self.frequency
        missing = round(edge / period) * period - edge
        if not 0.0 < abs(missing) <= 0.5:
            return edge, np.zeros(self._parts[0].ends.shape[1])
        after = missing > 0.0 and number <= last
        row = number if after else number - 1
        part = self._parts[row]
        sample = 0 if after else part.length - 1
        fit = np.array([1.0, -1.0 if after else 1.0, *self._tones(sample)]) @ fits[row]
        return part.first + sample, missing * (part.ends[0 if after else 1] - fit)

    def _tones(self, sample: int) -> Array:
        """Return the rows cos k, -sin k of the tones at a sample, shape (2 harmonics,)."""
        angle = 2 * np.pi * np.fmod(np.arange(1, self.harmonics + 1) * self.frequency * sample / self.rate, 1.0)
        return np.column_stack([np.cos(angle), -np.sin(angle)]).ravel()

    def _gram(self, length: int) -> tuple[Array, Array]:
        """Gram matrix of a part's rows 1, slope, cos k, -sin k, and its Cholesky factor; stored by length."""
        if length not in self._grams:
            pieces = (rotation @ basis @ basis.T @ rotation.T for _, rotation, basis in self._sub_windows(length))
            gram = np.asarray(sum(pieces))
            self._grams[length] = gram, np.linalg.cholesky(gram)
        return self._grams[length]

    def _sub_windows(self, length: int) -> Iterator[tuple[int, Array, Array]]:
        """Yield the beginning of each piece of a part, its rows, and the matrix from these to the rows of the part.

        The rows of all pieces are equal except for the slope and a rotation of each tone. The rows of a single piece
        are therefore sufficient for a part of any length.
        """
        for start in range(0, length, _CACHED):
            size = min(_CACHED, length - start)
            rotation = np.eye(2 * self.harmonics + 2)
            # The slope of a part ranges from -1 to 1; that of a piece increases by 1 per sample.
            step = 2.0 / max(length - 1, 1)
            rotation[1, :2] = start * step - 1.0, step
            self._rotate(rotation, start)
            if size not in self._basis:
                sample_numbers, order = np.arange(size), np.arange(1, self.harmonics + 1)
                cycles = np.outer(order, self.frequency / self.rate * sample_numbers)
                tones = np.exp(2j * np.pi * np.fmod(cycles, 1.0))
                basis = np.empty((2 * self.harmonics + 2, size))
                basis[0], basis[1], basis[2::2], basis[3::2] = 1.0, sample_numbers, tones.real, -tones.imag
                self._basis[size] = basis
            yield start, rotation, self._basis[size]

    def _rotate(self, matrix: Array, first: int) -> None:
        """Set the rotation blocks of the tones, from their rows at the first sample to those at another sample."""
        tones, row = self._tones(first), 2 * np.arange(1, self.harmonics + 1)
        cos, minus_sin = tones[::2], tones[1::2]
        matrix[row, row], matrix[row, row + 1] = cos, -minus_sin
        matrix[row + 1, row], matrix[row + 1, row + 1] = minus_sin, cos

    def _to_local(self, first: int, length: int) -> Array:
        """Matrix from the coefficients of the whole window to those of a part from sample `first` on."""
        matrix = np.zeros((2 * self.harmonics + 2,) * 2)
        # The slope of the window begins at 0 and increases by 1 per sample; that of a part ranges from -1 to 1.
        matrix[0, 0] = 1.0
        matrix[0, 1] = (first + (length - 1) / 2) / self._samples
        matrix[1, 1] = (length - 1) / 2 / self._samples
        self._rotate(matrix, first)
        # Coefficients rotate in the opposite direction to their rows.
        matrix[2:, 2:] = matrix[2:, 2:].T.copy()
        return matrix


def parts_of_whole_periods(
    first: int, last: int, frequency: float, rate: float, max_parts: int = 20
) -> list[tuple[int, int]]:
    """Split the window ``[first, last)`` into at most `max_parts` parts of the same whole number of periods each.

    A remainder shorter than a part is discarded. Bounds are rounded to samples. A window shorter than one period is a
    single part.

    >>> parts_of_whole_periods(0, 1000, 10.0, 1000.0, max_parts=4)
    [(0, 300), (300, 600), (600, 900)]
    """
    period = rate / frequency
    periods = int((last - first + 0.5) / period)
    if periods < 1:
        return [(first, last)]
    periods_per_part = -(-periods // max_parts)
    count = periods // periods_per_part
    edges = [first + round(index * periods_per_part * period) for index in range(count + 1)]
    return list(pairwise(edges))
