"""Detection of the dwells of a sine or stepped-sine test in an imported file, which has no markers."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from daq.core.excitation.lock_in import lock_in, min_samples, whole_periods
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from daq.extras.importing.assignment import AssignedSignal
from daq.extras.importing.dwells import Dwell, dwells
from daq.extras.importing.tone_track import ToneTracker
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene

# The searched frequency band extends beyond the band of the scene's test by this factor at either end: the scene may
# state the band only roughly.
_BAND_RATIO = 1.5
# Number of blocks into which a tone is divided; fewer if `lock_in` needs longer blocks.
_BLOCKS_PER_TONE = 8
# Number of samples of a block, to limit the memory.
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
        reference_rows = [
            *(row for row, info in enumerate(channels) if info.quantity == "force"),
            *(
                row
                for position in ("drive", table)
                for row, info in enumerate(channels)
                if info.at.startswith(position)
            ),
        ]
        self.reference_row = reference_rows[0] if reference_rows else 0
        self._reference = channels[self.reference_row]
        test_hz = scene.test.dwells
        self._tracker = ToneTracker(rate, min(test_hz) / _BAND_RATIO, max(test_hz) * _BAND_RATIO, self.reference_row)

    def add(self, volts: Array) -> None:
        """Add the next samples, shape (channels, samples)."""
        self._tracker.add(volts)

    def mark(self, recorder: Recorder, reference: AssignedSignal) -> list[str]:
        """Mark the steady part of each dwell; return a warning if no dwell is detected."""
        tolerance = self._test.steady_state.tolerance
        tones = _refine_frequencies(dwells(self._tracker.tracks(), tolerance), reference.volts, self._rate)
        if not tones:
            return [
                f"no dwell was detected: the scene's test is a {self._test.kind}, but {reference.channel.name} has no "
                "tone of constant frequency for ten periods above its noise. Check whether columns are swapped, or "
                "the test was another (such as kind: swept_sine)."
            ]
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


def _refine_frequencies(tones: Sequence[Dwell], read: Callable[[int, int], Array], rate: float) -> list[Dwell]:
    """Return the dwells with frequencies refined by the phases of successive blocks, fitted with harmonics."""
    tone_blocks = []
    for tone in tones:
        frequency, tone_samples = tone.frequency * rate, tone.stop - tone.first
        block_samples = whole_periods(frequency, rate, min(tone_samples // _BLOCKS_PER_TONE, _MAX_BLOCK) / rate)
        if block_samples < min_samples([frequency], rate) or 2 * block_samples > tone_samples:
            block_samples = tone_samples // 2
        tone_blocks.append((tone, block_samples))
    segments = [
        (start, start + size) for tone, size in tone_blocks for start in range(tone.first, tone.stop - size + 1, size)
    ]
    samples = _read_segments(read, segments)
    return [replace(tone, frequency=_refined_frequency(tone, size, samples, rate)) for tone, size in tone_blocks]


def _refined_frequency(tone: Dwell, block_samples: int, samples: Iterator[Array], rate: float) -> float:
    """Return the frequency from the advance of the phase from block to block, periods per sample."""
    starts = np.arange(tone.first, tone.stop - block_samples + 1, block_samples)
    phases = np.array([lock_in(next(samples)[None], [tone.frequency * rate], rate)[0, 0] for _ in starts])
    # Phase advance that the current frequency does not explain.
    residual = np.unwrap(np.angle(phases * np.exp(-2j * np.pi * np.fmod(tone.frequency * (starts - starts[0]), 1.0))))
    residual, starts = residual[np.isfinite(residual)], starts[np.isfinite(residual)]
    if residual.size < 2:
        return tone.frequency
    return tone.frequency + float(np.polyfit(starts - starts[0], residual, 1)[0]) / (2.0 * np.pi)


def _read_segments(read: Callable[[int, int], Array], segments: Sequence[tuple[int, int]]) -> Iterator[Array]:
    """Yield the samples of ordered segments without overlap; the ranges between them are read and discarded."""
    position = 0
    for first, stop in segments:
        while position < first:
            end = min(first, position + _MAX_BLOCK)
            read(position, end)
            position = end
        yield read(first, stop)
        position = stop
