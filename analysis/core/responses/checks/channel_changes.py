"""Channels whose gain or delay changes during a test, for example due to a broken cable or a switched range.

A test is divided into *parts* with equal excitation, such as impacts, periods or sections of a random test. The ratio
of an output to the inputs, averaged over all parts, predicts its spectrum in each part. The *relative gain* of a part
is the regression coefficient of measured and predicted spectrum. It scatters with noise and leakage, and has a step
where the gain of the channel changes. The step is where the sum of squares about the means before and after it is
smallest (D. M. Hawkins, J. Am. Stat. Assoc. 72 (1977) 180-186). The *delay* of a part maximizes the cross-correlation
of measured and predicted spectrum (generalized cross-correlation: C. H. Knapp, G. C. Carter, IEEE Trans. Acoust. Speech
Signal Process. 24 (1976) 320-327), and has a step in the same way. In steady responses, a change of the gain is the
same at all lines, so two periods are enough; the drift of a settling sensor differs from line to line. A change of the
structure affects all outputs, and is not reported.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.responses.checks.clean_segments import clean_segments, find_flaws
from analysis.core.responses.checks.delays import CONSTANT_DELAY
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results import format_number

# Minimum number of parts without flaws.
_MIN_PARTS = 4
# Minimum number of parts on either side of a step: a scatter needs several values.
_MIN_SIDE = 2
# Minimum number of parts if the part with the step is excluded: of fewer parts, the scatter is too uncertain.
_MIN_PARTS_WITHOUT_STEP = 6
# Minimum number of periods of a steady response to one input: without a change, the periods are equal except for noise.
_MIN_PERIODS = 2
# Longest section of a random test, in samples; `_MAX_PERIODS` applies if it is longer.
_MAX_SAMPLES = 32768
# Longest section of a random test, in periods of the lowest frequency.
_MAX_PERIODS = 100.0
# Number of sections of a random test: it limits the resolution of the time of a change, and the averages in each
# section.
_SECTIONS = 16
# Maximum number of evaluated parts of the test, to limit the computing time; if there are more parts, every n-th is
# evaluated.
_MAX_PARTS = 256
# Maximum number of values of the spectra of all parts in memory (64 MB), if at least `_SECTIONS` parts remain.
_MAX_VALUES = 1 << 22
#: A step is reported if it exceeds this fraction of the larger gain ...
MIN_CHANGE = 0.1
# ... and if the scatter would cause such a step with at most this probability (Student's t distribution).
_SCATTER_PROBABILITY = 1e-5
# Smallest reported change of a delay, as the phase that it causes at the highest frequency [rad].
_MIN_PHASE = 0.1
# Largest trial delay of a part, in periods of the highest frequency ...
_MAX_TURNS = 2.0
# ... or this time [s], if it is longer, ...
_MAX_DELAY_S = 5e-3
# ... up to this number of periods, to limit the computing time.
_MAX_LONG_TURNS = 20.0
# Smallest cross-correlation of a part, relative to that without noise.
_MIN_CLARITY = 0.5
# Spacing of the trial delays, in periods of the highest frequency.
_TURNS_SPACING = 0.1
# In steady responses, a step must exceed the deviations of single lines from the gain of their part by this factor.
_MIN_UNIFORMITY = 2.0
# Largest error of the delay of a channel, relative to that of a channel which may have caused the same change.
_MAX_ERROR_RATIO = 0.5
#: Largest change of the other channels' gains at a step, relative to it, unless they change by the same factor.
MAX_COMMON = 0.25
# A channel whose gain falls below this fraction has failed: only noise and crosstalk remain.
_FAILED_RATIO = 0.05
# Smallest power of the largest input at an evaluated line, relative to the mean; at other lines, noise dominates.
_MIN_POWER = 1e-3
# Words by which the warning of a delay that changes is recognized.
_DELAY_CHANGE = " on, in contrast to the other channels"


@dataclass(frozen=True)
class Parts:
    """Parts of a test with equal excitation."""

    starts: NDArray[np.int64]  # first sample of each part
    samples: int  # length of each part
    low: float  # lower end of the band [Hz]
    high: float
    is_periodic: bool = True  # whether a part is a period or a decaying transient, and so needs no window
    is_steady: bool = False  # whether all parts are periods of steady responses


class _Step(NamedTuple):
    """Step of the relative gain or of the delay of an output within a part of the test, or at its start."""

    part: int
    before: float
    after: float

    @property
    def change(self) -> float:
        return self.after - self.before

    @property
    def ratio(self) -> float:
        """Gain after the step, relative to the gain before it."""
        return self.after / self.before if self.before else np.inf


class _Delay(NamedTuple):
    """Change of the delay of a channel."""

    channel: str
    change: float  # s
    time: str
    error: float  # of the delays after the change [s]
    reference: str  # channels that may have the opposite change instead


def sections(rec: Recording, channels: Collection[str], first: int, stop: int, low: float, high: float) -> Parts:
    """Return flawless sections of a random test between two samples; the sections of a long test have gaps."""
    spacing = (stop - first) // _SECTIONS
    samples = min(spacing, max(_MAX_SAMPLES, int(_MAX_PERIODS * rec.rate / low)))
    segments = clean_segments(find_flaws(rec, channels, first, stop), first, stop)
    starts = [start for begin, end in segments for start in range(begin, end - samples + 1, spacing)]
    return Parts(np.array(starts, dtype=np.int64), samples, low, high, is_periodic=False)


def change_warnings(rec: Recording, parts: Parts, channels: Sequence[str]) -> list[str]:
    """Return a warning for each channel whose gain or delay changes during a test."""
    inputs = [name for name in channels if rec.channels[name].quantity == "force"]
    inputs = inputs or [name for name in channels if not rec.channels[name].body]
    outputs = [name for name in channels if name not in inputs]
    if not inputs or not outputs:
        return []
    clean, frequency, spectra = _spectra(rec, parts, [*inputs, *outputs])
    if len(clean) < max(_MIN_PERIODS, len(inputs) + 1):
        return []
    x, y = spectra[:, : len(inputs)], spectra[:, len(inputs) :]
    test = _Test(frequency, clean, rec.rate, parts.is_steady)
    compared = _Compared.of(inputs, x, outputs, y, test)
    delays = compared.delay_changes()
    if 1 < len(inputs) <= len(outputs):
        # The responses determine the inputs; a late input differs from the other inputs.
        exchanged = _Compared.of(outputs, _components(y, len(inputs)), inputs, x, test)
        delays = _select(delays, exchanged.delay_changes())
    warnings = [describe_delay(delay.channel, delay.change, delay.time, delay.reference) for delay in delays]
    # The delay of an input, or of a channel that may be an input, changes the relative gains of all outputs.
    if any(delay.reference or delay.channel in inputs for delay in delays):
        return warnings
    has_one_steady_input = parts.is_steady and len(inputs) == 1
    if len(clean) < (_MIN_PERIODS if has_one_steady_input else max(_MIN_PARTS, len(inputs) + _MIN_SIDE + 1)):
        return warnings
    return warnings + compared.without({delay.channel for delay in delays}).gain_warnings()


def _select(delays: list[_Delay], exchanged: list[_Delay]) -> list[_Delay]:
    """Return the delays of responses or of inputs, whichever have the clearly smaller error; otherwise alternatives."""
    if not delays or not exchanged:
        return delays or exchanged
    smaller, larger = sorted((delays, exchanged), key=lambda each: max(delay.error for delay in each))
    if max(delay.error for delay in smaller) < _MAX_ERROR_RATIO * max(delay.error for delay in larger):
        return smaller
    return [
        delay._replace(reference=" or ".join(each.channel for each in larger if each.change * delay.change < 0.0))
        for delay in smaller
    ]


def describe_delay(name: str, delay: float, place: str, reference: str = "", period: float = 0.0) -> str:
    """Describe a change of the delay of a channel [s] at a time or a frequency.

    `reference`: channels that may have the opposite change instead; `period`: period of the tone whose phase shows the
    change [s], 0 if the signal is no tone. The phase does not distinguish changes that differ by whole periods.
    """
    senses = ("late", "early") if delay > 0.0 else ("early", "late")
    shift, other, turn = (
        f"{format_number(float(f'{1e3 * each:.2g}'))} ms" for each in (abs(delay), period - abs(delay), period)
    )
    change = f"{shift} {senses[0]}"
    if period:
        change += f" or {other} {senses[1]} (plus or minus whole periods of {turn})"
    opposite = f"{reference} has the opposite delay" if period else f"{reference} {senses[1]}"
    alternative = f", or {opposite}," if reference else ""
    return (
        f"{name} seems to be {change}{alternative} from about {place}{_DELAY_CHANGE}. Check cable and time base, and "
        "record again; until then, its responses are wrong."
    )


def without_mean_delay(warnings: Sequence[str]) -> tuple[str, ...]:
    """Omit the warning of a constant delay if the delay of a channel changes: it would state a mean over the test."""
    has_change = any(_DELAY_CHANGE in text for text in warnings)
    return tuple(text for text in warnings if not (has_change and CONSTANT_DELAY in text))


def describe_change(name: str, ratio: float, place: str) -> str:
    """Describe a change of the gain of a channel by a ratio, NaN if it may be a delay, at a time or a frequency."""
    factor = format_number(float(f"{ratio:.2g}"))
    change = "or its delay changes" if np.isnan(ratio) else f"changes by a factor of {factor}"
    if abs(ratio) < _FAILED_RATIO:
        change = "drops to zero (disconnected or failed)"
    return (
        f"{name}: its gain {change} at about {place}, in contrast to the other channels. Check mounting, cable and "
        "range, and record again; until then, the responses of this channel are wrong."
    )


def _spectra(rec: Recording, parts: Parts, names: Sequence[str]) -> tuple[list[int], Array, ComplexArray]:
    """Return the starts of the parts without flaws, frequencies, and spectra of shape (parts, channels, lines)."""
    frequency = np.fft.rfftfreq(parts.samples, 1.0 / rec.rate)
    in_band = (frequency >= max(parts.low, frequency[1])) & (frequency <= parts.high)
    window = np.ones(parts.samples) if parts.is_periodic else scipy.signal.windows.hann(parts.samples, sym=False)
    max_parts = min(max(_MAX_VALUES // (len(names) * max(int(in_band.sum()), 1)), _SECTIONS), _MAX_PARTS)
    clean, spectra = [], []
    for start in parts.starts[:: -(-parts.starts.size // max_parts) or 1].tolist():  # rounded up
        stop = start + parts.samples
        if start < 0 or stop > rec.samples or find_flaws(rec, names, start, stop):
            continue
        block = np.stack([rec.read(name, start, stop) for name in names])
        if np.isfinite(block).all():
            block -= block.mean(axis=1, keepdims=True)
            clean.append(start)
            spectra.append(scipy.fft.rfft(block * window, axis=1)[:, in_band])
    return clean, frequency[in_band], np.array(spectra)


def _components(outputs: ComplexArray, count: int) -> ComplexArray:
    """Return the largest principal components of outputs at each line; spectra of shape (parts, channels, lines)."""
    scale = np.maximum(np.sqrt((abs(outputs) ** 2).mean(axis=(0, 2), keepdims=True)), 1e-300)
    spectra = np.moveaxis(outputs / scale, 2, 0)
    directions = np.linalg.svd(spectra, full_matrices=False)[2][:, :count]
    return np.moveaxis(spectra @ directions.conj().swapaxes(1, 2), 0, 2)


class _Test(NamedTuple):
    """Lines and parts of the compared spectra."""

    frequency: Array  # Hz
    starts: Sequence[int]  # first sample of each part
    rate: float  # Hz
    is_steady: bool


@dataclass(frozen=True)
class _Compared:
    """Spectra of the inputs, of the outputs and of their predictions, shape (lines, parts, channels)."""

    input_names: Sequence[str]
    outputs: Sequence[str]
    inputs: ComplexArray
    measured: ComplexArray
    predicted: ComplexArray
    freedom: float  # degrees of freedom of the deviations, relative to the number of parts
    test: _Test

    @classmethod
    def of(
        cls,
        input_names: Sequence[str],
        inputs: ComplexArray,
        outputs: Sequence[str],
        measured: ComplexArray,
        test: _Test,
    ) -> Self:
        """Predict outputs from inputs; spectra of shape (parts, channels, lines)."""
        power = (abs(inputs) ** 2).mean(axis=0).max(axis=0)
        excited = power > _MIN_POWER * power.mean()
        x, y = (np.moveaxis(spectra[:, :, excited], 2, 0) for spectra in (inputs, measured))
        # The prediction is fitted to the noisy parts, which reduces the scatter.
        freedom = max(1.0 - inputs.shape[1] / len(measured), 1e-300)
        test = test._replace(frequency=test.frequency[excited])
        return cls(input_names, outputs, x, y, y, freedom, test).predict(slice(None))

    def predict(self, parts: slice) -> Self:
        """Predict the outputs of all parts by the responses of these parts."""
        responses = np.linalg.pinv(self.inputs[:, parts]) @ self.measured[:, parts]
        return replace(self, predicted=self.inputs @ responses)

    def without(self, omitted: Collection[str]) -> Self:
        """Omit outputs."""
        rows = [row for row, name in enumerate(self.outputs) if name not in omitted]
        measured, predicted = (spectra[:, :, rows] for spectra in (self.measured, self.predicted))
        return replace(self, outputs=[self.outputs[row] for row in rows], measured=measured, predicted=predicted)

    def cause(self, steps: Mapping[int, _Step], row: int, quantity: str) -> str:
        """Return the channel that causes a step of an output: the output, or the input of all; "" if it is unknown.

        `steps`: changes of all outputs at the step of the output `row`; `quantity`: property that an input changes
        equally.
        """
        step, others = steps[row], [other for index, other in steps.items() if index != row]
        if all(abs(other.change) < MAX_COMMON * abs(step.change) for other in others):
            return self.outputs[row]
        own = getattr(step, quantity)
        is_common = all(abs(getattr(other, quantity) - own) <= MAX_COMMON * abs(own) for other in others)
        return self.input_names[0] if is_common and len(self.input_names) == 1 else ""

    def gain_warnings(self) -> list[str]:
        """Return a warning for each channel whose gain changes."""
        warnings = []
        gains, limits = self.gains()
        for k, name in enumerate(self.outputs):
            step = _largest_step(gains[k], limits[k], self.test.is_steady)
            if step is None or abs(step.change) <= MIN_CHANGE * max(abs(step.before), abs(step.after)):
                continue
            time = self.time(step, gains[k])
            cause = self.cause({row: _changed(each, step.part) for row, each in enumerate(gains)}, k, "ratio")
            if cause == name:
                blamed = name if len(gains) > 1 else " or ".join([name, *self.input_names])
                warnings.append(describe_change(blamed, step.ratio, time))
            elif cause:
                # A failed input predicts zero for all responses.
                warnings.append(describe_change(cause, 1.0 / step.ratio if step.ratio else 0.0, time))
                break
        return warnings

    def delay_changes(self) -> list[_Delay]:
        """Return the change of each channel whose delay changes."""
        found = list[_Delay]()
        delays, limits = self.delays()
        min_change = _MIN_PHASE / (2.0 * np.pi * float(self.test.frequency.max()))
        determined = np.flatnonzero(np.isfinite(delays).all(axis=1)).tolist()
        for k in determined:
            step = _largest_step(delays[k], limits[k], self.test.is_steady)
            if step is None or abs(step.change) < min_change:
                continue
            time, refined, errors = self.time(step, delays[k]), delays, limits
            if step.part >= self.inputs.shape[2]:
                # Predictions from the parts before the step contain no noise of those after it.
                from_before, errors = self.predict(slice(step.part)).delays()
                refined = np.where(np.isfinite(from_before), from_before, delays)
            steps = {row: _changed(refined[row], step.part) for row in determined}
            cause = self.cause(steps, k, "change")
            delay = _Delay(cause, steps[k].change, time, float(np.median(errors[k, step.part :])), "")
            if cause == self.outputs[k]:
                found.append(delay._replace(reference="" if len(steps) > 1 else " or ".join(self.input_names)))
            elif cause:
                # If all responses become early, the input has become late.
                return [*found, delay._replace(change=-delay.change)]
        return found

    def time(self, step: _Step, values: Array) -> str:
        """Describe the instant of a step, which the value of its part shows to a tenth of the distance of two parts."""
        if values.size < _MIN_PARTS_WITHOUT_STEP:
            return f"{self.test.starts[step.part] / self.test.rate:.4g} s"
        share = round(float(np.clip((step.after - values[step.part]) / step.change, 0.0, 1.0)), 1)
        first, last = self.test.starts[step.part : step.part + 2]
        return f"{((1.0 - share) * first + share * last) / self.test.rate:.4g} s"

    def gains(self) -> tuple[Array, Array]:
        """Return gains relative to all parts, and the smallest visible steps, (outputs, parts)."""
        y, predicted = self.measured, self.predicted
        # Each line has about equal weight, so neither resonances nor the noise between resonances dominate.
        weight = 1.0 / np.maximum((abs(y) ** 2 + abs(predicted) ** 2).mean(axis=1, keepdims=True), 1e-300)
        predicted_power = np.maximum(np.sum(weight * abs(predicted) ** 2, axis=0), 1e-300)
        gains = np.sum(weight * (predicted.conj() * y).real, axis=0) / predicted_power
        # Noise of the real and of the imaginary part of each line is independent.
        lines = len(y)
        deviation = np.sqrt(np.sum(weight * abs(y - gains * predicted) ** 2, axis=0) / predicted_power / self.freedom)
        factor = max(_MIN_UNIFORMITY, scipy.stats.t.isf(_SCATTER_PROBABILITY, 2 * lines - 1) / np.sqrt(lines))
        return np.asarray(gains.T), np.asarray(factor * deviation.T)

    def delays(self) -> tuple[Array, Array]:
        """Return delays relative to all parts [s], NaN if noise hides a part, and smallest visible steps (as gains)."""
        y, predicted, highest = self.measured, self.predicted, float(self.test.frequency.max())
        omega = 2.0 * np.pi * self.test.frequency[:, None, None]
        product = predicted.conj() * y
        product = product / np.maximum(abs(product), 1e-300)
        powers = [np.sum(abs(each) ** 2, axis=1, keepdims=True) for each in (predicted, y)]
        # Lines without noise have equal weights. The prediction contains the noise times the share of fitted values.
        noise = 1.0 - self.freedom
        weight = np.maximum(powers[0] / np.maximum(powers[1], 1e-300) - noise, 0.0) ** 2
        count = int(np.ceil(max(_MAX_TURNS, min(_MAX_DELAY_S * highest, _MAX_LONG_TURNS)) / _TURNS_SPACING))
        trials = np.arange(-count, count + 1) * (_TURNS_SPACING / highest)
        correlation = np.tensordot(np.exp(1j * np.outer(trials, omega)), weight * product, 1).real
        delays = trials[np.argmax(correlation, axis=0)]
        is_clear = correlation.max(axis=0) > _MIN_CLARITY * np.sum(weight, axis=0)
        information = np.maximum(np.sum(weight * omega**2, axis=0), 1e-300)
        for _ in range(2):
            phase = np.angle(product * np.exp(1j * omega * delays))
            delays = delays - np.sum(weight * omega * phase, axis=0) / information
        phase = np.angle(product * np.exp(1j * omega * delays))
        terms = weight * omega * phase
        squares = np.maximum(np.sum(terms**2, axis=0), 1e-300)
        # Errors of neighboring lines are correlated, as those of a transient.
        correlation = np.clip(np.sum(terms[1:] * terms[:-1], axis=0) / squares, 0.0, 0.9)
        deviation = np.sqrt(squares * (1.0 + correlation) / (1.0 - correlation) / self.freedom) / information
        factor = scipy.stats.t.isf(_SCATTER_PROBABILITY, max(len(y) - 1, 1))
        return np.where(is_clear.all(axis=0), delays, np.nan).T, np.asarray(factor * deviation.T)


def _sides(values: Array, part: int) -> tuple[Array, Array]:
    """Return the values before and after the part with the step; if there are few, its own value is after the step."""
    return values[:part], values[part + (values.size >= _MIN_PARTS_WITHOUT_STEP) :]


def _changed(values: Array, part: int) -> _Step:
    """Return the medians before and after a part."""
    before, after = _sides(values, part)
    return _Step(part, float(np.median(before)), float(np.median(after)))


def _largest_step(values: Array, limits: Array, is_steady: bool) -> _Step | None:
    """Return the step that explains most of the scatter of gains or delays; None if below `limits` or scatter."""
    size = values.size
    min_side = _MIN_SIDE if size >= _MIN_PARTS else 1

    def scatter(part: int) -> float:
        return sum(float(np.var(side)) * side.size for side in _sides(values, part))

    part = min(range(min_side, size - min_side + (size < _MIN_PARTS_WITHOUT_STEP)), key=scatter)
    step = _changed(values, part)
    limit = 0.0
    if is_steady or size < _MIN_PARTS:
        limit = max(np.sqrt(np.mean(side**2)) for side in _sides(limits, part))
    if size >= _MIN_PARTS:
        counts = [side.size for side in _sides(values, part)]
        freedom = sum(counts) - 2
        error = np.sqrt(scatter(part) / freedom * sum(1.0 / count for count in counts))
        limit = max(limit, scipy.stats.t.isf(_SCATTER_PROBABILITY, freedom) * error)
    return step if abs(step.change) > limit else None
