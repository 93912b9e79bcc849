"""Detection of the steps of a stepped sine: a real bench does not mark them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from daq.excitation.lock_in import lock_in, min_samples, whole_periods
from daq.importing.assignment import Assigned
from daq.importing.held_tones import HeldTone, held_tones
from daq.importing.tone_track import ToneTracker
from daq.recording.recorder import Recorder
from daq.signal_chain.channel import ChannelInfo
from rig.arrays import Array
from rig.scene.excitation import Sine, SteppedSine
from rig.scene.scene import Scene

# Ratio by which the searched band exceeds that of the scene's test at either end: the real test may be wider.
_BAND_RATIO = 1.5
# Minimum number of windows whose phases determine a frequency.
_MIN_WINDOWS = 8
# Maximum number of samples of a window.
_MAX_WINDOW = 1 << 16
# Relative difference of frequency below which two steps are the same.
_SAME_FREQUENCY = 1e-5


class StepFinder:
    """Detects the steps of a sine or stepped sine, piece by piece, in the channel that shows the excitation best."""

    def __init__(self, scene: Scene, infos: Sequence[ChannelInfo], rate: float) -> None:
        assert isinstance(scene.test, Sine | SteppedSine)
        self._test, self._rate = scene.test, rate
        # The followed channel: a force, the drive, the table, or else the first.
        table = scene.at_driven("table") if scene.driven_shaker is not None else "table"
        reported = [
            *(row for row, info in enumerate(infos) if info.quantity == "force"),
            *(row for place in ("drive", table) for row, info in enumerate(infos) if info.at.startswith(place)),
        ]
        self.row = reported[0] if reported else 0
        self._info = infos[self.row]
        run = (scene.test.frequency,) if isinstance(scene.test, Sine) else scene.test.order
        self._tracker = ToneTracker(rate, min(run) / _BAND_RATIO, max(run) * _BAND_RATIO, self.row)

    def add(self, volts: Array) -> None:
        """Add the next samples, shape (channels, samples)."""
        self._tracker.add(volts)

    def mark(self, recorder: Recorder, followed: Assigned) -> list[str]:
        """Mark the settled part of each step, from the samples of the followed channel; warn if there is none."""
        present = followed.signal.samples

        def read(first: int, stop: int) -> Array:
            volts = np.full(stop - first, np.nan)
            if present > first:
                volts[: present - first] = followed.volts(first, min(stop, present))
            return volts

        tolerance = self._test.settle.tolerance if isinstance(self._test, SteppedSine) else 1e-3
        tones = _refined(held_tones(self._tracker.tracks(), tolerance), read, self._rate)
        if not tones:
            return [
                f"no step was detected: the scene's test is a {self._test.kind}, but {followed.channel.name} holds no "
                "tone of constant frequency for ten periods above its noise. Check for swapped columns or another "
                "test (test: kind: swept_sine, random)."
            ]
        for number, (direction, members) in enumerate(_passes([tone.frequency for tone in tones])):
            level = self._level([tones[index] for index in members], number)
            for tone in (tones[index] for index in members):
                recorder.mark(
                    "measure",
                    tone.first,
                    tone.stop - 1,
                    frequency=tone.frequency * self._rate,
                    level=level,
                    direction=direction,
                    settled=tone.settled,
                )
        return []

    def _level(self, tones: Sequence[HeldTone], number: int) -> float:
        """Return the level of a pass: the test's level nearest to the force, or else the next level."""
        test = self._test
        if isinstance(test, Sine):
            return float(test.force if test.force is not None else test.drive or 0.0)
        if self._info.quantity == "force" and test.force is not None:
            frequency = np.array([tone.frequency for tone in tones]) * self._rate
            gain = abs(self._info.response(frequency)) * self._info.sensitivity
            force = float(np.median([tone.amplitude for tone in tones] / gain))
            return min(test.levels, key=lambda level: abs(np.log(level / force)))
        passes_per_level = 2 if test.direction == "both" else 1
        return test.levels[min(number // passes_per_level, len(test.levels) - 1)]


def _passes(frequencies: Sequence[float]) -> list[tuple[str, list[int]]]:
    """Divide steps into passes through the frequencies: direction and steps of each.

    >>> _passes([1.0, 2.0, 3.0, 3.0, 2.0, 1.0]), _passes([1.0, 2.0, 1.0, 2.0])
    ([('up', [0, 1, 2]), ('down', [3, 4, 5])], [('up', [0, 1]), ('up', [2, 3])])
    >>> _passes([5.0])
    [('up', [0])]
    """
    tolerance = _SAME_FREQUENCY * np.asarray(frequencies[1:])
    change = np.diff(frequencies)
    signs = np.where(abs(change) <= tolerance, 0, np.sign(change)).astype(int).tolist()
    passes: list[tuple[int, list[int]]] = []
    for index, (sign_before, sign_after) in enumerate(zip([0, *signs], [*signs, 0], strict=True)):
        if not passes or sign_before != passes[-1][0]:
            passes.append((sign_after or sign_before or 1, []))
        passes[-1][1].append(index)
    return [("up" if sign > 0 else "down", members) for sign, members in passes]


def _refined(tones: Sequence[HeldTone], read: Callable[[int, int], Array], rate: float) -> list[HeldTone]:
    """Refine the frequencies by the phases of windows, with harmonics fitted."""
    plans = []
    for tone in tones:
        frequency, length = tone.frequency * rate, tone.stop - tone.first
        size = whole_periods(frequency, rate, min(length // _MIN_WINDOWS, _MAX_WINDOW) / rate)
        if size < min_samples(frequency, rate) or 2 * size > length:
            size = length // 2
        plans.append((tone, size))
    bounds = [(start, start + size) for tone, size in plans for start in range(tone.first, tone.stop - size + 1, size)]
    samples = _read_segments(read, bounds)
    return [replace(tone, frequency=_frequency(tone, size, samples, rate)) for tone, size in plans]


def _frequency(tone: HeldTone, size: int, samples: Iterator[Array], rate: float) -> float:
    """Frequency by the advance of the phase from window to window, periods per sample."""
    starts = np.arange(tone.first, tone.stop - size + 1, size)
    phases = np.array([lock_in(next(samples)[None], tone.frequency * rate, rate)[0] for _ in starts])
    # Residual phase after the turns of the present frequency.
    residual = np.unwrap(np.angle(phases * np.exp(-2j * np.pi * np.fmod(tone.frequency * (starts - starts[0]), 1.0))))
    residual, starts = residual[np.isfinite(residual)], starts[np.isfinite(residual)]
    if residual.size < 2:
        return tone.frequency
    return tone.frequency + float(np.polyfit(starts - starts[0], residual, 1)[0]) / (2.0 * np.pi)


def _read_segments(read: Callable[[int, int], Array], bounds: Sequence[tuple[int, int]]) -> Iterator[Array]:
    """Yield the samples of ordered segments without overlap; the samples between them are read as well, in pieces."""
    position = 0
    for first, stop in bounds:
        while position < first:
            end = min(first, position + _MAX_WINDOW)
            read(position, end)
            position = end
        yield read(first, stop)
        position = stop
