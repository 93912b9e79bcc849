"""A running output task: outputs the samples of its buffer from its start trigger on, at the rate of the task."""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from daq.extras.ni_device.engines.acquisition import EventTick
from daq.extras.ni_device.engines.ring_buffer import allocate
from daq.extras.ni_device.engines.triggers import AtTime, OtherTask, Pulses
from daq.extras.ni_device.errors import Code, DaqError
from rig.core.base.arrays import Array


class OutputBuffer:
    """Samples to play [V] in a ring buffer that is played in a loop.

    `size` is the capacity of the buffer, samples per channel. If None, the buffer grows with every write until the task
    starts.
    """

    def __init__(self, channels: int, size: int | None) -> None:
        self.data: Array = allocate(channels, size or 0)
        self.written = 0
        self._grows = size is None

    @property
    def size(self) -> int:
        """Capacity, samples per channel."""
        return self.data.shape[1]

    def space(self, generated: int, is_running: bool, regenerates: bool) -> int:
        """Return the number of samples per channel that can be written after `generated` samples have been played.

        If samples are regenerated (repeated) while the task is running, they can be replaced at any time.
        """
        if not is_running and self._grows:
            return np.iinfo(np.int64).max
        if is_running and regenerates:
            return self.size
        return self.size - (self.written - generated)

    def write(self, samples: Array, is_running: bool) -> None:
        """Append samples, shape (channels, n); the buffer must have space for them."""
        if not is_running and self._grows:
            self.data = np.concatenate([self.data[:, : self.written], samples], axis=1)
        else:
            self.data[:, (self.written + np.arange(samples.shape[1])) % self.size] = samples
        self.written += samples.shape[1]


@dataclass(frozen=True)
class OutputPlan:
    """The settings of a generation."""

    bench_indices: tuple[int, ...]  # indices of the task's channels among the outputs of the bench
    tick_rate: float  # ticks of the bench per second
    per_tick: Fraction  # samples per tick
    samples: int | None  # samples per channel of a finite generation; None for a continuous generation
    regenerates: bool  # repeat the buffer
    start: Pulses | AtTime | OtherTask | None = None  # start trigger


class Generation:
    """An output task from start to stop.

    The buffer may be written during the run. `tick` is the current tick, `last_volts` the output voltages, V,
    shape (channels,).
    """

    def __init__(self, plan: OutputPlan, buffer: OutputBuffer, tick: int, last_volts: Array) -> None:
        self.plan, self.buffer, self.last_volts = plan, buffer, last_volts
        self.generated = 0  # number of generated samples per channel
        self._ticks = 0  # ticks since the first sample
        self.done = False  # complete, or stopped by `error`; the output remains at its last value
        self.error: DaqError | None = None
        self.armed_tick = tick  # tick from which the start trigger is awaited
        self.first_tick: int | None = tick if plan.start is None else None  # tick of the first sample

    @property
    def has_started(self) -> bool:
        """Whether the start trigger has occurred."""
        return self.first_tick is not None

    def start_if_clock_runs(self, clock_start: int | None) -> None:
        """Start immediately if the task with the sample clock has already started, at the tick `clock_start`."""
        if clock_start is not None and clock_start <= self.armed_tick:
            self.first_tick = self.armed_tick

    def start_tick(self, reference: bool, tick: int) -> int | None:
        """Return the tick of the start; None if it is still unknown. `tick` is the current tick.

        With `reference`, the result is None, because an output has no reference trigger.
        """
        if reference:
            return None
        if self.first_tick is None and isinstance(self.plan.start, Pulses | AtTime):
            return self.plan.start.next_instant(max(tick, self.armed_tick), self.plan.tick_rate)
        return self.first_tick

    def ticks_to_end(self) -> int:
        """Return a lower bound of the ticks until the generation is complete, by default those in 10 ms."""
        if self.first_tick is None or self.plan.samples is None:
            return max(1, int(self.plan.tick_rate / 100))
        return max(1, self.ticks_until(self.plan.samples))

    def ticks_until(self, samples: int) -> int:
        """Return the number of ticks until the total number of generated samples is `samples`."""
        assert self.first_tick is not None
        return math.ceil(samples / self.plan.per_tick) - self._ticks

    def ticks_to_last_written(self) -> float:
        """Return the ticks until the buffer has no new samples, if new samples are required; otherwise infinity."""
        written = self.buffer.written
        if self.done or self.first_tick is None or self.plan.regenerates or written == self.plan.samples:
            return math.inf
        return self.ticks_until(written)

    def produce(self, tick: int, count: int, event_tick: EventTick) -> Array:
        """Return the output voltages of `count` ticks from `tick` on [V], shape (channels, count)."""
        out = np.repeat(self.last_volts[:, None], count, axis=1)
        if self.done:
            return out
        if self.first_tick is None:
            self.first_tick = self._find_start(tick, count, event_tick)
            if self.first_tick is None:
                return out
        offset = max(0, self.first_tick - tick)
        ticks_before, self._ticks = self._ticks, self._ticks + count - offset
        ratio = self.plan.per_tick
        # At a tick between two samples, the output is interpolated linearly.
        index, remainder = np.divmod((ticks_before + np.arange(count - offset)) * ratio.numerator, ratio.denominator)
        next_sample = self._ticks * ratio.numerator // ratio.denominator
        # Numbers of samples after which the output ends.
        ends = [] if self.plan.samples is None else [self.plan.samples]
        if not self.plan.regenerates:
            ends.append(self.buffer.written)
        n_played = int(np.searchsorted(index, min(ends))) if ends else index.size
        played = self.buffer.data[:, index[:n_played] % self.buffer.size]
        out[:, offset : offset + n_played] = played
        if n_played and remainder.any():
            next_index = np.minimum(index[:n_played] + 1, min(ends) - 1) if ends else index[:n_played] + 1
            next_volts = self.buffer.data[:, next_index % self.buffer.size]
            out[:, offset : offset + n_played] += (remainder[:n_played] / ratio.denominator) * (next_volts - played)
        if n_played:
            self.last_volts = played[:, -1].copy()
        out[:, offset + n_played :] = self.last_volts[:, None]
        self.generated = min([int(index[-1]) + 1, *ends]) if index.size else self.generated
        if n_played < index.size and self.generated != self.plan.samples:
            self.stop(
                DaqError(
                    "the output has stopped because it had no new samples. Write earlier or more at a time, or allow "
                    "regeneration (out_stream.regen_mode).",
                    Code.GEN_STOPPED_TO_PREVENT_REGEN_OF_OLD_SAMPLES,
                )
            )
        if self.plan.samples is not None and next_sample >= self.plan.samples:
            self.done = True
        return out

    def _find_start(self, tick: int, count: int, event_tick: EventTick) -> int | None:
        """Return the tick of the start if it is among the `count` ticks from `tick` on, otherwise None."""
        source = self.plan.start
        if isinstance(source, Pulses | AtTime):
            start_tick: int | None = source.next_instant(max(self.armed_tick, tick), self.plan.tick_rate)
        else:
            assert source is not None
            start_tick = event_tick(source)
            if start_tick is not None and start_tick >= self.armed_tick:
                # A start of the other task in the previous block starts the output at the first tick of this block.
                start_tick = max(start_tick, tick)
        if start_tick is None or start_tick < self.armed_tick or start_tick >= tick + count:
            return None
        return start_tick

    def stop(self, error: DaqError | None = None) -> None:
        """Stop the generation; the output keeps its last value."""
        self.done, self.error = True, self.error or error
