"""Signals for viewers in a recording: decimated waveforms after an anti-aliasing filter, rms and peak.

Each message of a signal contains one number, in an encoding that general MCAP viewers plot by default. Transforms
(positions of its parts) move the drawn rig; the exaggeration is the factor on displacements and gaps in the drawing.
"""

import math
import struct
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from daq.core.mcap_file.protobuf import Schema
from daq.core.mcap_file.writer import Message, Messages
from daq.core.recording import layout
from daq.core.recording.displacement import DisplacementFilter, motion_sources
from daq.core.recording.robot_description import TRANSFORMS_SCHEMA, RobotDescription
from daq.core.recording.sample_groups import Group, Grouping
from daq.core.recording.truth import Register, Truth
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array
from rig.core.scene.scene import Scene

# Highest sample rate [Hz] of the displayed waveforms: a viewer shows modes of the rig smoothly and stays fast.
MAX_RATE_HZ = 250.0
# Number of display samples from one transform to the next.
TRANSFORM_STEP = 2
# The anti-aliasing filter is flat up to 0.27 of the display rate. It attenuates by 44 dB at 0.5, where aliasing begins,
# and by 70 dB from 0.52 on. Half the length of the filter, display samples.
_HALF_LENGTH = 8
# Shape parameter of the filter's Kaiser window.
_KAISER_BETA = 6.8
# Cutoff frequency (-6 dB) of the filter, as a ratio to the display rate.
_CUTOFF = 0.385
# Maximum number of multiplications of a product: OpenBLAS divides a larger product among threads, which wait longer.
_MAX_PRODUCT = 2**18

_RULE = "=" * 80
FLOAT_SCHEMA = Schema(
    "std_msgs/msg/Float64MultiArray",
    "ros2msg",
    (
        "std_msgs/MultiArrayLayout layout\nfloat64[] data\n"
        f"{_RULE}\nMSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n"
        f"{_RULE}\nMSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n"
    ).encode(),
    "cdr",
)
TEXT_SCHEMA = Schema("std_msgs/msg/String", "ros2msg", b"string data\n", "cdr")

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
# Bytes before the element: no dimensions, no offset, one element, padding to eight bytes.
_MESSAGE_HEAD = np.frombuffer(struct.pack("<4sIII4x", _LITTLE_ENDIAN, 0, 0, 1), np.uint8)


def encode_floats(values: Array) -> NDArray[np.uint8]:
    """Encode each number as a std_msgs/msg/Float64MultiArray of one element; the bytes are along a new last axis.

    >>> encode_floats(np.ones((2, 3))).shape
    (2, 3, 28)
    """
    messages = np.empty((*values.shape, _MESSAGE_HEAD.size + 8), np.uint8)
    messages[..., : _MESSAGE_HEAD.size] = _MESSAGE_HEAD
    messages[..., _MESSAGE_HEAD.size :] = np.ascontiguousarray(values, "<f8")[..., None].view(np.uint8)
    return messages


def encode_text(text: str) -> bytes:
    r"""Encode a std_msgs/msg/String.

    >>> encode_text("rig")[4:]
    b'\x04\x00\x00\x00rig\x00'
    """
    content = text.encode() + b"\0"
    return struct.pack(f"<4sI{len(content)}s", _LITTLE_ENDIAN, len(content), content)


def display_step(rate: float) -> int:
    """Return the number of samples from one display sample to the next, for a sample rate in Hz.

    >>> 5120.0 / display_step(5120.0)
    243.8095238095238
    """
    return max(1, math.ceil(rate / MAX_RATE_HZ))


