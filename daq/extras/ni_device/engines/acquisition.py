"""A running input task: detects its triggers and stores its samples in a buffer until they are read.

A record is the sequence of samples from a start trigger, or from the start of the task, to the required number.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.virtual_bench.bench import first_sample, first_tick, samples_per_tick
from daq.extras.ni_device.engines.ring_buffer import RingBuffer
from daq.extras.ni_device.engines.triggers import AnalogSource, AtTime, CrossingFinder, OtherTask, Pulses, Source
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.settings.scales import Scale

# Function that returns the tick at which another task was triggered; None before the trigger.
EventTick = Callable[[OtherTask], int | None]


@dataclass(frozen=True)
class InputPlan:
    """The settings of an acquisition."""

    bench_indices: tuple[int, ...]  # indices of the task's channels among the channels of the bench
    factors: NDArray[np.float64]  # reading per count (or per volt, if samples are volts), shape (channels,)
    scales: tuple[Scale | None, ...]  # custom scale of each channel
    rate: float  # samples per second
    samples: int | None  # samples per channel in a record; None for a continuous acquisition
    buffer_size: int  # size of the buffer, samples per channel
    stops_when_full: bool = False  # stop instead of overwriting unread samples
    start: Source | None = None  # start trigger
    reference: Source | None = None  # reference trigger
    pretrigger: int = 0  # samples before the reference trigger
    is_retriggerable: bool = False  # the start trigger is armed again after each complete record

    def to_units(self, channel: int, samples: NDArray[Any]) -> NDArray[np.float64]:
        """Convert converter samples of a channel (its index in the task) to readings in its unit."""
        values: NDArray[np.float64] = samples * self.factors[channel]
        scale = self.scales[channel]
        return values if scale is None else scale.convert(values)


class Acquisition:
    """An input task from start to stop.

    Three counts of time are used. Ticks count the steps of the bench since power-on. Instants count sample periods of
    the task since power-on. Sample numbers count the stored samples; sample 0 is the first after the start trigger.

    A reader that is late by more than the buffer loses the older samples, and continues with the oldest sample in the
    buffer. The buffer is then full, so a reader that pauses before its next read loses samples again.

    `tick_rate` is in ticks per second, `tick` the current tick, `dtype` the type of the converter's samples.
    """

    def __init__(self, plan: InputPlan, tick_rate: float, tick: int, dtype: Any) -> None:
        self.plan, self._per_tick = plan, samples_per_tick(plan.rate, tick_rate)
        self.ring = RingBuffer(len(plan.bench_indices), plan.buffer_size, dtype)
        self.overloads = RingBuffer(len(plan.bench_indices), plan.buffer_size, bool)  # overload flag of each sample
        self.position = 0  # read position: index of the sample that is read next
        self.first_instant: int | None = None  # start of the current record; None before the start trigger
        self.trigger_sample: int | None = None  # index of the sample at the reference trigger; None before the trigger
        self.done = False  # complete, or stopped (by `error`, if there is one)
        self.error: DaqError | None = None
        self.overloaded = np.zeros(len(plan.bench_indices), bool)  # overload flag of each channel since the last query
        self._record_start = 0  # index of the first sample of the current record
        # Number and instant of the first sample of each record, in order of time.
        self._records: deque[tuple[int, int]] = deque(maxlen=1000)
        self._record_end: int | None = None  # index of the sample after the current record; None while it is unknown
        instant = first_sample(self._per_tick, tick)
        self._arm(instant)
        if plan.start is None:
            self._begin_record(instant)

    def _arm(self, instant: int) -> None:
        """Arm the start trigger from an instant on."""
        self.armed_instant, self.first_instant, self._record_end = instant, None, None
        start = self.plan.start
        self._start_finders = start.finders() if isinstance(start, AnalogSource) else []

    def _begin_record(self, instant: int) -> None:
        """Begin a record whose first sample is at an instant."""
        self.first_instant, self._record_start = instant, self.ring.written
        self._records.append((self._record_start, instant))
        reference = self.plan.reference
        self._reference_finders = reference.finders() if isinstance(reference, AnalogSource) else []
        if self.plan.samples is not None and reference is None:
            self._record_end = self._record_start + self.plan.samples

    @property
    def has_started(self) -> bool:
        """Whether the start trigger of the current record has occurred."""
        return self.first_instant is not None

    @property
    def readable_end(self) -> int:
        """Number of the sample after the last readable one; 0 until a reference trigger's record is complete."""
        return 0 if self.plan.reference is not None and not self.done else self.ring.written

    def skip_lost(self) -> int:
        """Move the read position past samples that have been lost, and return their number."""
        if not self.readable_end or self.position >= self.ring.oldest:
            return 0
        previous, self.position = self.position, self.ring.oldest
        return self.position - previous

    def read_next(self, count: int) -> NDArray[Any]:
        """Read `count` available samples, shape (channels, count)."""
        samples = self.ring.read(self.position, count)
        self.position += count
        return samples

    @property
    def first_readable(self) -> int:
        """Index of the first sample that a script can read."""
        return 0 if self.trigger_sample is None else self.trigger_sample - self.plan.pretrigger

    def instant_of(self, sample: int) -> int:
        """Return the instant of a sample of this or an earlier record."""
        for first, instant in reversed(self._records):
            if first <= sample:
                return instant + sample - first
        return self.armed_instant

    def tick_at(self, instant: int) -> int:
        """Return the first tick at or after an instant."""
        return first_tick(self._per_tick, instant)

    def ticks_until(self, samples: int, tick: int) -> int:
        """Return the number of ticks after a tick until `samples` further samples have been taken."""
        instant = first_sample(self._per_tick, tick)
        return max(1, self.tick_at(instant + samples - 1) - tick + 1)

    def samples_to_wait(self, samples: int) -> int:
        """Return the sample periods until `samples` samples after the read position may be readable.

        Before a trigger the number is unknown, and the sample periods in 10 ms are returned.
        """
        polling_samples = max(1, int(self.plan.rate / 100))
        if self.first_instant is None:
            return polling_samples
        if self.plan.reference is not None:
            return self._record_end - self.ring.written if self._record_end is not None else polling_samples
        return self.position + samples - self.ring.written

    def start_tick(self, reference: bool, tick: int) -> int | None:
        """Return the tick of the start or `reference` trigger, given the current `tick`; None if still unknown."""
        instant = self.first_instant
        if reference:
            instant = None if self.trigger_sample is None else self.instant_of(self.trigger_sample)
        elif instant is None and isinstance(self.plan.start, Pulses | AtTime):
            earliest = max(first_sample(self._per_tick, tick), self.armed_instant)
            instant = self.plan.start.next_instant(earliest, self.plan.rate)
        return None if instant is None else self.tick_at(instant)

    def add_block(
        self, instant: int, samples: NDArray[Any], overload: NDArray[np.bool_], event_tick: EventTick
    ) -> None:
        """Process a block of converter samples and their overload flags, shape (channels of the bench, n).

        `instant` is the instant of the first sample; blocks are contiguous.
        """
        bench_indices = list(self.plan.bench_indices)
        selected, flags = samples[bench_indices], overload[bench_indices]
        # A filter delays samples, so the first samples of the block may be older than the start of the task.
        offset, count = max(0, self.armed_instant - instant), selected.shape[1]
        while offset < count and not self.done:
            if self.first_instant is None:
                start_offset = self._find_start(instant, selected, offset, event_tick)
                if start_offset is None:
                    return
                offset = start_offset
                self._begin_record(instant + offset)
            offset += self._store(instant + offset, selected[:, offset:], flags[:, offset:], event_tick)

    def _find_start(self, first: int, samples: NDArray[Any], offset: int, event_tick: EventTick) -> int | None:
        """Return the index, from `offset` on, of the start trigger in a block that begins at `first`; None without."""
        source = self.plan.start
        if isinstance(source, AnalogSource):
            crossing = self._find_crossing(self._start_finders, samples[:, offset:])
            return None if crossing is None else offset + crossing
        instant = self._event_instant(source, max(self.armed_instant, first + offset), event_tick)
        if instant is None or instant < self.armed_instant or instant - first >= samples.shape[1]:
            return None
        return max(instant - first, offset)

    def _find_crossing(
        self, finders: list[tuple[int, CrossingFinder]], samples: NDArray[Any], skip: int = 0
    ) -> int | None:
        """Return the index of the first sample, after `skip`, that fires a trigger in any channel; None without it."""
        # Every finder processes all samples, so its state remains correct.
        indices = [finder.find(self.plan.to_units(channel, samples[channel]), skip) for channel, finder in finders]
        return min((index for index in indices if index is not None), default=None)

    def _store(self, first: int, samples: NDArray[Any], overload: NDArray[np.bool_], event_tick: EventTick) -> int:
        """Store samples, the first at instant `first`, up to the end of the record; return their number, at least 1."""
        if self.plan.reference is not None and self.trigger_sample is None:
            self._find_reference_trigger(first, samples, event_tick)
        count = (
            samples.shape[1]
            if self._record_end is None
            else min(samples.shape[1], self._record_end - self.ring.written)
        )
        free = self.plan.buffer_size - (self.ring.written - self.position)
        if self.plan.stops_when_full and count > free:
            count = free
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
        if self.ring.written == self._record_end:
            self._complete(first + count)
        return max(count, 1)

    def _find_reference_trigger(self, first: int, samples: NDArray[Any], event_tick: EventTick) -> None:
        """Search samples, the first at instant `first`, for the reference trigger; if found, set the record's end."""
        assert self.first_instant is not None and self.plan.samples is not None
        count, source = samples.shape[1], self.plan.reference
        earliest = self.first_instant + self.plan.pretrigger
        skip = min(max(0, earliest - first), count)
        crossing = None
        if isinstance(source, AnalogSource):
            crossing = self._find_crossing(self._reference_finders, samples, skip)
        else:
            instant = self._event_instant(source, max(earliest, first), event_tick)
            if instant is not None and max(earliest, first) <= instant < first + count:
                crossing = instant - first
        if crossing is not None:
            self.trigger_sample = self.ring.written + crossing
            self._record_end = self.trigger_sample + self.plan.samples - self.plan.pretrigger
            self.position = self.first_readable

    def _event_instant(self, source: Source | None, earliest: int, event_tick: EventTick) -> int | None:
        """Return the instant of a non-analog trigger, from `earliest` on; None before another task's trigger."""
        if isinstance(source, Pulses | AtTime):
            return source.next_instant(earliest, self.plan.rate)
        assert isinstance(source, OtherTask)
        tick = event_tick(source)
        return None if tick is None else first_sample(self._per_tick, tick)

    def _complete(self, instant: int) -> None:
        """End the record before an instant, and the acquisition unless the start trigger is armed again."""
        if self.plan.is_retriggerable:
            self._arm(instant)
        else:
            self.done = True

    def stop(self, error: DaqError | None = None) -> None:
        """Stop the acquisition."""
        self.done, self.error = True, self.error or error
