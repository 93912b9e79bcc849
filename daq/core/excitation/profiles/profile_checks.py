"""Checks before a test with profile control, from the linear response of the scene with all dampers on their floors.

The check of noise reports lines that do not resolve a resonance, and limits that end next to a resonance. The check of
a sine computes deviations from the profile, and bands of the limits.

The drive amplitude d of a sine is changed after each window by ln d += gain * ln(required / measured amplitude). An
integrator with a delay of m windows is stable for a gain below 2 sin(pi / (2 (2m + 1))). The changing drive has
sidebands about the tone. At an antiresonance, or near a resonance, the structure amplifies the sidebands by a ratio R
relative to the tone. Where R is large, the loop gain, gain R / (2 sin(pi T f)) at the distance f of the sidebands, must
be below 1. In a sweep, the logarithmic deviation at a resonance with the damping ratio D and the decay rate d is S (T /
gain + 1 / d) / (2 D), for the relative sweep rate S and the window T. The check uses the slope of the required drive,
whose largest value is 1 / (2 D). Sidebands of a tone at an end of the band lie outside the band, so the response is
also needed there.
"""

from collections.abc import Iterable, Sequence
from math import ceil, log, pi, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.numerics.runs import runs_of
from rig.core.scene.excitation import SineControl
from rig.core.scene.excitation.profile import ProfileControl
from rig.core.scene.scene import Scene
from rig.core.system.open_loop_drive import accelerations_per_drive

# The drive changes after this number of periods.
WINDOW_PERIODS = 1.0
# An observation takes four periods, so free vibrations at lower resonances have little effect on it.
OBSERVATION_PERIODS = 4.0
# Distances of the sidebands from the tone, in cycles of the drive amplitude per window.
_SIDEBANDS = np.arange(1, 101) / 200.0
# A maximum of the amplification below this value is not a resonance.
_MIN_RESONANCE_AMPLIFICATION = 1.25
# The largest slope within this relative distance yields the damping ratio.
_SLOPE_SEARCH_RATIO = 0.05
# Number of frequencies at which the slope of the drive is computed, several for each half-power width.
_N_FREQUENCIES = 2000
# Largest change of the drive density from line to line [dB]: the largest slope at a resonance, 20 / ln(10) dB over half
# of its half-power width, if the width contains two lines.
_MAX_STEP_DB = 8.69 / 2.0
# The search for a sufficient number of lines ends at this multiple of the lines of the test.
_MAX_LINE_RATIO = 100
# Number of frequencies per line, so the peak between two lines is resolved.
_OVERSAMPLING = 8
# Largest reduction of the drive density by a limit at its end [dB].
_MAX_END_DB = 3.0
# The response is computed in a band that is wider than that of the test by this factor at each end: sidebands farther
# from the tone have a negligible effect on an observation.
_BAND_MARGIN = 1.15


def loop_gain(speed: float, delay: float, amplification: Array | None = None) -> float:
    """Return the gain for a delay in windows.

    `speed`: gain relative to the stability limit; `amplification`: amplification of the sidebands at the distances
    `_SIDEBANDS`.

    >>> [round(loop_gain(1.0, delay), 2) for delay in (1, 2, 3)]
    [1.0, 0.62, 0.45]
    """
    oscillation = 1.0 / (2.0 * (2.0 * ceil(delay) + 1.0))
    limit = 2.0 * sin(pi * oscillation)
    if amplification is not None:
        relevant = oscillation <= _SIDEBANDS
        # At smaller distances, only a resonance (a maximum of the amplification) limits the gain.
        relevant[1:-1] |= (amplification[1:-1] > np.maximum(amplification[:-2], amplification[2:])) & (
            amplification[1:-1] > _MIN_RESONANCE_AMPLIFICATION
        )
        limits = 2.0 * np.sin(pi * _SIDEBANDS[relevant]) / np.maximum(amplification[relevant], 1e-12)
        limit = min(limit, float(limits.min()))
    return speed * limit


