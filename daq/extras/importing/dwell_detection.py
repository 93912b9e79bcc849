"""Detection of the dwells of a sine or stepped-sine test in an imported file, which has no markers."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from daq.core.excitation.lock_in import lock_in, whole_periods
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.importing.assignment import AssignedSignal
from daq.extras.importing.dwells import Dwell, dwells
from daq.extras.importing.tone_track import LENGTH_RATIO, ToneTracker
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene

# The searched frequency band extends beyond the band of the scene's test by this factor at either end: the scene may
# state the band only roughly.
_BAND_RATIO = 1.5
# Highest frequency, as a ratio to the sample rate.
_MAX_FREQUENCY_RATIO = 0.35
# Maximum number of blocks of a dwell, and of samples in a block, from whose phases its frequency is estimated.
_BLOCKS_PER_TONE = 8
_MAX_BLOCK = 1 << 16
# Two dwells have the same frequency if the frequencies differ by less than this fraction, the error of two sample
# clocks.
_SAME_FREQUENCY = 1e-5


class DwellDetector:
    """Detects dwells, block by block, in the reference: the channel that best represents the excitation."""

    def __init__(self, scene: Scene, channels: Sequence[ChannelInfo], rate: float) -> None:
        assert scene.test is not None
        self._test, self._rate = scene.test, rate
        # The reference is a force, otherwise the drive, otherwise the motion of the table, otherwise the first channel.
        table = scene.at_driven("table") if scene.driven_shaker is not None else "table"
        reference_rows = [row for row, info in enumerate(channels) if info.quantity == "force"]
        for position in ("drive", table):
            reference_rows += [row for row, info in enumerate(channels) if info.at.startswith(position)]
        self.reference_row = reference_rows[0] if reference_rows else 0
        self._reference = channels[self.reference_row]
        # Shorter blocks resolve higher tones.
        low = min(scene.test.dwells) / _BAND_RATIO
        high = min(max(scene.test.dwells) * _BAND_RATIO, _MAX_FREQUENCY_RATIO * rate)
        count = max(1, int(np.ceil(np.log(max(high / low, 1.0)) / np.log(LENGTH_RATIO))))
        self._trackers = [
            ToneTracker(rate, low * LENGTH_RATIO**k, len(channels), self.reference_row) for k in range(count)
        ]

    def add(self, volts: Array) -> None:
        """Add the next samples, shape (channels, samples)."""
        for tracker in self._trackers:
            tracker.add(volts)

    def mark(self, recorder: Recorder, reference: AssignedSignal) -> list[str]:
        """Mark the steady part of each dwell; return a warning if no dwell is detected."""
        tones = dwells([tracker.track() for tracker in self._trackers], self._test.steady_state.tolerance)
        if not tones:
            return [
                f"no dwell was detected: the scene's test is a {self._test.kind}, but {self._reference.name} has no "
                "tone of constant frequency for ten periods above its noise. Check whether columns are swapped, or "
                "the test was another (such as kind: swept_sine)."
            ]
        tones = [replace(tone, frequency=_refined_frequency(tone, reference.volts, self._rate)) for tone in tones]
        for pass_number, (direction, indices) in enumerate(_passes([tone.frequency for tone in tones])):
            tones_of_pass = [tones[index] for index in indices]
            level = self._level(tones_of_pass, pass_number)
            for tone in tones_of_pass:
                recorder.mark(
                    "measure",
                    tone.first,
                    tone.stop - 1,
                    frequency=tone.frequency * self._rate,
                    level=level,
                    direction=direction,
                    settled=tone.steady,
                )
        return []

    def _level(self, tones: Sequence[Dwell], pass_number: int) -> float:
        """Return the level of a pass: nearest to the measured force; without a force channel, by its number."""
        test = self._test
        if self._reference.quantity == "force" and test.level_key == "force":
            frequency = np.array([tone.frequency for tone in tones]) * self._rate
            gain = abs(self._reference.response(frequency)) * self._reference.sensitivity
            force = float(np.median([tone.amplitude for tone in tones] / gain))
            return min(test.levels, key=lambda level: abs(np.log(level / force)))
        passes_per_level = 2 if test.sweep_direction == "both" else 1
        return test.levels[min(pass_number // passes_per_level, len(test.levels) - 1)]


def _passes(frequencies: Sequence[float]) -> list[tuple[str, list[int]]]:
    """Divide dwells into passes through the frequencies; return direction and indices of the dwells of each pass.

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
    return [("up" if sign > 0 else "down", indices) for sign, indices in passes]


def _refined_frequency(tone: Dwell, read: Callable[[int, int], Array], rate: float) -> float:
    """Return the frequency, in periods per sample, by the phases in blocks that are fitted with harmonics."""
    count = tone.stop - tone.first
    size = whole_periods(tone.frequency * rate, rate, min(count // _BLOCKS_PER_TONE, _MAX_BLOCK) / rate)
    size = min(size, count // 2)
    starts = np.linspace(0, count - size, min(count // size, _BLOCKS_PER_TONE)).astype(int)
    blocks = (read(tone.first + start, tone.first + start + size)[None] for start in starts.tolist())
    phasors = np.array([lock_in(block, [tone.frequency * rate], rate)[0, 0] for block in blocks])
    # Phase advance that the current frequency does not explain.
    residual = np.unwrap(np.angle(phasors * np.exp(-2j * np.pi * np.fmod(tone.frequency * starts, 1.0))))
    starts, residual = starts[np.isfinite(residual)], residual[np.isfinite(residual)]
    slope = float(np.polyfit(starts, residual, 1)[0]) if residual.size > 1 else 0.0
    return tone.frequency + slope / (2.0 * np.pi)
