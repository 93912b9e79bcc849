"""Sudden changes of the gain or the delay of a channel while a tone drives a structure, from the samples.

The amplitude of every channel changes slowly from one period to the next, also in a transient and in a sweep. Over some
periods, a reading is therefore modeled by a tone whose amplitude is quadratic in time, with harmonics and an offset. A
*step* is an instant from which on the readings have to be divided by a ratio to follow this model. Model and ratio are
fitted by least squares for every instant: x are the readings before the instant (0 after it), y the readings after it,
and P removes the part that the model can represent. The ratio g minimizes ``|P x + P y / g|``. A change of the delay
changes the phase of the tone: the model has an additional tone from the instant on, whose amplitude and phase are
fitted. A change of the motion is no step: it is not sudden, and affects other channels as well.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.core.responses.checks.channel_changes import describe_change, describe_delay
from analysis.core.responses.checks.clean_segments import find_flaws
from analysis.core.responses.checks.gain_steps import step_warnings
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results import format_number
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
# This fraction of a block is not searched at either end.
_UNSEARCHED_END_FRACTION = 0.15
# All samples are searched in recordings with at most this number of values; about 0.3 s of CPU time.
_MAX_VALUES = 2_000_000
# A step in the model must reduce the rms residual at least to this fraction of the residual without a step.
_MAX_REMAINING_FRACTION = 0.35
# Largest rms residual over rms reading: of a step of the gain in its model, and of a tone not hidden by noise.
_MAX_REMAINING = 0.1
# Smallest reported change of the logarithm of a gain, and of a phase [rad].
_MIN_CHANGE = 0.1
# Largest fraction of this change that another channel may show at the same instant.
_MAX_COMMON = 0.25
# A channel is searched in a block if its readings span more than this number of counts of the converter. A smaller
# tone, as at an antiresonance, appears suddenly when it exceeds half a count.
_MIN_COUNTS = 8.0
# Smallest rms residual over rms reading without drift that a step of `_MIN_CHANGE` in the searched part of a block
# leaves in the model without a step. The amplitudes of the model are quadratic: they fit a step at 15 % of a block
# worst, except for 0.18 of the step (0.25 in the middle). The factor 0.5 is a margin.
_MIN_RESIDUAL = 0.5 * 0.18 * _MIN_CHANGE
# Largest rms residual of another channel with the same step in its model, relative to that without the step.
_MAX_FRACTION_OF_STEP = 0.7


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

    def phase(self, offsets: NDArray[np.int64]) -> Array:
        """Return the phase at samples after the first [rad]."""
        periods = np.expm1(self.growth * offsets) / self.growth if self.growth else offsets
        return np.asarray(2.0 * np.pi * (self.start * periods + 0.5 * self.slope * offsets**2))


class ToneStep(NamedTuple):
    """Sudden change of the gain of a channel, or of its phase."""

    channel: str
    sample: int
    log_ratio: complex  # logarithm of the complex gain after the step over that before it; real or imaginary
    frequency: float  # Hz

    def describe(self, rate: float) -> str:
        """Describe the step; `rate`: samples per second."""
        place = f"{format_number(float(f'{self.frequency:.3g}'))} Hz ({self.sample / rate:.4g} s)"
        if self.log_ratio.imag:
            delay = -self.log_ratio.imag / (2.0 * np.pi * self.frequency)
            return describe_delay(self.channel, delay, place, period=1.0 / self.frequency)
        return describe_change(self.channel, float(np.exp(self.log_ratio.real)), place)


def tone_step_warnings(rec: Recording, intervals: Sequence[ToneInterval], channels: Sequence[str]) -> list[str]:
    """Return a warning for each channel whose gain or delay changes suddenly in one of the intervals."""
    steps: dict[str, ToneStep] = {}
    for step in find_tone_steps(rec, intervals, channels):
        if step.channel not in steps or abs(step.log_ratio) > abs(steps[step.channel].log_ratio):
            steps[step.channel] = step
    return [step.describe(rec.rate) for step in steps.values()]


def find_tone_steps(rec: Recording, intervals: Sequence[ToneInterval], channels: Sequence[str]) -> Iterator[ToneStep]:
    """Yield steps that occur in one channel only; at least two channels are needed to distinguish steps from motion."""
    if len(channels) < 2:
        return
    infos = [rec.channels[name] for name in channels]
    min_ranges = [0.0 if info.volts_per_count is None else _MIN_COUNTS * info.unit_per_count for info in infos]
    for interval in intervals:
        offset = 0
        while True:
            frequency = interval.frequency(offset)
            samples = int(max(_PERIODS / frequency, _MIN_SECONDS * rec.rate, _MIN_SAMPLES))
            first = interval.first + offset
            if first + samples > interval.stop:
                break
            if not find_flaws(rec, channels, first, first + samples):
                block = np.stack([rec.read(name, first, first + samples) for name in channels])
                phase = interval.phase(offset + np.arange(samples))
                yield from (
                    ToneStep(channels[row], first + position, log_ratio, frequency * rec.rate)
                    for row, (position, log_ratio) in _steps_of_block(block, phase).items()
                    if np.ptp(block[row]) > min_ranges[row]
                )
            # The searched parts of successive blocks overlap.
            offset += int((1.0 - 3.0 * _UNSEARCHED_END_FRACTION) * samples)


def _steps_of_block(block: Array, phase: Array) -> dict[int, tuple[int, complex]]:
    """Return position and logarithm of the ratio for each row with a step."""
    terms = _model(phase)
    model, triangle = np.linalg.qr(terms)
    margin = int(_UNSEARCHED_END_FRACTION * block.shape[1])
    positions = np.arange(margin, block.shape[1] - margin)
    # The offset is removed, because a large offset would hide the tone.
    rows = [row - row.mean() for row in block]
    steps: dict[int, tuple[int, complex]] = {}
    residuals = [_residual(row, model) for row in rows]
    if max(residuals) < _MIN_RESIDUAL:
        return steps
    added = _added_tones(model, terms, positions)
    for fits in (
        [_Fits.of(row, model, positions, residual) for row, residual in zip(rows, residuals, strict=True)],
        [
            _Fits.of_phase(row, model, triangle, added, positions, residual)
            for row, residual in zip(rows, residuals, strict=True)
        ],
    ):
        for number, fit in enumerate(fits):
            best = int(np.argmin(fit.remaining))
            log_ratio = complex(fit.log_ratio[best])
            is_significant = fit.remaining[best] < min(_MAX_REMAINING_FRACTION * fit.residual, _MAX_REMAINING)
            if number in steps or not is_significant or abs(log_ratio) < _MIN_CHANGE:
                continue
            others = (other.step_at(best) for index, other in enumerate(fits) if index != number)
            if max(others) < _MAX_COMMON * abs(log_ratio):
                steps[number] = int(positions[best]), log_ratio
    return steps


def _residual(readings: Array, model: Array) -> float:
    """Return the rms residual without a step, relative to the readings without their drift."""
    coefficients = readings @ model
    drift = model[:, :_DRIFT_TERMS] @ coefficients[:_DRIFT_TERMS]
    scale = max(float(np.sum((readings - drift) ** 2)), 1e-300)
    return float(np.linalg.norm(readings - model @ coefficients)) / math.sqrt(scale)


def _added_tones(model: Array, terms: Array, positions: Array) -> tuple[Array, Array, Array]:
    """Return the tone (cosine, sine), its projections from each position on, and the squares outside the model."""
    tone = terms[:, _DRIFT_TERMS : _DRIFT_TERMS + 2]

    def sums_from(values: Array) -> Array:
        total = np.cumsum(values, axis=0)
        return np.asarray((total[-1] - total)[positions - 1])

    projections = sums_from(model[:, :, None] * tone[:, None, :])
    squares = sums_from(tone[:, :, None] * tone[:, None, :]) - np.swapaxes(projections, 1, 2) @ projections
    return tone, projections, squares


def _model(phase: Array) -> Array:
    """Return the terms of the model, shape (samples, terms)."""
    time = np.linspace(-1.0, 1.0, phase.size)
    drift = time ** np.arange(_DRIFT_TERMS)[:, None]
    tone = np.stack([np.cos(phase), np.sin(phase)])
    harmonics = [part(order * phase) for order in range(2, _HARMONICS + 1) for part in (np.cos, np.sin)]
    return np.concatenate([drift, tone, time * tone, time**2 * tone, harmonics]).T


class _Fits(NamedTuple):
    """Fits of a step at each position to one channel; residuals are relative to the readings without their drift."""

    residual: float  # residual without a step
    remaining: Array  # (positions,)
    log_ratio: ComplexArray  # (positions,)

    def step_at(self, index: int) -> float:
        """Return the magnitude of the logarithm of the ratio at a position; 0 if this does not reduce the residual."""
        is_step = self.remaining[index] < _MAX_FRACTION_OF_STEP * self.residual
        return abs(complex(self.log_ratio[index])) if is_step else 0.0

    @classmethod
    def of(cls, readings: Array, model: Array, positions: Array, residual: float) -> _Fits:
        """Fit a step before each position; `model`: orthonormal columns; `residual`: without a step."""
        projections = np.cumsum(model * readings[:, None], axis=0)
        powers = np.cumsum(readings**2)
        before, after = projections[positions - 1], projections[-1] - projections[positions - 1]
        power_before, power_after = powers[positions - 1], powers[-1] - powers[positions - 1]
        # Squares and product of the residuals of both parts.
        square_before = power_before - np.sum(before**2, axis=1)
        square_after = power_after - np.sum(after**2, axis=1)
        product = -np.sum(before * after, axis=1)
        factor = -product / np.maximum(square_after, 1e-12 * max(powers[-1], 1e-300))
        remaining = np.maximum(square_before + factor * product, 0.0)
        # Squares of the readings without drift, with the factor applied after the step.
        tone_powers = np.cumsum((readings - model[:, :_DRIFT_TERMS] @ projections[-1, :_DRIFT_TERMS]) ** 2)
        tone_before = tone_powers[positions - 1]
        scale = np.maximum(tone_before + factor**2 * (tone_powers[-1] - tone_before), 1e-300)
        log_ratio = np.where(factor > 0.0, -np.log(np.maximum(factor, 1e-300)), 0.0)
        return cls(residual, np.sqrt(remaining / scale), log_ratio.astype(complex))

    @classmethod
    def of_phase(
        cls,
        readings: Array,
        model: Array,
        triangle: Array,
        added: tuple[Array, Array, Array],
        positions: Array,
        residual: float,
    ) -> _Fits:
        """Fit a step of the phase from each position on; `triangle`: model times triangle are the terms."""
        tone, projections, squares = added
        coefficients = readings @ model
        misfit = readings - model @ coefficients
        products = np.cumsum(tone * misfit[:, None], axis=0)
        right = (products[-1] - products)[positions - 1]
        change = np.linalg.solve(squares + 1e-9 * readings.size * np.eye(2), right[:, :, None])
        remaining = np.maximum(float(misfit @ misfit) - np.sum(right * change[:, :, 0], axis=1), 0.0)
        drift = model[:, :_DRIFT_TERMS] @ coefficients[:_DRIFT_TERMS]
        scale = max(float(np.sum((readings - drift) ** 2)), 1e-300)
        # Amplitudes before the step are those of the terms, quadratic in time, when all terms are fitted together.
        unknowns = np.linalg.solve(triangle, (coefficients[:, None] - (projections @ change)[:, :, 0].T))
        time = np.linspace(-1.0, 1.0, readings.size)[positions]
        cosine, sine = (
            sum(time**order * unknowns[_DRIFT_TERMS + part + 2 * order] for order in range(3)) for part in range(2)
        )
        before = cosine - 1j * sine
        ratio = 1.0 + (change[:, 0, 0] - 1j * change[:, 1, 0]) / np.where(before == 0.0, 1e-300, before)
        phase = np.angle(ratio)
        # A delay changes the phase, but not the magnitude.
        is_delay = abs(phase) > abs(np.log(np.maximum(abs(ratio), 1e-300)))
        return cls(residual, np.sqrt(remaining / scale), np.where(is_delay, 1j * phase, 0.0))


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
            model, _ = np.linalg.qr(_model(interval.phase(np.arange(readings.size) + middle - samples // 2)))
            residuals.append(_residual(readings - readings.mean(), model))
    return bool(residuals) and float(np.median(residuals)) > _MAX_REMAINING
