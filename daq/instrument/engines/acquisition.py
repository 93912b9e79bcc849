"""A running input task: its triggers, its buffer, and its remaining samples."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.instrument.engines.ring_buffer import RingBuffer
from daq.instrument.engines.triggers import AnalogSource, AtTime, CrossingFinder, OtherTask, Source, SyncPulse
from daq.instrument.errors import Code, DaqError
from daq.instrument.settings.scales import Scale
from daq.virtual_bench.bench import first_sample, first_tick, samples_per_tick

# A function that returns the tick at which another task started or was triggered; None before that.
EventTick = Callable[[OtherTask], int | None]


@dataclass(frozen=True)
class InputPlan:
    """The settings of an input task."""

    rows: tuple[int, ...]  # the bench's channels, in the order of the task's
    factors: NDArray[np.float64]  # units of each channel per unit of the converter samples, shape (channels,)
    scales: tuple[Scale | None, ...]  # custom scale of each channel
    rate: float  # samples per second
    samples: int | None  # samples of a finite acquisition; None for a continuous acquisition
    buffer: int  # capacity of the buffer, samples per channel
    stops_when_full: bool = False  # whether it stops before it overwrites unread samples
    start: Source | None = None  # triggers
    reference: Source | None = None  # triggers
    pretrigger: int = 0  # samples before the reference trigger
    rearms: bool = False  # whether the start trigger is re-armed after each complete record

    def reading(self, row: int, samples: NDArray[Any]) -> NDArray[np.float64]:
        """Convert converter samples to the units of their channel."""
        values: NDArray[np.float64] = samples * self.factors[row]
        scale = self.scales[row]
        return values if scale is None else scale.convert(values)


class Acquisition:
    """The state of an input task from start to stop.

    Sample 0 is the first sample after the start trigger. Instants are sample numbers at the task's rate since
    power-on. The bench counts the ticks.

    A reader that is late by more than the buffer loses the older samples, and continues with the oldest sample in the
    buffer. The buffer is then full, and the next sample would overwrite the oldest. After an overflow the ring
    therefore stores up to twice as many samples, until the reader is half a buffer behind. Without this reserve, a
    reader that pauses between its reads would lose samples at every read.

    `plan`: what to acquire; `tick_rate`: ticks of the bench per second; `position`: number of ticks that have passed
    on the bench; `dtype`: type of the converter's samples; `ring`: the converter's samples; `overloads`: whether
    each of them was overloaded; `position`: number of the sample that is read next by default; `first_tick`: tick of
    the first sample of the current record; None before the start trigger; `trigger`: number of the sample at which
    the reference trigger was detected; `done`: whether the acquisition is complete or has stopped; `error`: reason
    of an early stop; `overloaded`, shape (channels,): channels overloaded since the flags were last cleared.
    """

    def __init__(self, plan: InputPlan, tick_rate: float, position: int, dtype: Any) -> None:
        self.plan, self._per_tick = plan, samples_per_tick(plan.rate, tick_rate)
        self.ring = RingBuffer(len(plan.rows), 2 * plan.buffer, dtype)
        self.overloads = RingBuffer(len(plan.rows), 2 * plan.buffer, bool)
        self.position = 0
        self.first_tick: int | None = None
        self.trigger: int | None = None
        self.done = False
        self.error: DaqError | None = None
        self.overloaded = np.zeros(len(plan.rows), bool)
        self._has_overflowed = False
        # Number of the first sample not yet reported as lost.
        self._first_unreported = 0
        self._record_start = 0
        # Number and tick of the first sample of each record, in order of time.
        self._records: deque[tuple[int, int]] = deque(maxlen=1000)
        self._end: int | None = None
        instant = first_sample(self._per_tick, position)
        self._arm(instant)
        if plan.start is None:
            self._begin(instant)

    def _arm(self, tick: int) -> None:
        self.armed_at, self.first_tick, self._end = tick, None, None
        start = self.plan.start
        self._start_finders = start.finders() if isinstance(start, AnalogSource) else []

    def _begin(self, tick: int) -> None:
        self.first_tick, self._record_start = tick, self.ring.written
        self._records.append((self._record_start, tick))
        reference = self.plan.reference
        self._reference_finders = reference.finders() if isinstance(reference, AnalogSource) else []
        if self.plan.samples is not None and reference is None:
            self._end = self._record_start + self.plan.samples

    @property
    def readable(self) -> int:
        """Number after the last sample that may be read; 0 until the record of a reference trigger is complete."""
        return 0 if self.plan.reference is not None and not self.done else self.ring.written

    @property
    def oldest(self) -> int:
        """Number of the oldest sample that has not been lost."""
        return max(self._first_unreported, self.ring.written - self.plan.buffer * (2 if self._has_overflowed else 1))

    def skip_lost(self) -> int:
        """Move the read position past samples that have been lost, and return how many there are."""
        if not self.readable or self.position >= self.oldest:
            return 0
        previous, self.position = self.position, max(0, self.ring.written - self.plan.buffer)
        self._has_overflowed, self._first_unreported = True, self.position
        return self.position - previous

    def read_next(self, count: int) -> NDArray[Any]:
        """Read available samples, shape (channels, count)."""
        samples = self.ring.read(self.position, count)
        self.position += count
        self._has_overflowed &= self.ring.written - self.position > self.plan.buffer // 2
        return samples

    @property
    def first_readable(self) -> int:
        """Number of the first sample that a script can read."""
        return 0 if self.trigger is None else self.trigger - self.plan.pretrigger

    def instant_of(self, sample: int) -> int:
        """Return the instant of a sample of this or an earlier record."""
        for first, instant in reversed(self._records):
            if first <= sample:
                return instant + sample - first
        return self.armed_at

    def tick_at(self, instant: int) -> int:
        """Return the first tick at or after an instant."""
        return first_tick(self._per_tick, instant)

    def ticks(self, samples: int, position: int) -> int:
        """Count the ticks after a position until that many samples have been taken."""
        instant = first_sample(self._per_tick, position)
        return max(1, self.tick_at(instant + samples - 1) - position + 1)

    def missing(self, samples: int) -> int:
        """Lower bound of the instants until that number of samples is available after the read position.

        Before a trigger the number is unknown; 10 ms is assumed.
        """
        polling_samples = max(1, int(self.plan.rate / 100))
        if self.first_tick is None:
            return polling_samples
        if self.plan.reference is not None:
            return self._end - self.ring.written if self._end is not None else polling_samples
        return self.position + samples - self.ring.written

    def start_tick(self, reference: bool, position: int) -> int | None:
        """Return the tick at or after a position at which this task starts or started (was triggered)."""
        instant = self.first_tick
        if reference:
            instant = None if self.trigger is None else self.instant_of(self.trigger)
        elif instant is None and isinstance(self.plan.start, SyncPulse | AtTime):
            earliest = max(first_sample(self._per_tick, position), self.armed_at)
            instant = self.plan.start.next_tick(earliest, self.plan.rate)
        return None if instant is None else self.tick_at(instant)

    def add_block(self, tick: int, samples: NDArray[Any], overload: NDArray[np.bool_], event_tick: EventTick) -> None:
        """Process a block of the bench.

        `tick`: instant of the block's first sample; blocks are contiguous; `samples`, shape (bench channels, n):
        converter samples; `overload`, shape (bench channels, n): overload flags; `event_tick`: see `EventTick`.
        """
        rows = list(self.plan.rows)
        selected, flags = samples[rows], overload[rows]
        # Samples that were still delayed in a filter when the task started precede the start.
        offset, count = max(0, self.armed_at - tick), selected.shape[1]
        while offset < count and not self.done:
            if self.first_tick is None:
                start_offset = self._find_start(tick, selected, offset, event_tick)
                if start_offset is None:
                    return
                offset = start_offset
                self._begin(tick + offset)
            offset += self._store(tick + offset, selected[:, offset:], flags[:, offset:], event_tick)

    def _find_start(self, tick: int, samples: NDArray[Any], offset: int, event_tick: EventTick) -> int | None:
        source = self.plan.start
        if isinstance(source, AnalogSource):
            crossing = self._crossing(self._start_finders, samples[:, offset:])
            return None if crossing is None else offset + crossing
        if isinstance(source, SyncPulse | AtTime):
            instant: int | None = source.next_tick(max(self.armed_at, tick + offset), self.plan.rate)
        else:
            assert source is not None
            instant = self._instant_after(event_tick(source))
        if instant is None or instant < self.armed_at or instant - tick >= samples.shape[1]:
            return None
        return max(instant - tick, offset)

    def _crossing(self, finders: list[tuple[int, CrossingFinder]], samples: NDArray[Any], skip: int = 0) -> int | None:
        """Return the first crossing of several channels; all finders process all samples."""
        crossings = [finder.find(self.plan.reading(row, samples[row]), skip) for row, finder in finders]
        return min((each for each in crossings if each is not None), default=None)

    def _store(self, tick: int, samples: NDArray[Any], overload: NDArray[np.bool_], event_tick: EventTick) -> int:
        if self.plan.reference is not None and self.trigger is None:
            self._find_reference_trigger(tick, samples, event_tick)
        count = samples.shape[1] if self._end is None else min(samples.shape[1], self._end - self.ring.written)
        room = self.plan.buffer - (self.ring.written - self.position)
        if self.plan.stops_when_full and count > room:
            count = room
            self.stop(
                DaqError(
                    "the acquisition has stopped because the buffer was full of unread samples. Read more often, "
                    "enlarge in_stream.input_buf_size, or allow it to overwrite (in_stream.overwrite).",
                    Code.ACQ_STOPPED_TO_PREVENT_INPUT_BUFFER_OVERWRITE,
                )
            )
        self.ring.write(samples[:, :count])
        self.overloads.write(overload[:, :count])
        self.overloaded |= overload[:, :count].any(axis=1)
        if self.ring.written == self._end:
            self._complete(tick + count)
        return max(count, 1)

    def _find_reference_trigger(self, tick: int, samples: NDArray[Any], event_tick: EventTick) -> None:
        assert self.first_tick is not None and self.plan.samples is not None
        count, source = samples.shape[1], self.plan.reference
        earliest = self.first_tick + self.plan.pretrigger
        skip = min(max(0, earliest - tick), count)
        if isinstance(source, AnalogSource):
            crossing = self._crossing(self._reference_finders, samples, skip)
        else:
            assert source is not None
            instant = (
                source.next_tick(max(earliest, tick), self.plan.rate)
                if isinstance(source, SyncPulse | AtTime)
                else self._instant_after(event_tick(source))
            )
            crossing = None if instant is None or not max(earliest, tick) <= instant < tick + count else instant - tick
        if crossing is not None:
            self.trigger = self.ring.written + crossing
            self._end = self.trigger + self.plan.samples - self.plan.pretrigger
            self.position = self.first_readable

    def _instant_after(self, tick: int | None) -> int | None:
        return None if tick is None else first_sample(self._per_tick, tick)

    def _complete(self, tick: int) -> None:
        if self.plan.rearms:
            self._arm(tick)
        else:
            self.done = True

    def stop(self, error: DaqError | None = None) -> None:
        """Stop the acquisition."""
        self.done, self.error = True, self.error or error
