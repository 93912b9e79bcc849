"""A tone that determines the number of its periods after which a motion repeats.

Impacts can multiply the period of a motion, or make it chaotic or quasi-periodic, even if its envelope at the frequency
of the tone is nearly constant.
"""

from collections import defaultdict
from collections.abc import Callable, Generator
from math import ceil
from typing import TypeVar

import numpy as np

from daq.core.excitation.controlled import Controlled
from daq.core.excitation.lock_in import whole_periods
from daq.core.excitation.sensor_settling import wait_for_sensors
from daq.core.excitation.station import Station
from daq.core.excitation.tones.steady_tone import WINDOW_S, SteadyTone
from rig.core.base.arrays import Array, ComplexArray
from rig.core.results.text import format_frequencies
from rig.core.scene.excitation import Settle

T = TypeVar("T")
# A measurement is repeated while the differences of its periods decrease to at most this ratio from one measurement to
# the next: other modes decay. Differences by a multiple of the period or an irregular motion remain about equal.
_DECAYING_RATIO = 0.8
# A motion that repeats after at most this number of periods of the tone is periodic.
_MAX_REPEATED_PERIODS = 4
# The period is a multiple only if the deviations from one period exceed the smallest deviations, which are an estimate
# of the noise, by more than this ratio. Deviations by noise are equal to 20 %.
_MIN_DEVIATION_RATIO = 2.0
# Smaller deviations, relative to the tolerance of steady state, belong to transients.
_MIN_MULTIPLE_RATIO = 0.25
# Smallest ratio of the powers of a steady multiple in the first and last third of a measurement: with 24 steady
# multiples the ratio of last to first was 0.6 to 1.5, with two that grew 4 and 6. Modes with a time constant below 1.4
# measured times decay to less.
_MIN_POWER_RATIO = 0.4
# Ratio of the largest difference of two periods to the tolerance, which each of them may deviate from steady state.
_TWO_DEVIATIONS = 2.0**0.5
# Orders of the tone's frequency at which periods are compared. Hann windows of two periods at these orders cover the
# band from 0 to 2.5, without the drift of integrated channels at 0.
_COMPARED_ORDERS = 1.0, 1.5
# Number of windows at rest from which the noise is estimated, to 20 %.
_NOISE_WINDOWS = 12
# Assumed ratio of the noise variance in a measurement to that at rest, which a few windows determine only roughly.
_NOISE_MARGIN = 2.0


