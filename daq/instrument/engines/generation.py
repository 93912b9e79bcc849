"""A running output task: its buffer, its triggers, and its output voltages."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from daq.instrument.engines.acquisition import EventTick
from daq.instrument.engines.ring_buffer import memory
from daq.instrument.engines.triggers import AtTime, OtherTask, SyncPulse
from daq.instrument.errors import Code, DaqError
from rig.arrays import Array


class OutputBuffer:
    """Samples to play, shape (channels, size), repeated in a loop.

    Until the task starts the buffer grows with every write, unless its size is set.

    `size`: samples per channel; None to grow.
    """

    def __init__(self, channels: int, size: int | None) -> None:
        self.data: Array = memory(channels, size or 0)
        self.written = 0
        self._grows = size is None

    @property
    def size(self) -> int:
        """Capacity, samples per channel."""
        return self.data.shape[1]

    def free(self, generated: int, running: bool, regenerate: bool) -> int:
        """Return how many samples can be written now."""
        if not running and self._grows:
            return np.iinfo(np.int64).max
        if running and regenerate:
            return self.size
        return self.size - (self.written - generated)

    def write(self, samples: Array, running: bool) -> None:
        """Append samples, shape (channels, n), for which there is room."""
        if not running and self._grows:
            self.data = np.concatenate([self.data[:, : self.written], samples], axis=1)
        else:
            self.data[:, (self.written + np.arange(samples.shape[1])) % self.size] = samples
        self.written += samples.shape[1]


@dataclass(frozen=True)
class OutputPlan:
    """The settings of an output task."""

    rows: tuple[int, ...]  # the bench's drives, in the order of the task's channels
    rate: float  # ticks of the bench per second
    per_tick: Fraction  # samples of the output per tick of the bench
    samples: int | None  # samples of a finite generation; None for a continuous generation
    regenerate: bool  # whether the buffer is repeated
    start: SyncPulse | AtTime | OtherTask | None = None  # start trigger


class Generation:
    """The state of an output task from start to stop.

    `plan`: what to generate; `buffer`: samples to play; may be written during the run; `tick`: position of the bench
    at the start; `last_volts`, shape (channels,): output voltage before the start, V; `generated`: samples per channel
    generated so far; `done`: whether the generation has ended; the output keeps its last value; `error`: reason of
    an early end.
    """

    def __init__(self, plan: OutputPlan, buffer: OutputBuffer, tick: int, last_volts: Array) -> None:
        self.plan, self.buffer, self.last_volts = plan, buffer, last_volts
        self.generated = 0
        self._ticks = 0
        self.done = False
        self.error: DaqError | None = None
        self.armed_at = tick
        self.first_tick: int | None = tick if plan.start is None else None

    def join(self, started: int | None) -> None:
        """Begin at once if the task that provides the clock has started already."""
        if started is not None and started <= self.armed_at:
            self.first_tick = self.armed_at

    def start_tick(self, reference: bool, tick: int) -> int | None:
        """Return the tick at which this task started or will start; an output has no reference trigger."""
        if reference:
            return None
        if self.first_tick is None and isinstance(self.plan.start, SyncPulse | AtTime):
            return self.plan.start.next_tick(max(tick, self.armed_at), self.plan.rate)
        return self.first_tick

    def missing(self) -> int:
        """Lower bound of the ticks until a finite generation is complete."""
        if self.first_tick is None or self.plan.samples is None:
            return max(1, int(self.plan.rate / 100))
        return max(1, self.ticks_until(self.plan.samples))

    def ticks_until(self, samples: int) -> int:
        """Count the ticks until the total number of generated samples is `samples`."""
        assert self.first_tick is not None
        return math.ceil(samples / self.plan.per_tick) - self._ticks

    def produce(self, tick: int, count: int, event_tick: EventTick) -> Array:
        """Return the output voltages of the next ticks, V, shape (channels, count)."""
        out = np.repeat(self.last_volts[:, None], count, axis=1)
        if self.done:
            return out
        if self.first_tick is None:
            self.first_tick = self._find_start(tick, count, event_tick)
            if self.first_tick is None:
                return out
        offset = max(0, self.first_tick - tick)
        first_index_tick, self._ticks = self._ticks, self._ticks + count - offset
        ratio = self.plan.per_tick
        # Ticks of the bench between two samples are interpolated linearly.
        index, remainder = np.divmod(
            (first_index_tick + np.arange(count - offset)) * ratio.numerator, ratio.denominator
        )
        last = self._ticks * ratio.numerator // ratio.denominator
        ends = [] if self.plan.samples is None else [self.plan.samples]
        if not self.plan.regenerate:
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
        if self.plan.samples is not None and last >= self.plan.samples:
            self.done = True
        return out

    def _find_start(self, tick: int, count: int, event_tick: EventTick) -> int | None:
        source = self.plan.start
        if isinstance(source, SyncPulse | AtTime):
            start_tick: int | None = source.next_tick(max(self.armed_at, tick), self.plan.rate)
        else:
            assert source is not None
            start_tick = event_tick(source)
            if start_tick is not None and start_tick >= self.armed_at:
                # The trigger is in samples of the block before: the output follows at the next tick.
                start_tick = max(start_tick, tick)
        if start_tick is None or start_tick < self.armed_at or start_tick >= tick + count:
            return None
        return start_tick

    def stop(self, error: DaqError | None = None) -> None:
        """Stop the generation; the output keeps its last value."""
        self.done, self.error = True, self.error or error
