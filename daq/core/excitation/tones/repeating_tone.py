"""A tone that determines the number of its periods after which a motion repeats.

Impacts can multiply the period of a motion, or make it chaotic or quasi-periodic, even if its envelope at the frequency
of the tone is nearly constant.
"""

from collections import defaultdict
from collections.abc import Generator, Sequence
from math import ceil

import numpy as np

from daq.core.excitation.controlled import Controlled
from daq.core.excitation.lock_in import whole_periods
from daq.core.excitation.sensor_settling import wait_for_sensors
from daq.core.excitation.station import Station
from daq.core.excitation.tones.steady_tone import WINDOW_S, SteadyTone
from rig.core.base.arrays import Array
from rig.core.results.text import format_frequencies
from rig.core.scene.excitation import Settle

# A motion that repeats after at most this number of periods of the tone is periodic.
_MAX_REPEATED_PERIODS = 4
# The period is a multiple only if successive periods differ by more than this multiple of the smallest difference,
# which is an estimate of the noise. Differences by noise are equal to 20 %.
_MIN_DIFFERENCE_RATIO = 2.0
# Smaller differences of successive periods, relative to the tolerance of steady state, belong to transients.
_MIN_MULTIPLE_RATIO = 0.25
# If the difference of successive periods in the second half of a measurement is below this fraction of that in the
# whole, it is a transient. With constant drive it was 0.94 to 1.15 for doubled and tripled periods of eleven scenes.
_MAX_DECAY = 0.9
# Smallest growth of the differences of a slow beat beyond those of the first periods. Those of decaying modes grow by
# up to 1.15, if their distance to the tone is above 1/8 of its frequency.
_MIN_BEAT_GROWTH = 1.5
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
        self._noise = 0.0  # standard deviation of the displacement amplitude in a window by noise [m]
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
        # White noise with the variance step^2 / 12 has the variance step^2 / (3 n) in an amplitude from n samples.
        quantization = float(np.linalg.norm(self._quantity.weights(self.frequency) * steps)) / (3 * self.window) ** 0.5
        self._noise = float(np.hypot(np.std(amplitudes), quantization))

    def relative_noise(self, motion: float) -> float:
        """Return an upper estimate of the noise in a window, relative to a displacement amplitude in m."""
        return _NOISE_MARGIN**0.5 * self._noise / max(motion, 1e-300)

    def repetition(self, samples: Array, motion: float, feedback: float = 0.0) -> int:
        """Return the number of periods of the tone after which a motion repeats, as far as noise permits; 0: none.

        `samples`: of the first channel of the motion, at constant frequency; `motion`: displacement amplitude [m];
        `feedback`: relative change of the motion in a period by changes of the drive.
        """
        # The windows of the comparison have two periods, and a Hann window has 1.5 times the noise.
        ratio = (1.5 * len(_COMPARED_ORDERS) * self.window * self.frequency / self.rate / 2.0) ** 0.5
        noise = ratio * self.relative_noise(motion)
        differences, decay = irregularity_and_decay(samples, self.frequency, self.rate)
        return repetition(differences, decay, self._settle.tolerance, noise, feedback)

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
                    else f"the motion is irregular at {where}. These points are marked as not settled. Choose a level "
                    "with a periodic motion, often a higher one, or increase test.settle.tolerance."
                )
                self.station.warn(f"level {self.station.level_text(level)}: {text}")
        self._repetitions.clear()


def irregularity(samples: Array, frequency: float, rate: float) -> list[float]:
    """Return the differences of a motion after 1, 2, ... periods, up to half of the periods in its samples.

    The differences are relative to the amplitude of the motion at its frequency in Hz. Chaotic and quasi-periodic
    motions do not repeat, even if their envelopes at the frequency are nearly constant. `rate`: sample rate [Hz].

    >>> t = np.arange(400)
    >>> doubled, beating = (np.sin(t) + 0.1 * np.sin(ratio * t) for ratio in (0.5, 0.43))
    >>> [difference < 1e-3 for difference in irregularity(doubled, 1.0, 2.0 * np.pi)[:4]]
    [False, True, False, True]
    >>> min(irregularity(beating, 1.0, 2.0 * np.pi)[:4]) > 0.02
    True
    """
    period = rate / frequency
    # Amplitudes in Hann windows of two periods that begin one period apart, shape (windows, orders).
    rows = []
    for start in range(max(int(samples.size / period + 1e-6) - 1, 1)):
        first = ceil(start * period)
        inside = samples[first : ceil((start + 2) * period)]
        local = (first + np.arange(inside.size)) / period - start
        window = np.sin(0.5 * np.pi * local) ** 2
        turns = [np.exp(-2j * np.pi * order * local) for order in _COMPARED_ORDERS]
        rows.append([2.0 * np.sum(window * turn * inside) / np.sum(window) for turn in turns])
    amplitudes = np.array(rows)
    scale = 2.0**0.5 * max(abs(complex(np.mean(amplitudes[:, 0]))), 1e-300)
    return [
        float(np.sqrt(np.mean(np.sum(abs(amplitudes[lag:] - amplitudes[:-lag]) ** 2, axis=1)))) / scale
        for lag in range(1, len(rows) // 2 + 1)
    ] or [0.0]


def irregularity_and_decay(samples: Array, frequency: float, rate: float) -> tuple[list[float], float]:
    """Return the irregularity, and the ratio of its first difference in the second half of the samples to this one."""
    every, latest = (irregularity(part, frequency, rate) for part in (samples, samples[samples.size // 2 :]))
    # A measurement of a few periods does not show whether their differences decrease.
    return every, latest[0] / max(every[0], 1e-300) if any(latest) else 1.0


def repetition(
    differences: Sequence[float], decay: float, tolerance: float, noise: float, feedback: float = 0.0
) -> int:
    """Return the number of periods after which a motion repeats, from the result of `irregularity`; 0: none.

    `decay`: ratio of the difference after one period in the second half of the samples to that in all samples;
    `tolerance`: of steady state; `noise`: largest expected difference by noise; `feedback`: change of the motion in a
    period by changes of the drive; all relative to the motion.

    >>> repetition([0.5, 0.01, 0.5, 0.01], 1.0, 0.1, 0.0), repetition([0.04, 0.05, 0.04, 0.05], 1.0, 0.1, 0.0)
    (2, 1)
    """
    # The force of a motion that does not repeat differs from that of the orbit by about as much as its periods.
    largest = float(np.linalg.norm([tolerance, noise, _MAX_REPEATED_PERIODS * feedback]))
    first = differences[:_MAX_REPEATED_PERIODS]
    if decay < _MAX_DECAY:
        # Other modes decay. They do not change the amplitude at the frequency of the tone. Their differences are about
        # equal in near and distant periods; those of a slow beat grow.
        beat_limit = max(_TWO_DEVIATIONS * largest, _MIN_BEAT_GROWTH * max(first))
        return int(min(first) <= largest and (feedback > 0.0 or max(differences) <= beat_limit))
    limit = min(_TWO_DEVIATIONS * largest, max(_MIN_MULTIPLE_RATIO * tolerance, _MIN_DIFFERENCE_RATIO * min(first)))
    lag = next((lag for lag, difference in enumerate(first, 1) if difference <= limit), 0)
    # A slow beat becomes apparent in distant periods. Feedback suppresses it.
    is_beat = lag and not feedback and differences[len(differences) // lag * lag - 1] > _TWO_DEVIATIONS * largest
    return 0 if is_beat else lag
