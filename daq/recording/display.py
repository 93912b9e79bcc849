"""Signals for viewers, made while a recording is written: decimated, anti-aliased waveforms, rms and peak.

A general viewer draws them: one number a message, in an encoding that it plots by default.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.mcap_file.writer import Message, Messages
from daq.recording.displacement import DisplacementEstimate, motion_sources
from daq.recording.layout import DISPLAY, ROBOT, TRANSFORMS, Timebase
from daq.recording.protobuf import Schema
from rig.arrays import Array

if TYPE_CHECKING:
    from daq.recording.truth import Register, Truth
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene

# Highest rate of the displayed waveforms.
MAX_RATE_HZ = 250.0
# Number of displayed samples from one transform to the next.
TRANSFORM_STEP = 2
# Half the length of the anti-aliasing filter in display samples. With its Kaiser window it is flat to 0.27 of
# the display rate; aliasing begins at half of it, where it is 44 dB down, and is 70 dB down from 0.52 on.
HALF_LENGTH = 8
KAISER_BETA = 6.8
CUTOFF = 0.385
# Number of signals that are filtered together: products of thousands would take several times their memory.
_MAX_ROWS = 64

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
# Bytes before the one element: no dimensions, no offset, one element, padding to eight bytes.
_MESSAGE_HEAD = np.frombuffer(struct.pack("<4sIII4x", _LITTLE_ENDIAN, 0, 0, 1), np.uint8)


def encode_floats(values: Array) -> NDArray[np.uint8]:
    """Encode each number as a std_msgs/msg/Float64MultiArray of one element, along a further, last axis.

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
    """Return the number of samples from one display sample to the next.

    >>> 5120.0 / display_step(5120.0)
    243.8095238095238
    """
    return max(1, math.ceil(rate / MAX_RATE_HZ))