class DisplayDecimator:
    """Filters signals by a low-pass filter, and outputs the samples whose numbers are multiples of `step`.

    The filter has linear phase, and its delay is removed: an output is available half a filter length later. Before the
    first and after the last sample, the signal is continued as a constant. `stop` is the index of the next sample,
    None before the first sample and after `finish`.
    """

    def __init__(self, step: int) -> None:
        self.step = step
        self._half_length = _HALF_LENGTH * step if step > 1 else 0
        self._taps = np.ones(1)
        if step > 1:
            abscissa = np.arange(-self._half_length, self._half_length + 1) * (2 * _CUTOFF / step)
            taps = np.sinc(abscissa) * np.kaiser(abscissa.size, _KAISER_BETA)
            self._taps = taps / taps.sum()
        self._samples = np.empty((0, 0))
        self._first = 0
        self.stop: int | None = None
        self._next_output = 0

    def run(self, first: int, samples: Array) -> tuple[NDArray[np.int64], Array]:
        """Filter the next samples, shape (signals, samples), the first with the number `first`.

        Returns sample indices and values of the outputs, shape (signals, outputs). Call `finish` before a gap.
        """
        if self.stop is None:
            self._samples = np.repeat(samples[:, :1], self._half_length, axis=1)
            self._first, self._next_output = first - self._half_length, -(-first // self.step)  # rounded up
        self._samples = np.concatenate([self._samples, samples], axis=1)
        self.stop = first + samples.shape[1]
        last = (self.stop - 1 - self._half_length) // self.step
        return self._output_until(last)

    def finish(self) -> tuple[NDArray[np.int64], Array]:
        """Return the remaining outputs after at least one sample; the next samples start a new signal."""
        assert self.stop is not None
        self._samples = np.concatenate(
            [self._samples, np.repeat(self._samples[:, -1:], self._half_length, axis=1)], axis=1
        )
        output = self._output_until((self.stop - 1) // self.step)
        self.stop = None
        return output

    def _output_until(self, last: int) -> tuple[NDArray[np.int64], Array]:
        """Return sample indices and values of the next outputs, up to and including sample `last` * `step`."""
        output_samples = np.arange(self._next_output, last + 1, dtype=np.int64) * self.step
        if output_samples.size == 0:
            return output_samples, np.empty((self._samples.shape[0], 0))
        begin = int(output_samples[0]) - self._half_length - self._first
        end = int(output_samples[-1]) + self._half_length + 1 - self._first
        values = self._samples[:, begin:end]
        if self.step > 1:
            values = _filter_and_decimate(values, self._taps, self.step)
        self._next_output = last + 1
        n_consumed = max(0, self._next_output * self.step - self._half_length - self._first)
        # The copy frees the consumed samples.
        self._samples, self._first = self._samples[:, n_consumed:].copy(), self._first + n_consumed
        return output_samples, np.asarray(values)


def _filter_and_decimate(samples: Array, taps: Array, step: int) -> Array:
    """Return the filtered signals at every `step`-th sample, shape (signals, outputs), by polyphase decimation."""
    # The length of the filter is a multiple of `step`, plus one sample. A matrix product multiplies each segment of
    # `step` samples of the signals by each segment of the filter; the sums along its diagonals are the outputs.
    filter_steps = taps.size // step
    n_outputs = samples.shape[1] // step - filter_steps + 1
    result = taps[-1] * samples[:, filter_steps * step :: step][:, :n_outputs]
    filter_segments = taps[:-1].reshape(filter_steps, step).T
    max_outputs = max(1, _MAX_PRODUCT // taps.size - filter_steps)
    for first in range(0, n_outputs, max_outputs):
        outputs = result[:, first : first + max_outputs]
        stop = first + outputs.shape[1] + filter_steps - 1
        signals = samples[:, first * step : stop * step].reshape(len(samples), -1, step)
        partial_sums = signals @ filter_segments
        for k in range(filter_steps):
            outputs += partial_sums[:, k : k + outputs.shape[1], k]
    return result


class Display:
    """Makes the messages for viewers: waveform, rms and peak of each channel, and transforms that move the drawn rig.

    If the truth (the simulated motion) is recorded, it moves the dampers and the points without a displacement channel.
    `scale` are the factors from stored numbers to the units of the channels, shape (channels, 1).
    """

    def __init__(
        self,
        scene: Scene,
        channels: Sequence[ChannelInfo],
        scale: Array,
        clock: layout.Timebase,
        truth: Truth | None,
        register: Register,
    ) -> None:
        self._clock, self._truth, self._scale = clock, truth, scale
        # The recorder's groups are converted in longer groups.
        groups = min(layout.MAX_DISPLAY_GROUPS, max(1, layout.MAX_DISPLAY_CHANNELS // len(channels)))
        self._groups = Grouping(len(channels), groups * layout.flush_length(clock.rate), np.dtype(float))
        self._decimator = DisplayDecimator(display_step(clock.rate))
        # Numbers of the topics: waveforms, and rms and peak of each channel.
        self._waveforms: list[int] = []
        self._levels: list[int] = []
        for info in channels:
            fields = {"unit": info.unit, "sensor": info.name, "direction": "up"}
            names = (f"{layout.DISPLAY}{info.name}{suffix}" for suffix in ("", "/rms", "/peak"))
            waveform, *levels = (register(name, FLOAT_SCHEMA, fields) for name in names)
            self._waveforms.append(waveform)
            self._levels += levels
        self._robot = RobotDescription(scene, with_dampers=truth is not None)
        factor = {"exaggeration": f"{self._robot.exaggeration:g}"}
        self._description = register(layout.ROBOT, TEXT_SCHEMA, factor)
        self._transforms = register(layout.TRANSFORMS, TRANSFORMS_SCHEMA, factor)
        self._sources = motion_sources(self._robot.points, channels, truth is not None)
        rows = {info.name: row for row, info in enumerate(channels)}
        rate = clock.rate / self._decimator.step
        # Row of the channel, and filter to displacement, for each point with a channel.
        self._filters = {
            source.point: (rows[source.channel], DisplacementFilter(source.quantity, rate))
            for source in self._sources
            if source.channel is not None
        }
        # By kind of topic: number of messages so far on each topic.
        self._n_messages = {"waveform": 0, "level": 0, "transform": 0}

    def _sequence(self, kind: str, count: int) -> NDArray[np.int64]:
        """Return the numbers of the next messages on each topic of a kind."""
        self._n_messages[kind] += count
        return np.arange(self._n_messages[kind] - count, self._n_messages[kind])

    def introduction(self) -> Message:
        """Return the message that describes the rig."""
        time = self._clock.time_ns(0)
        return Message(self._description, time, time, encode_text(self._robot.urdf()), 0)

    def description(self) -> dict[str, str]:
        """Return the fields of the metadata record `display`."""
        sources = {f"motion.{source.point}": source.sentence for source in self._sources}
        rate = self._clock.rate / self._decimator.step
        return {
            "rate_hz": repr(rate),
            "low_pass": f"linear-phase FIR, -6 dB at {_CUTOFF * rate:.4g} Hz" if self._decimator.step > 1 else "none",
            "transforms_rate_hz": repr(rate / TRANSFORM_STEP),
            "exaggeration": f"{self._robot.exaggeration:g}",
            **sources,
        }

    def add(self, group: Group | None, stop: int) -> Iterator[Messages]:
        """Add the stored samples up to sample index `stop` (None: no samples); yield the completed messages."""
        for first, samples in group.acquired() if group is not None else ():
            self._groups.skip(first - self._groups.position)
            self._groups.add(samples * self._scale)
        self._groups.skip(stop - self._groups.position)
        yield from self._convert()

    def finish(self) -> Iterator[Messages]:
        """Yield the messages up to the last sample."""
        self._groups.complete_group()
        yield from self._convert()
        yield from self._end_of_waveforms()

    def _convert(self) -> Iterator[Messages]:
        """Yield the messages of completed groups."""
        for number in sorted(self._groups.complete):
            group = self._groups.complete.pop(number)
            for first, samples in group.acquired():
                if self._decimator.stop not in (None, first):
                    yield from self._end_of_waveforms()
                yield from self._messages(*self._decimator.run(first, samples))
            yield self._block_levels(group)

    def _block_levels(self, group: Group) -> Messages:
        """Return rms and peak of each block, with the times of the blocks' ends."""
        ends: list[int] = []
        levels = []
        for first, samples in group.blocks(layout.block_length(self._clock.rate)):
            _, count, size = samples.shape
            rms = np.sqrt(np.add.reduce(samples * samples, axis=2) / size)
            peak = np.maximum(np.maximum.reduce(samples, axis=2), -np.minimum.reduce(samples, axis=2))
            levels.append(np.stack([rms, peak], axis=1))
            ends += range(first + size, first + size * count + 1, size)
        times = self._clock.times_ns(ends)
        data = encode_floats(np.concatenate(levels, axis=2).reshape(-1, len(ends)))
        return Messages(self._levels, times, times, data, self._sequence("level", len(ends)))

    def _end_of_waveforms(self) -> Iterator[Messages]:
        """Yield waveforms and transforms up to the last sample before a gap or the end."""
        if self._decimator.stop is not None:
            yield from self._messages(*self._decimator.finish())

    def _messages(self, numbers: NDArray[np.int64], values: Array) -> Iterator[Messages]:
        """Yield waveforms and, at every `TRANSFORM_STEP`-th of these samples, transforms."""
        if not numbers.size:
            return
        times = self._clock.times_ns(numbers)
        sequence = self._sequence("waveform", numbers.size)
        yield Messages(self._waveforms, times, times, encode_floats(values), sequence)
        with_transforms = numbers // self._decimator.step % TRANSFORM_STEP == 0
        displacements = np.zeros((len(self._sources), np.count_nonzero(with_transforms)))
        if self._truth is not None:
            # The truth has the same points in a different order.
            true_displacements = dict(
                zip(self._truth.part_names, self._truth.positions(numbers[with_transforms]), strict=True)
            )
            displacements[:] = [true_displacements[source.point] for source in self._sources]
        for row, source in zip(displacements, self._sources, strict=True):
            if source.point in self._filters:
                channel, displacement_filter = self._filters[source.point]
                row[:] = displacement_filter.run(values[channel])[with_transforms]
        if displacements.shape[1]:
            transform_times, sequence = times[with_transforms], self._sequence("transform", displacements.shape[1])
            data = self._robot.transforms(transform_times, displacements)[None]
            yield Messages([self._transforms], transform_times, transform_times, data, sequence)
