"""Channels whose gain changes during a test, for example due to a broken cable, a loose sensor or a switched range.

A test is divided into *parts* with equal excitation, such as impacts, periods or sections of a random test. The ratio
of an output to the inputs, averaged over all parts, predicts its spectrum in each part. The *relative gain* of a part
is the regression coefficient of measured and predicted spectrum. It scatters with noise and leakage, and has a step
where the gain of the channel changes. The step is where the sum of squares about the means before and after it is
smallest (D. M. Hawkins, J. Am. Stat. Assoc. 72 (1977) 180-186). In steady responses, a change of the gain is the same
at all lines, so two periods are enough; the drift of a settling sensor differs from line to line. A change of the
structure affects all outputs, and is not reported.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from analysis.core.responses.checks.clean_segments import clean_segments, find_flaws
from daq.core.recording.recording import Recording
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results import format_number

# Fewest parts without flaws.
_MIN_PARTS = 4
# Fewest parts on either side of a step: a scatter needs several values.
_MIN_SIDE = 2
# Minimum number of periods of a steady response to one input: without a change, the periods are equal except for noise.
_MIN_PERIODS = 2
# Longest section of a random test, in samples; `_MAX_PERIODS` applies if it is longer.
_MAX_SAMPLES = 32768
# Longest section of a random test, in periods of the lowest frequency.
_MAX_PERIODS = 100.0
# Sections of a random test: their number limits the resolution of the time of a change, and the averages in each.
_SECTIONS = 16
# Evaluated parts of the test, to limit the computing time; if there are more parts, every n-th is evaluated.
_MAX_PARTS = 256
# Values of the spectra of all parts in memory (64 MB), if at least `_SECTIONS` parts remain.
_MAX_VALUES = 1 << 22
# A step is reported if it exceeds this fraction of the larger gain ...
_MIN_CHANGE = 0.1
# ... and if the scatter would cause such a step with at most this probability (Student's t distribution).
_SCATTER_PROBABILITY = 1e-5
# In steady responses, a step must exceed the deviations of single lines from the gain of their part by this factor.
_MIN_UNIFORMITY = 2.0
# Largest change of the other channels' gains at a step, relative to it, unless they change by the same factor.
_MAX_COMMON = 0.25
# A channel whose gain falls below this fraction is dead: only noise and crosstalk remain.
_DEAD_RATIO = 0.05
# Smallest power of the largest input at an evaluated line, relative to the mean; at other lines, noise dominates.
_MIN_POWER = 1e-3


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
    """Step of the relative gain of an output at the start of a part of the test."""

    part: int
    before: float
    after: float

    @property
    def ratio(self) -> float:
        """Gain after the step, relative to the gain before it."""
        return self.after / self.before if self.before else np.inf


def sections(rec: Recording, channels: Collection[str], first: int, stop: int, low: float, high: float) -> Parts:
    """Return flawless sections of a random test between two samples; the sections of a long test have gaps."""
    spacing = (stop - first) // _SECTIONS
    samples = min(spacing, max(_MAX_SAMPLES, int(_MAX_PERIODS * rec.rate / low)))
    segments = clean_segments(find_flaws(rec, channels, first, stop), first, stop)
    starts = [start for begin, end in segments for start in range(begin, end - samples + 1, spacing)]
    return Parts(np.array(starts, dtype=np.int64), samples, low, high, is_periodic=False)


def change_warnings(rec: Recording, parts: Parts, channels: Sequence[str]) -> list[str]:
    """Return a warning for each channel whose gain changes during a test."""
    inputs = [name for name in channels if rec.channels[name].quantity == "force"]
    inputs = inputs or [name for name in channels if not rec.channels[name].body]
    outputs = [name for name in channels if name not in inputs]
    if not inputs or not outputs:
        return []
    clean, spectra = _spectra(rec, parts, [*inputs, *outputs])
    has_one_steady_input = parts.is_steady and len(inputs) == 1
    if len(clean) < (_MIN_PERIODS if has_one_steady_input else max(_MIN_PARTS, len(inputs) + _MIN_SIDE + 1)):
        return []
    gains, limits = _relative_gains(spectra[:, : len(inputs)], spectra[:, len(inputs) :])
    steps = [_largest_step(*rows, parts.is_steady) for rows in zip(gains, limits, strict=True)]
    warnings = []
    for k, step in enumerate(steps):
        if step is None:
            continue
        others = [_changed(other, step.part) for other in np.delete(gains, k, axis=0)]
        change = step.after - step.before
        time = f"{clean[step.part] / rec.rate:.4g} s"
        if all(abs(other.after - other.before) < _MAX_COMMON * abs(change) for other in others):
            blamed = outputs[k] if others else f"{outputs[k]} or {' or '.join(inputs)}"
            warnings.append(describe_change(blamed, step.ratio, time))
        elif len(inputs) == 1 and all(
            abs(other.ratio - step.ratio) <= _MAX_COMMON * abs(step.ratio) for other in others
        ):
            # If all responses change equally, the input has changed; a dead input predicts zero for all responses.
            warnings.append(describe_change(inputs[0], 1.0 / step.ratio if step.ratio else 0.0, time))
            break
    return warnings


def describe_change(name: str, ratio: float, place: str) -> str:
    """Describe a change of the gain of a channel by a ratio, NaN if unknown, at a time or a frequency."""
    change = "changes" if np.isnan(ratio) else f"changes by a factor of {format_number(float(f'{ratio:.2g}'))}"
    if abs(ratio) < _DEAD_RATIO:
        change = "drops to zero (dead or disconnected)"
    return (
        f"{name}: its gain {change} at about {place}, in contrast to the other channels. Check mounting, cable and "
        "range, and record again; until then, the responses of this channel are wrong."
    )


def _spectra(rec: Recording, parts: Parts, names: Sequence[str]) -> tuple[list[int], ComplexArray]:
    """Return the starts of the parts without flaws, and their spectra in the band, shape (parts, channels, lines)."""
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
    return clean, np.array(spectra)


def _relative_gains(inputs: ComplexArray, outputs: ComplexArray) -> tuple[Array, Array]:
    """Return gains of each output in each part of the test, relative to all parts, and the smallest visible steps.

    A visible step exceeds the scatter of the gain from line to line.
    `inputs`, `outputs`: spectra, shape (parts, channels, lines). The results have the shape (outputs, parts).
    """
    power = (abs(inputs) ** 2).mean(axis=0).max(axis=0)
    excited = power > _MIN_POWER * power.mean()
    x, y = (np.moveaxis(spectra[:, :, excited], 2, 0) for spectra in (inputs, outputs))
    predicted = x @ (np.linalg.pinv(x) @ y)
    # Each line has about equal weight, so neither resonances nor the noise between resonances dominate.
    weight = 1.0 / np.maximum((abs(y) ** 2 + abs(predicted) ** 2).mean(axis=1, keepdims=True), 1e-300)
    predicted_power = np.maximum(np.sum(weight * abs(predicted) ** 2, axis=0), 1e-300)
    gains = np.sum(weight * (predicted.conj() * y).real, axis=0) / predicted_power
    # The fit to noisy parts reduces the scatter. Noise of real and imaginary part of each line is independent.
    lines, count = y.shape[:2]
    freedom = max(1.0 - inputs.shape[1] / count, 1e-300)
    deviation = np.sqrt(np.sum(weight * abs(y - gains * predicted) ** 2, axis=0) / predicted_power / freedom)
    factor = max(_MIN_UNIFORMITY, scipy.stats.t.isf(_SCATTER_PROBABILITY, 2 * lines - 1) / np.sqrt(lines))
    return np.asarray(gains.T), np.asarray(factor * deviation.T)


def _changed(gains: Array, part: int) -> _Step:
    """Return the median gains before and after the start of a part."""
    return _Step(part, float(np.median(gains[:part])), float(np.median(gains[part:])))


def _largest_step(gains: Array, limits: Array, is_steady: bool) -> _Step | None:
    """Return the step that explains most of the scatter of the gains; None if small (`limits`) or scatter itself."""
    size = gains.size
    min_side = _MIN_SIDE if size >= _MIN_PARTS else 1

    def scatter(part: int) -> float:
        return float(np.var(gains[:part]) * part + np.var(gains[part:]) * (size - part))

    part = min(range(min_side, size - min_side + 1), key=scatter)
    step = _changed(gains, part)
    change = abs(step.after - step.before)
    is_large = change > _MIN_CHANGE * max(abs(step.before), abs(step.after))
    if is_steady:
        is_large &= change > max(np.sqrt(np.mean(side**2)) for side in (limits[:part], limits[part:]))
    if size >= _MIN_PARTS:
        error = np.sqrt(scatter(part) / (size - 2) * (1.0 / part + 1.0 / (size - part)))
        is_large &= change > scipy.stats.t.isf(_SCATTER_PROBABILITY, size - 2) * error
    return step if is_large else None
