"""Sudden changes of the gain or the delay of a channel while a tone drives a structure, from the samples.

The amplitude of every channel changes slowly from one period to the next, also in a transient and in a sweep. Over some
periods, a reading is therefore modeled by a tone whose amplitude is quadratic in time, with harmonics and an offset. A
*step* is an instant from which on the readings have to be divided by a ratio to follow this model. Model and ratio are
fitted by least squares for every instant: x are the readings before the instant (0 after it), y the readings after it,
and P removes the part that the model can represent. The ratio g minimizes ``|P x + P y / g|``. A change of the delay
changes the phase of the tone: the model has an additional tone from the instant on, whose amplitude and phase are
fitted. A change of the motion is no step: it is not sudden, and affects other channels as well.

Mean values over groups of samples are searched first, with relaxed limits: few blocks of intact channels remain.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.recordings.slices import read_slices
from analysis.core.responses.checks.channel_changes import MAX_COMMON, MIN_CHANGE
from analysis.core.responses.checks.clean_segments import Flaw, find_flaws
from analysis.core.responses.checks.gain_steps import describe_step, step_warnings
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.response import Response

# Length of a block of samples, in periods of the tone.
_PERIODS = 12.0
# Shortest block [s], and minimum number of its samples.
_MIN_SECONDS = 0.3
_MIN_SAMPLES = 96
# Number of terms for the drift of a reading, such as after power-on of a sensor.
_DRIFT_TERMS = 4
# Highest harmonic of the tone in the model.
_HARMONICS = 3
# This fraction of a block at either end is not searched for steps.
_UNSEARCHED_END_FRACTION = 0.15
# All samples are searched in recordings with at most this number of values; about 0.3 s of CPU time.
_MAX_VALUES = 2_000_000
# A step in the model must reduce the rms residual at least to this fraction of the residual without a step.
_MAX_REMAINING_FRACTION = 0.35
# Largest rms residual over rms reading: of a step of the gain in its model, and of a tone not hidden by noise.
_MAX_REMAINING = 0.1
# A channel is searched in a block if its readings span more than this number of counts of the converter. A smaller
# tone, as at an antiresonance, appears suddenly when it exceeds half a count.
_MIN_COUNTS = 8.0
# Smallest rms residual over rms reading without drift that a step of `MIN_CHANGE` in the searched part of a block
# leaves in the model without a step. The amplitudes of the model are quadratic: they fit a step at 15 % of a block
# worst, except for 0.18 of the step (0.25 in the middle). The factor 0.5 is a margin.
_MIN_RESIDUAL = 0.5 * 0.18 * MIN_CHANGE
# Largest rms residual of another channel with the same step in its model, relative to that without the step.
_MAX_FRACTION_OF_STEP = 0.7
# A block is searched if a step may explain the mean values of groups of samples, of which a period has this number: the
# highest harmonic has five. A step within a group, and noise that the mean values do not contain, change the residuals;
# the limits are therefore relaxed by this factor.
_GROUPS_PER_PERIOD = 16
_GROUP_TOLERANCE = 1.5
# Largest number of readings in the blocks of a steady tone that are searched together: their fits take up to 60 MB.
_BATCH_READINGS = 1 << 18


@dataclass(frozen=True)
class ToneInterval:
    """Samples in which a tone drives the structure."""

    first: int  # sample
    stop: int  # sample after the last
    start: float  # frequency at the first sample [periods per sample]
    slope: float = 0.0  # increase of the frequency of a linear sweep, periods per sample²
    growth: float = 0.0  # increase of the logarithm of the frequency in a logarithmic sweep, per sample

    def frequency(self, offset: int) -> float:
        """Return the frequency at a sample after the first, periods per sample."""
        return self.start * math.exp(self.growth * offset) + self.slope * offset

    def phase(self, offsets: Array | NDArray[np.int64]) -> Array:
        """Return the phase at samples after the first [rad]."""
        periods = np.expm1(self.growth * offsets) / self.growth if self.growth else offsets
        return np.asarray(2.0 * np.pi * (self.start * periods + 0.5 * self.slope * offsets**2))

    @property
    def is_steady(self) -> bool:
        """Whether the frequency is constant."""
        return self.slope == self.growth == 0.0

    def blocks(self, rate: float) -> Iterator[tuple[int, int]]:
        """Yield offset and length of each block of samples."""
        offset = 0
        while True:
            samples = int(max(_PERIODS / self.frequency(offset), _MIN_SECONDS * rate, _MIN_SAMPLES))
            if self.first + offset + samples > self.stop:
                return
            yield offset, samples
            # The searched parts of successive blocks overlap.
            offset += int((1.0 - 3.0 * _UNSEARCHED_END_FRACTION) * samples)


class ToneStep(NamedTuple):
    """Sudden change of the gain of a channel, or of its phase."""

    channel: str
    sample: int
    log_ratio: complex  # logarithm of the complex gain after the step over that before it; real or imaginary
    frequency: float  # Hz


def tone_step_warnings(rec: Recording, intervals: Sequence[ToneInterval], channels: Sequence[str]) -> list[str]:
    """Return a warning for each channel whose gain or delay changes suddenly in one of the intervals."""
    steps: dict[str, ToneStep] = {}
    for step in find_tone_steps(rec, intervals, channels):
        if step.channel not in steps or abs(step.log_ratio) > abs(steps[step.channel].log_ratio):
            steps[step.channel] = step
    return [
        describe_step(name, step.log_ratio, step.frequency, time=f" ({step.sample / rec.rate:.4g} s)")
        for name, step in steps.items()
    ]


def find_tone_steps(rec: Recording, intervals: Sequence[ToneInterval], channels: Sequence[str]) -> Iterator[ToneStep]:
    """Yield steps that occur in one channel only; at least two channels are needed to distinguish steps from motion."""
    if len(channels) < 2:
        return
    infos = [rec.channels[name] for name in channels]
    min_ranges = [0.0 if info.volts_per_count is None else _MIN_COUNTS * info.unit_per_count for info in infos]
    flaws = find_flaws(rec, channels, 0, rec.samples)
    for interval in intervals:
        for offset, samples in _blocks_to_search(rec, interval, channels, flaws):
            first = interval.first + offset
            block = np.stack([rec.read(name, first, first + samples) for name in channels])
            model = _Model(interval.phase(offset + np.arange(samples)))
            yield from (
                ToneStep(channels[row], first + position, log_ratio, interval.frequency(offset) * rec.rate)
                for row, (position, log_ratio) in _steps_of_block(block, model).items()
                if np.ptp(block[row]) > min_ranges[row]
            )


def _blocks_to_search(
    rec: Recording, interval: ToneInterval, channels: Sequence[str], flaws: Sequence[Flaw]
) -> Iterator[tuple[int, int]]:
    """Yield offset and length of each block without flaws whose mean values over groups of samples may have a step."""
    blocks = []
    for offset, samples in interval.blocks(rec.rate):
        first = interval.first + offset
        if not any(flaw.first < first + samples and flaw.stop > first for flaw in flaws):
            blocks.append((offset, samples))
    # The blocks of a steady tone have the same model.
    batch = max(_BATCH_READINGS // (len(channels) * blocks[0][1]), 1) if interval.is_steady and blocks else 1
    for equal in (blocks[row : row + batch] for row in range(0, len(blocks), batch)):
        offset, samples = equal[0]
        size = max(int(1.0 / (interval.frequency(offset) * _GROUPS_PER_PERIOD)), 1)
        count = samples // size
        bounds = [(interval.first + start, interval.first + start + count * size) for start, _ in equal]
        means = [block.reshape(len(channels), count, size).mean(axis=2) for block in read_slices(rec, channels, bounds)]
        model = _Model(interval.phase(offset + size * np.arange(count, dtype=float) + 0.5 * (size - 1)))
        rows = np.concatenate(means)
        is_suspect = np.zeros(len(rows), dtype=np.bool_)
        searched = np.flatnonzero(model.residual(rows) > _MIN_RESIDUAL)
        for fits in model.fits(rows[searched]) if searched.size else ():
            is_suspect[searched] |= fits.are_steps(_GROUP_TOLERANCE).any(axis=0)
        yield from (
            block for block, suspects in zip(equal, is_suspect.reshape(len(equal), -1), strict=True) if suspects.any()
        )


def _steps_of_block(block: Array, model: _Model) -> dict[int, tuple[int, complex]]:
    """Return position and logarithm of the ratio for each row with a step."""
    steps: dict[int, tuple[int, complex]] = {}
    for fits in model.fits(block):
        for row, best in enumerate(np.argmin(fits.remaining, axis=0).tolist()):
            log_ratio = complex(fits.log_ratio[best, row])
            if row in steps or not fits.are_steps()[best, row]:
                continue
            if max(np.delete(fits.steps_at(best), row)) < MAX_COMMON * abs(log_ratio):
                steps[row] = int(model.positions[best]), log_ratio
    return steps


class _Fits(NamedTuple):
    """Fits of a step before each position to each row; residuals are relative to the readings without their drift."""

    residual: Array  # (rows,), without a step
    remaining: Array  # (positions, rows)
    log_ratio: Array | ComplexArray  # (positions, rows)

    def are_steps(self, tolerance: float = 1.0) -> NDArray[np.bool_]:
        """Return whether a step before each position explains each row; `tolerance`: factor that relaxes the limits."""
        limit = tolerance * np.minimum(_MAX_REMAINING_FRACTION * self.residual, _MAX_REMAINING)
        return np.asarray((self.remaining < limit) & (abs(self.log_ratio) >= MIN_CHANGE / tolerance))

    def steps_at(self, index: int) -> Array:
        """Return the magnitude of the logarithm of each ratio at a position; 0 if this does not reduce the residual."""
        is_step = self.remaining[index] < _MAX_FRACTION_OF_STEP * self.residual
        return np.asarray(np.where(is_step, abs(self.log_ratio[index]), 0.0))


class _Model:
    """Model of the readings in a block, in which the tone has a given phase at each sample [rad]."""

    def __init__(self, phase: Array) -> None:
        time = np.linspace(-1.0, 1.0, phase.size)[:, None]
        self._time, self._tone = time, np.stack([np.cos(phase), np.sin(phase)], axis=1)
        harmonics = [part(order * phase) for order in range(2, _HARMONICS + 1) for part in (np.cos, np.sin)]
        terms = [
            time ** np.arange(_DRIFT_TERMS),
            *(time**order * self._tone for order in range(3)),
            np.array(harmonics).T,
        ]
        self._basis, self._triangle = np.linalg.qr(np.concatenate(terms, axis=1))
        margin = int(_UNSEARCHED_END_FRACTION * phase.size)
        self.positions = np.arange(margin, phase.size - margin)

    def residual(self, rows: Array) -> Array:
        """Return the rms residual of each row without a step, relative to the readings without their drift."""
        return _Decomposition.of(rows, self._basis).residual

    def fits(self, rows: Array) -> tuple[_Fits, _Fits]:
        """Fit a step of the gain, and a step of the phase, before each position."""
        parts = _Decomposition.of(rows, self._basis)
        return self._gain_steps(parts), self._phase_steps(parts)

    def _sums_before(self, values: Array) -> Array:
        """Return the sum of the values before each position; the first axis is that of the samples."""
        return np.asarray(np.cumsum(values, axis=0)[self.positions - 1])

    def _gain_steps(self, parts: _Decomposition) -> _Fits:
        power = np.sum(parts.readings**2, axis=0)
        power_before = self._sums_before(parts.readings**2)
        # Squares and product of the projections of both parts on the model.
        projected_before = sum(self._sums_before(parts.readings * term[:, None]) ** 2 for term in self._basis.T)
        product = self._sums_before(parts.readings * parts.fitted) - projected_before
        projected_after = np.sum(parts.coefficients**2, axis=0) - 2.0 * product - projected_before
        square_after = power - power_before - projected_after
        factor = product / np.maximum(square_after, 1e-12 * np.maximum(power, 1e-300))
        remaining = np.maximum(power_before - projected_before - factor * product, 0.0)
        # Squares of the readings without drift, with the factor applied after the step.
        before = self._sums_before(parts.without_drift**2)
        scale = np.maximum(before + factor**2 * (parts.scale - before), 1e-300)
        log_ratio = np.where(factor > 0.0, -np.log(np.maximum(factor, 1e-300)), 0.0)
        return _Fits(parts.residual, np.sqrt(remaining / scale), log_ratio)

    def _phase_steps(self, parts: _Decomposition) -> _Fits:
        """Fit a step of the phase from each position on: a tone is added there."""
        misfit = parts.readings - parts.fitted
        projections, inverse, amplitudes = self._added_tone
        # The sum over all samples is 0, because the tone is part of the model.
        right = -self._sums_before(self._tone[:, :, None] * misfit[:, None])
        change = inverse @ right
        remaining = np.maximum(np.sum(misfit**2, axis=0) - np.sum(right * change, axis=1), 0.0)
        # Amplitudes before the step are those of the terms, quadratic in time, when all terms are fitted together.
        before = amplitudes @ (parts.coefficients - projections @ change)
        complex_before, complex_change = (each[:, 0] - 1j * each[:, 1] for each in (before, change))
        ratio = 1.0 + complex_change / np.where(complex_before == 0.0, 1e-300, complex_before)
        phase = np.angle(ratio)
        # A delay changes the phase, but not the magnitude.
        is_delay = abs(phase) > abs(np.log(np.maximum(abs(ratio), 1e-300)))
        return _Fits(parts.residual, np.sqrt(remaining / parts.scale), np.where(is_delay, 1j * phase, 0.0))

    @cached_property
    def _added_tone(self) -> tuple[Array, Array, Array]:
        """Return for a tone (cosine, sine) from each position on: projections on the model, inverse of the squares.

        The third value multiplied by coefficients is the tone at each position. Shapes: (positions, terms, 2),
        (positions, 2, 2), (positions, 2, terms).
        """
        before = self._sums_before(self._basis[:, :, None] * self._tone[:, None])
        projections = self._basis.T @ self._tone - before
        squares = self._sums_before(self._tone[:, :, None] * self._tone[:, None])
        squares = self._tone.T @ self._tone - squares - projections.mT @ projections
        terms = np.zeros((self.positions.size, 2, self._basis.shape[1]))
        for order in range(3):
            columns = _DRIFT_TERMS + 2 * order + np.arange(2)
            terms[:, [0, 1], columns] = self._time[self.positions] ** order
        inverse = np.linalg.inv(squares + 1e-9 * self._time.size * np.eye(2))
        return projections, inverse, np.asarray(terms @ np.linalg.inv(self._triangle))


class _Decomposition(NamedTuple):
    """Readings of rows, and their fit without a step; shape (samples, rows), coefficients (terms, rows)."""

    readings: Array  # without their mean: a large offset would hide the tone
    coefficients: Array
    fitted: Array
    without_drift: Array
    scale: Array  # sum of squares of the readings without drift

    @classmethod
    def of(cls, rows: Array, basis: Array) -> _Decomposition:
        readings = np.ascontiguousarray((rows - rows.mean(axis=1, keepdims=True)).T)
        coefficients = basis.T @ readings
        without_drift = readings - basis[:, :_DRIFT_TERMS] @ coefficients[:_DRIFT_TERMS]
        scale = np.maximum(np.sum(without_drift**2, axis=0), 1e-300)
        return cls(readings, coefficients, basis @ coefficients, without_drift, scale)

    @property
    def residual(self) -> Array:
        """Rms residual, relative to the readings without drift."""
        return np.asarray(np.sqrt(np.sum((self.readings - self.fitted) ** 2, axis=0) / self.scale))


def sweep_warnings(
    rec: Recording, intervals: Sequence[ToneInterval], channels: Sequence[str], responses: Sequence[Response]
) -> list[list[str]]:
    """Return the warnings of changed gains and delays for each response of a stepped or swept sine.

    In long recordings, the samples are searched only if a curve has a step. A step that appears only in a curve, not in
    the samples, is reported if it may lie between the intervals, or if noise hides the tone in the samples of the
    channel.
    """
    curve_steps = [step_warnings(response, rec.scene.is_linear) for response in responses]
    is_short = rec.samples * len(channels) <= _MAX_VALUES
    if not is_short and not any(curve_steps):
        return curve_steps
    sudden = tone_step_warnings(rec, intervals, channels)
    if sudden or any(later.first > earlier.stop for earlier, later in pairwise(intervals)):
        return [sudden or texts for texts in curve_steps]
    noisy = [name for name in channels if any(map(any, curve_steps)) and _is_noisy(rec, intervals, name)]
    return [[text for text in texts if text.startswith(tuple(noisy))] for texts in curve_steps]


def _is_noisy(rec: Recording, intervals: Sequence[ToneInterval], channel: str) -> bool:
    """Return whether the tone is hidden in the samples of a channel, in the middle of most intervals."""
    residuals = []
    for interval in intervals:
        middle = (interval.stop - interval.first) // 2
        samples = int(max(_PERIODS / interval.frequency(middle), _MIN_SAMPLES))
        first = interval.first + middle - samples // 2
        readings = rec.read(channel, max(first, 0), min(first + samples, rec.samples))
        if np.isfinite(readings).all():
            model = _Model(interval.phase(np.arange(readings.size) + middle - samples // 2))
            residuals.append(float(model.residual(readings[None])[0]))
    return bool(residuals) and float(np.median(residuals)) > _MAX_REMAINING