class RepeatingTone(SteadyTone):
    """A tone with a motion whose repetition is determined; `motion`: the displacement."""

    def __init__(
        self, station: Station, frequency: float, controlled: Controlled | None, motion: Controlled, settle: Settle
    ) -> None:
        super().__init__(station, frequency, controlled)
        self._quantity, self._settle = motion, settle
        # Standard deviation of the amplitude in a window by noise, before the weights of the displacement.
        self._noise = 0.0
        # Root mean square difference of two periods in the last measurement, relative to the motion.
        self._deviation = 0.0
        # Frequencies [Hz] and repetitions of the motions at each level.
        self._repetitions = defaultdict[float, list[tuple[float, int]]](list)

    @property
    def window(self) -> int:
        """Length of a window in samples."""
        return whole_periods(self.frequency, self.rate, WINDOW_S)

    def measure_noise(self) -> Generator[Array, Array, None]:
        """Estimate the noise of the displacement at rest, at the current frequency, and the noise of quantization."""
        yield from wait_for_sensors(self.station)
        amplitudes = []
        for _ in range(_NOISE_WINDOWS):
            phase = self.phase
            readings = yield self.station.drive(self.hold(self.window))
            amplitudes.append(complex(self._quantity.amplitudes(readings, [self.frequency], [phase])[0]))
        steps = [(info.volts_per_count or 0.0) / info.sensitivity for info in self.station.channels]
        weights = self._quantity.weights(self.frequency)
        # White noise with the variance step^2 / 12 has the variance step^2 / (3 n) in an amplitude from n samples.
        quantization = float(np.linalg.norm(weights * steps)) / (3 * self.window) ** 0.5
        self._noise = float(np.hypot(np.std(amplitudes), quantization) / np.linalg.norm(weights))

    def relative_noise(self, motion: float) -> float:
        """Return an upper estimate of the noise in a window, relative to a displacement amplitude in m."""
        noise = self._noise * float(np.linalg.norm(self._quantity.weights(self.frequency)))
        return _NOISE_MARGIN**0.5 * noise / max(motion, 1e-300)

    def repetition(self, samples: Array, motion: float, feedback: float = 0.0) -> int:
        """Return the number of periods of the tone after which a motion repeats, as far as noise permits; 0: none.

        `samples`: of the first channel of the motion, at constant frequency; `motion`: displacement amplitude [m];
        `feedback`: relative change of the motion in a period by changes of the drive.
        """
        # The windows of the comparison have two periods, and a Hann window has 1.5 times the noise.
        ratio = (1.5 * len(_COMPARED_ORDERS) * self.window * self.frequency / self.rate / 2.0) ** 0.5
        noise = ratio * self.relative_noise(motion)
        amplitudes = amplitudes_of_periods(samples, self.frequency, self.rate)
        self._deviation = float(np.mean(_deviations(amplitudes, 1)[0])) ** 0.5
        return repetition(amplitudes, self._settle.tolerance, noise, feedback)

    def until_decayed(
        self, measure: Callable[[], Generator[Array, Array, tuple[T, bool]]]
    ) -> Generator[Array, Array, T]:
        """Measure again while other modes decay, for at most the longest time of settling; return the last result.

        `measure`: measures and determines the `repetition` of the motion; it returns its result and whether another
        measurement can be steadier.
        """
        end = self.station.now + self.station.samples(self._settle.longest)
        previous = np.inf
        while True:
            result, is_transient = yield from measure()
            # `not <=` ends the loop for NaN, too.
            if not is_transient or self.station.now >= end or not self._deviation <= _DECAYING_RATIO * previous:
                return result
            previous = self._deviation

    def add_repetition(self, level: float, repetition: int) -> None:
        """Add a motion to those of the next warning."""
        self._repetitions[level].append((self.frequency, repetition))

    def warn_of_repetitions(self) -> None:
        """Warn of the motions since the last call that are irregular, or repeat only after several periods."""
        for level, motions in self._repetitions.items():
            frequencies, repetitions = zip(*motions, strict=True)
            for repetition in sorted({*repetitions} - {1}):
                where = format_frequencies(frequencies, [each == repetition for each in repetitions])
                text = (
                    f"motions repeat after {repetition} periods of the tone at {where}. Their amplitudes are those at "
                    "the frequency of the tone, without subharmonics."
                    if repetition
                    else f"the motion is irregular at {where}, or settles over more than 100 periods. These points are "
                    "marked as not settled. Choose a level with a periodic motion, often a higher one, or increase "
                    "test.settle.tolerance."
                )
                self.station.warn(f"level {self.station.level_text(level)}: {text}")
        self._repetitions.clear()


def amplitudes_of_periods(samples: Array, frequency: float, rate: float) -> ComplexArray:
    """Return the relative amplitudes of a motion in successive periods of a frequency in Hz, shape (windows, orders).

    The Hann windows have two periods, and begin one period apart. The norm of a difference over the orders is the
    relative difference of two periods. `rate`: sample rate [Hz].
    """
    period, rows = rate / frequency, []
    for start in range(max(int(samples.size / period + 1e-6) - 1, 1)):
        first = ceil(start * period)
        inside = samples[first : ceil((start + 2) * period)]
        local = (first + np.arange(inside.size)) / period - start
        window = np.sin(0.5 * np.pi * local) ** 2
        turns = [np.exp(-2j * np.pi * order * local) for order in _COMPARED_ORDERS]
        rows.append([2.0 * np.sum(window * turn * inside) / np.sum(window) for turn in turns])
    amplitudes = np.array(rows)
    return amplitudes / (len(_COMPARED_ORDERS) ** 0.5 * max(abs(complex(np.mean(amplitudes[:, 0]))), 1e-300))