def widened(test: SineControl) -> tuple[float, float]:
    """Return the lowest and the highest frequency at which the response is needed [Hz]."""
    low, high = test.band
    return low / _BAND_MARGIN, high * _BAND_MARGIN


def in_band(test: SineControl, frequency: Array) -> NDArray[np.bool_]:
    """Return which frequencies in Hz the sweep contains."""
    low, high = test.band
    return np.asarray((frequency >= low * (1.0 - 1e-9)) & (frequency <= high * (1.0 + 1e-9)), dtype=bool)


class SweepLoop:
    """The control loop of a sweep: the drives that profile and limits require, and the gain of the controller.

    `motion`: amplitudes of the channels per unit of drive [m/s²], shape (channels, n), at `frequency` [Hz], shape (n,);
    `latency`: s. `inside` states which of the frequencies the sweep contains.
    """

    def __init__(self, test: SineControl, frequency: Array, motion: Array, latency: float) -> None:
        self.frequency, self.inside = frequency, in_band(test, frequency)
        self._speed, self._latency = test.speed, latency
        # Shape (1 + limits, n). Outside the band, the drives are those at its ends.
        self.required = test.required(motion, np.clip(frequency, *test.band))

    def gain(self, drive: float, frequency: float, row: int) -> float:
        """Return the gain at a frequency in Hz, at a drive that a `row` of `required` determines."""
        distance = _SIDEBANDS * frequency / WINDOW_PERIODS
        per_drive = 1.0 / self.required[row]
        below, above = (np.interp(frequency + sign * distance, self.frequency, per_drive) for sign in (-1.0, 1.0))
        # An observation plus the latency, in windows.
        delay = (OBSERVATION_PERIODS + self._latency * frequency) / WINDOW_PERIODS
        return loop_gain(self._speed, delay, np.asarray(0.5 * drive * (below + above)))


class SweepCheck(NamedTuple):
    """Expected deviation of a sweep from its profile, and the bands in which a limit determines the drive."""

    test: SineControl
    frequency: float  # frequency of the largest deviation [Hz]
    deviation: float  # dB
    damping: float  # damping ratio of a resonance with this slope of the drive
    notches: tuple[tuple[str, float, float], ...]  # channel, lowest and highest frequency [Hz]

    @property
    def warning(self) -> str:
        """Warning about a sweep that is too fast for the tolerance; empty otherwise."""
        if self.deviation <= self.test.tolerance:
            return ""
        octaves = self.test.rate_at(self.frequency) / log(2.0) * 60.0 * self.test.tolerance / self.deviation
        return (
            f"at {self.frequency:.4g} Hz (damping {100.0 * self.damping:.2g} %) the sweep exceeds the tolerance of "
            f"{self.test.tolerance:g} dB above {octaves:.2g} oct/min. Give a longer duration."
        )

    def lines(self) -> Iterable[str]:
        """Yield the check as text."""
        if self.warning:
            yield self.warning
        else:
            place = f"{self.deviation:.2g} dB at {self.frequency:.4g} Hz (tolerance {self.test.tolerance:g} dB)"
            yield f"expected deviation of the control channels from the profile: at most {place}"
        for channel, low, high in self.notches:
            yield f"{channel} limits the drive from {low:.4g} to {high:.4g} Hz"