class DisplayDecimator:
    """Low-passes signals and outputs every `step`-th sample, at sample numbers that are multiples of it.

    The filter has linear phase without delay: a sample is known half a filter length later. Before the first and after
    the last sample, these continue as constants. `stop` is the expected next sample; None before the first one and
    after `finish`.
    """

    def __init__(self, step: int) -> None:
        self.step = step
        self._half = HALF_LENGTH * step if step > 1 else 0
        self._taps = np.ones(1)
        if step > 1:
            places = np.arange(-self._half, self._half + 1) * (2 * CUTOFF / step)
            taps = np.sinc(places) * np.kaiser(places.size, KAISER_BETA)
            self._taps = taps / taps.sum()
        self._samples = np.empty((0, 0))
        self._first = 0
        self.stop: int | None = None
        self._next = 0

    def run(self, first: int, samples: Array) -> tuple[NDArray[np.int64], Array]:
        """Take further samples (signals, samples) from `first` on; return output sample numbers and their values.

        `finish` must be called before a gap.
        """
        if self.stop is None:
            self._samples = np.repeat(samples[:, :1], self._half, axis=1)
            self._first, self._next = first - self._half, -(-first // self.step)
        self._samples = np.concatenate([self._samples, samples], axis=1)
        self.stop = first + samples.shape[1]
        last = (self.stop - 1 - self._half) // self.step
        return self._output_until(last)

    def finish(self) -> tuple[NDArray[np.int64], Array]:
        """Return the remaining values of the samples so far, at least one; the next samples start a new signal."""
        assert self.stop is not None
        self._samples = np.concatenate([self._samples, np.repeat(self._samples[:, -1:], self._half, axis=1)], axis=1)
        output = self._output_until((self.stop - 1) // self.step)
        self.stop = None
        return output

    def _output_until(self, last: int) -> tuple[NDArray[np.int64], Array]:
        """Filter at the multiples of the step from the next one to the last one, both included."""
        places = np.arange(self._next, last + 1, dtype=np.int64) * self.step
        if places.size == 0:
            return places, np.empty((self._samples.shape[0], 0))
        begin, end = int(places[0]) - self._half - self._first, int(places[-1]) + self._half + 1 - self._first
        values = self._samples[:, begin:end]
        if self.step > 1:
            parts = (values[row : row + _MAX_ROWS] for row in range(0, len(values), _MAX_ROWS))
            values = np.concatenate([_filtered(part, self._taps, self.step) for part in parts])
        self._next = last + 1
        n_used = max(0, self._next * self.step - self._half - self._first)
        # A copy: a view would keep the used samples in memory.
        self._samples, self._first = self._samples[:, n_used:].copy(), self._first + n_used
        return places, np.asarray(values)


def _filtered(samples: Array, taps: Array, step: int) -> Array:
    """Filter at every `step`-th sample; shape (signals, outputs).

    The length of the filter is a multiple of `step`, plus one sample. A matrix product weights every step of the
    signals with every step of the filter; sums along its diagonals are the result.
    """
    steps = taps.size // step
    n_outputs = samples.shape[1] // step - steps + 1
    signals = samples[:, : (n_outputs + steps - 1) * step].reshape(len(samples), -1, step)
    parts = signals @ taps[:-1].reshape(steps, step).T
    result = taps[-1] * samples[:, steps * step :: step][:, :n_outputs]
    for k in range(steps):
        result += parts[:, k : k + n_outputs, k]
    return result


class Display:
    """Makes the messages for viewers: waveform, rms and peak of each channel, and the rig's transforms.

    Truth, where recorded, moves dampers and points without a displacement channel.
    """

    def __init__(
        self, scene: Scene, channels: Sequence[ChannelInfo], clock: Timebase, truth: Truth | None, register: Register
    ) -> None:
        from daq.recording.robot_description import TRANSFORMS_SCHEMA, RobotDescription

        self._clock, self._truth = clock, truth
        self._decimator = DisplayDecimator(display_step(clock.rate))
        topics = []
        for info in channels:
            fields = {"unit": info.unit, "sensor": info.name, "direction": "up"}
            names = (f"{DISPLAY}{info.name}{suffix}" for suffix in ("", "/rms", "/peak"))
            topics.append([register(name, FLOAT_SCHEMA, fields) for name in names])
        self._waveforms, self._levels = np.split(np.array(topics), [1], axis=1)
        self._robot = RobotDescription(scene, with_dampers=truth is not None)
        factor = {"exaggeration": f"{self._robot.exaggeration:g}"}
        self._description = register(ROBOT, TEXT_SCHEMA, factor)
        self._transforms = register(TRANSFORMS, TRANSFORMS_SCHEMA, factor)
        self._sources = motion_sources(self._robot.points, channels, truth is not None)
        rows = {info.name: row for row, info in enumerate(channels)}
        rate = clock.rate / self._decimator.step
        # Of each source with a channel its row, and the filter to displacement.
        self._estimates = {
            source.point: (rows[source.channel], DisplacementEstimate(source.quantity, rate))
            for source in self._sources
            if source.channel is not None
        }
        # Number of messages on each topic of a kind.
        self._n_messages = {"waveform": 0, "level": 0, "transform": 0}

    def _sequence(self, kind: str, count: int) -> NDArray[np.int64]:
        """Return the numbers of the next messages on each topic of a kind."""
        self._n_messages[kind] += count
        return np.arange(self._n_messages[kind] - count, self._n_messages[kind])

    def introduction(self) -> Message:
        """Return the message that describes the rig."""
        at = self._clock.time_ns(0)
        return Message(self._description, at, at, encode_text(self._robot.urdf()), 0)

    def description(self) -> dict[str, str]:
        """Describe the signals, for the metadata."""
        sources = {f"motion.{source.point}": source.sentence for source in self._sources}
        rate = self._clock.rate / self._decimator.step
        return {
            "rate_hz": repr(rate),
            "low_pass": f"linear-phase FIR, -6 dB at {CUTOFF * rate:.4g} Hz" if self._decimator.step > 1 else "none",
            "transforms_rate_hz": repr(rate / TRANSFORM_STEP),
            "exaggeration": f"{self._robot.exaggeration:g}",
            **sources,
        }

    def levels(self, blocks: Iterable[tuple[int, Array]]) -> Messages:
        """Return rms and peak at the ends of blocks, given as first sample and samples (channels, blocks, samples)."""
        ends: list[int] = []
        levels = []
        for first, samples in blocks:
            _, count, size = samples.shape
            rms = np.sqrt(np.add.reduce(samples * samples, axis=2) / size)
            peak = np.maximum(np.maximum.reduce(samples, axis=2), -np.minimum.reduce(samples, axis=2))
            levels.append(np.array([rms, peak]))
            ends += range(first + size, first + size * count + 1, size)
        data = encode_floats(np.concatenate(levels, axis=2).transpose(2, 1, 0))
        times, sequence = self._clock.times_ns(ends)[:, None, None], self._sequence("level", len(ends))
        return Messages(self._levels, times, times, data, sequence[:, None, None])

    def waveforms(self, first: int, samples: Array) -> Iterator[Messages]:
        """Yield waveforms and transforms that are determined by further samples, shape (channels, samples)."""
        if self._decimator.stop not in (None, first):
            yield from self.finish()
        yield from self._draw(*self._decimator.run(first, samples))

    def finish(self) -> Iterator[Messages]:
        """Yield waveforms and transforms up to the last sample."""
        if self._decimator.stop is not None:
            yield from self._draw(*self._decimator.finish())

    def _draw(self, numbers: NDArray[np.int64], values: Array) -> Iterator[Messages]:
        if not numbers.size:
            return
        times = self._clock.times_ns(numbers.tolist())
        sequence = self._sequence("waveform", numbers.size)
        yield Messages(self._waveforms, times, times, encode_floats(values), sequence)
        with_transforms = numbers // self._decimator.step % TRANSFORM_STEP == 0
        displacements = np.zeros((len(self._sources), np.count_nonzero(with_transforms)))
        if self._truth is not None:
            # The truth has the same points in another order.
            true = dict(zip(self._truth.drawn, self._truth.positions(numbers[with_transforms]), strict=True))
            displacements[:] = [true[source.point] for source in self._sources]
        for row, source in zip(displacements, self._sources, strict=True):
            if source.point in self._estimates:
                channel, estimate = self._estimates[source.point]
                row[:] = estimate.run(values[channel])[with_transforms]
        if displacements.shape[1]:
            transform_times, sequence = times[with_transforms], self._sequence("transform", displacements.shape[1])
            yield Messages(
                self._transforms,
                transform_times,
                transform_times,
                self._robot.transforms(transform_times, displacements),
                sequence,
            )