def _drift(means: ComplexArray, other: ComplexArray) -> float:
    """Return the drift between two parts, from the mean of each phase of the repetition, shape (phases, orders).

    Differences between the phases that change in proportion are a transient of a multiple. Their rotation is a beat.
    """
    center, other_center = np.mean(means, axis=0), np.mean(other, axis=0)
    multiple, other_multiple = means - center, other - other_center
    ratio = max(np.vdot(multiple, other_multiple).real, 0.0) / max(float(np.linalg.norm(multiple)) ** 2, 1e-300)
    rotation = np.linalg.norm(other_multiple - ratio * multiple) / len(means) ** 0.5
    return float(np.hypot(np.linalg.norm(other_center - center), rotation))


def _deviations(amplitudes: ComplexArray, lag: int) -> tuple[Array, float]:
    """Return the deviations of a motion from one that repeats after `lag` periods.

    The first are the mean squared differences of two periods in each third of the measurement, or in all of a short
    one; the second is the largest drift between two thirds.
    """
    powers, means = [], []
    for part in np.array_split(np.arange(len(amplitudes)), 3 if len(amplitudes) >= 3 * (lag + 2) else 1):
        periods = [amplitudes[part[part % lag == phase]] for phase in range(lag)]
        residuals = [each - np.mean(each, axis=0) for each in periods]
        powers.append(2.0 * sum(np.sum(abs(each) ** 2) for each in residuals) / max(len(part) - lag, 1))
        means.append(np.array([np.mean(each, axis=0) for each in periods]))
    return np.array(powers), max(_drift(mean, other) for mean in means for other in means)


def repetition(amplitudes: ComplexArray, tolerance: float, noise: float, feedback: float = 0.0) -> int:
    """Return the number of periods after which a motion repeats, from `amplitudes_of_periods`; 0: none.

    `tolerance`: of steady state; `noise`: largest expected difference by noise; `feedback`: change of the motion in a
    period by changes of the drive; all relative to the motion. Without feedback, a drift in the measurement by about
    three tolerances is irregular, as is a rotation of a subharmonic.

    >>> t = np.arange(400)
    >>> motions = [np.sin(t) + 0.1 * np.sin(ratio * t) for ratio in (0.5, 0.43)]
    >>> [repetition(amplitudes_of_periods(motion, 1.0, 2.0 * np.pi), 1e-3, 0.0) for motion in motions]
    [2, 0]
    """
    # The force of a motion that does not repeat differs from that of the orbit by about as much as its periods.
    largest = _TWO_DEVIATIONS * float(np.linalg.norm([tolerance, noise, _MAX_REPEATED_PERIODS * feedback]))
    lags = range(1, min(_MAX_REPEATED_PERIODS, max(len(amplitudes) - 2, 1)) + 1)
    powers, drifts = zip(*(_deviations(amplitudes, lag) for lag in lags), strict=True)
    deviations = [float(np.mean(each)) ** 0.5 for each in powers]
    limit = max(float(np.hypot(_MIN_MULTIPLE_RATIO * tolerance, noise)), _MIN_DEVIATION_RATIO * min(deviations))
    lag = next((lag for lag, deviation in zip(lags, deviations, strict=True) if deviation <= min(limit, largest)), 0)
    ends = powers[0][0], powers[0][-1]
    if lag > 1 and min(ends) < _MIN_POWER_RATIO * max(ends):
        # Other modes decay, or the motion leaves an unstable orbit and has not reached another one.
        lag = 0
    # A slow beat changes the means of long parts. Feedback suppresses it.
    return lag if lag and (feedback or drifts[lag - 1] <= largest) else 0