def check_sweep(test: SineControl, scene: Scene, channels: Sequence[ChannelInfo], latency: float = 0.0) -> SweepCheck:
    """Check a sweep with the linear response of the scene, with all dampers on their floors; `latency`: s."""
    places, frequency = {info.name: info.at for info in channels}, np.geomspace(*widened(test), _N_FREQUENCIES)
    motion = accelerations_per_drive(scene, [places[name] for _, name in test.named_channels], 2.0 * pi * frequency)
    loop = SweepLoop(test, frequency, motion, latency)
    limiting, drives, inside = loop.required.argmin(axis=0), loop.required.min(axis=0), np.flatnonzero(loop.inside)
    slopes = abs(np.gradient(np.log(drives), np.log(frequency)))
    columns, deviations = (row[inside].tolist() for row in (frequency, slopes, drives, limiting)), list[float]()
    for f, slope, drive, row in zip(*columns, strict=True):
        lag = WINDOW_PERIODS / f / loop.gain(drive, f, row) + slope / (pi * f)
        deviations.append(20.0 / log(10.0) * test.rate_at(f) * slope * lag)
    worst = int(inside[np.argmax(deviations)])
    notches = [
        (limit.channel, float(frequency[inside[start]]), float(frequency[inside[stop - 1]]))
        for index, limit in enumerate(test.limits, 1)
        for start, stop in runs_of(limiting[inside] == index)
    ]
    # The slope is largest at the half-power points of the resonance or antiresonance.
    near = abs(np.log(frequency / frequency[worst])) < _SLOPE_SEARCH_RATIO
    damping = 0.5 / max(float(slopes[near].max()), 1e-12)
    return SweepCheck(test, float(frequency[worst]), max(deviations), damping, tuple(notches))


def line_warnings(test: ProfileControl, scene: Scene, channels: Iterable[ChannelInfo]) -> Iterable[str]:
    """Yield warnings from the linear response with resting dampers; `test`: one with densities."""
    assert test.resolution is not None
    low, high = test.profile.frequencies[0], test.profile.frequencies[-1]
    count = round((high - low) / test.resolution)
    places = {info.name: info.at for info in channels}
    positions = [places[name] for _, name in test.named_channels]

    def required_at(lines: int) -> tuple[Array, Array]:
        frequency = np.linspace(low, high, _OVERSAMPLING * lines + 1)
        amplitudes = accelerations_per_drive(scene, positions, 2.0 * pi * frequency)
        return frequency, test.decibels(test.required(amplitudes**2, frequency))

    frequency, required = required_at(count)
    worst, step = _largest_step(required)
    if step > _MAX_STEP_DB:
        # More lines resolve a higher slope, so they are counted again.
        needed, remaining = count, step
        while remaining > _MAX_STEP_DB and needed < _MAX_LINE_RATIO * count:
            needed = ceil(needed * remaining / _MAX_STEP_DB)
            _, remaining = _largest_step(required_at(needed)[1])
        yield (
            f"near {frequency[worst]:.4g} Hz the drive density changes by {step:.1f} dB from line to line: the "
            "lines do not resolve the response, and channels deviate between them. Give test.lines of "
            f"{needed} or more."
        )
    for limit, row in zip(test.limits, required[1:], strict=True):
        inside = np.flatnonzero(np.isfinite(row))
        for end, stated in (
            ((inside[0], limit.frequencies[0]), (inside[-1], limit.frequencies[-1])) if inside.size else ()
        ):
            reduction = float(required[0, end] - row[end])
            if 0 < end < frequency.size - 1 and reduction > _MAX_END_DB:
                yield (
                    f"the limit of {limit.channel} ends at {stated:.4g} Hz, where it reduces the drive density "
                    f"by {reduction:.1f} dB: beyond this frequency, the channel exceeds the limit. Extend the "
                    "limit beyond the resonance."
                )


def _largest_step(required: Array) -> tuple[int, float]:
    """Return the index of the largest change of the drive density from line to line, and this change [dB].

    Where another channel begins to determine the drive, its density may jump; these changes do not count. `required`:
    density that each channel requires [dB], (channels, frequencies).
    """
    determining, drive = required.argmin(axis=0), required.min(axis=0)
    steps = _OVERSAMPLING * np.where(np.diff(determining) == 0, abs(np.diff(drive)), 0.0)
    worst = int(np.argmax(steps))
    return worst, float(steps[worst])
