"""The samples of one channel, read by sample number; only the chunks that are needed are decoded."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from daq.mcap_file.reader import Container
from daq.recording.layout import CLOCK, Timebase
from daq.recording.sample_block import SCHEMAS, SampleBlock, decode
from daq.signal_chain.field_checks import MAX_SAMPLES, NOT_ZERO, check
from rig.arrays import Array
from rig.errors import RecordingError

if TYPE_CHECKING:
    from mcap.records import Channel

# Samples of a range from which its content is compared with its size: numbers in a file must not exhaust the memory.
LARGE_RANGE = 1 << 22
# Such a range is rejected if it holds less than this part of its samples, 1 / LEAST_SHARE.
LEAST_SHARE = 16
# Decoded samples of a recording that stay in memory, bytes: an analysis reads a measured window several times.
RECENT_BYTES = 1 << 27


class RecentBlocks:
    """Decoded blocks of the chunks of a recording that were read last, of at most `RECENT_BYTES`."""

    def __init__(self) -> None:
        self._blocks: OrderedDict[tuple[int, int], list[SampleBlock]] = OrderedDict()
        self._bytes = 0

    def of(self, channel: int, chunk: int) -> list[SampleBlock] | None:
        """Return the blocks of a channel in a chunk; None if they are not stored."""
        return self._blocks.get((channel, chunk))

    def store(self, channel: int, chunk: int, blocks: list[SampleBlock]) -> None:
        """Store the blocks of a channel in a chunk; remove those that were stored first."""
        self._blocks[channel, chunk] = blocks
        self._bytes += _bytes_of(blocks)
        while len(self._blocks) > 1 and self._bytes > RECENT_BYTES:
            self._bytes -= _bytes_of(self._blocks.popitem(last=False)[1])


def _bytes_of(blocks: list[SampleBlock]) -> int:
    return sum(block.samples.nbytes for block in blocks)


class Series:
    """Blocks of samples on one topic."""

    def __init__(self, container: Container, channel: Channel, recent: RecentBlocks) -> None:
        summary = container.summary
        self.topic, self.metadata = channel.topic, channel.metadata
        self._container, self._channel = container, channel.id
        self._schema = summary.schemas[channel.schema_id].name
        self._chunks = summary.holders.get(channel.id, np.empty(0, np.int64))
        self._recent = recent
        try:
            self.scale = float(self.metadata.get("scale", 1.0))
            check({"scale": self.scale}, {"scale": NOT_ZERO})
        except (ValueError, RecordingError):
            raise self._error(f"scale = {self.metadata['scale']!r}; expected {NOT_ZERO.expected}.") from None

    @property
    def stored(self) -> str:
        """Type of the samples in the file: `float64`, `float32` or `counts`."""
        return next(stored for stored, (schema, _, _) in SCHEMAS.items() if schema == self._schema)

    def _error(self, problem: str) -> RecordingError:
        return RecordingError(f"{self._container.path}: {self.topic}: {problem}")

    @cached_property
    def clock(self) -> Timebase:
        """The sample clock, as the topic's metadata or else the first block state it."""
        if "rate" in self.metadata and "start_ns" in self.metadata:
            try:
                rate, start_ns = float(self.metadata["rate"]), int(self.metadata["start_ns"])
                check({"rate": rate, "start_ns": start_ns}, CLOCK)
                return Timebase(rate, start_ns)
            except (ValueError, RecordingError) as error:
                raise self._error(
                    f"invalid sample clock ({error!s:.200}). Correct rate and start_ns of the metadata."
                ) from None
        for chunk in self._chunks:
            for block, _ in self._stored(int(chunk)):
                return block.clock
        raise self._error(
            "no samples and no sample rate. Remove the topic, or add its rate and start_ns to the metadata."
        )

    @cached_property
    def stop(self) -> int:
        """Number of the sample after the last one."""
        for chunk in self._chunks[::-1]:
            blocks = self._decoded(int(chunk), self.clock)
            if blocks:
                return blocks[-1].stop
        return 0

    @cached_property
    def _ends(self) -> NDArray[np.int64]:
        """For each chunk the sample after its blocks."""
        if not self._chunks.size:
            # All samples were lost, and perhaps the clock.
            return np.empty(0, np.int64)
        return self.clock.samples_at(self._container.summary.ends[self._chunks])

    def _decoded(self, chunk: int, clock: Timebase) -> list[SampleBlock]:
        """Decode and check this topic's blocks of a chunk; recent chunks stay in memory for repeated reading."""
        blocks = self._recent.of(self._channel, chunk)
        if blocks is None:
            blocks = []
            for block, log_time in self._stored(chunk):
                self._check(block, log_time, clock)
                blocks.append(block)
            blocks = _joined(blocks)
            self._recent.store(self._channel, chunk, blocks)
        return blocks

    def _stored(self, chunk: int) -> Iterator[tuple[SampleBlock, int]]:
        """Yield this topic's blocks of a chunk as stored, with their log times in ns."""
        for message in self._container.messages(chunk):
            if message.channel == self._channel:
                try:
                    yield decode(message.data, self._schema), message.log_time
                except RecordingError as error:
                    raise self._error(str(error)) from error

    def _check(self, block: SampleBlock, log_time: int, clock: Timebase) -> None:
        """Compare a block with the layout, on which the search for samples relies."""
        if block.stop > MAX_SAMPLES:
            raise self._error(f"a block begins at sample {block.first_sample}; expected at most {MAX_SAMPLES}.")
        begins = (block.t0_ns - clock.start_ns) * clock.rate * 1e-9 - block.first_sample
        ends = (log_time - clock.start_ns) * clock.rate * 1e-9 - block.stop
        if block.rate != clock.rate or not (abs(begins) < 0.5 and abs(ends) < 0.5):
            should = clock.time_ns(block.first_sample), clock.time_ns(block.stop)
            raise self._error(
                f"the block at sample {block.first_sample} states {block.rate:g} Hz, a start at {block.t0_ns} ns and "
                f"a log time of {log_time} ns; expected {clock.rate:g} Hz, {should[0]} ns and {should[1]} ns, its end."
            )

    def blocks(self, start: int, stop: int) -> Iterator[SampleBlock]:
        """Yield the blocks that hold any sample of [start, stop), in order; contiguous blocks of a chunk are joined."""
        reached = 0
        for chunk in self._chunks[int(np.searchsorted(self._ends, start, side="right")) :]:
            blocks = self._decoded(int(chunk), self.clock)
            for block in blocks:
                if block.first_sample < reached:
                    first = block.first_sample
                    raise self._error(f"a block begins at sample {first}; expected {reached} or later.")
                reached = block.stop
                if block.stop > start and block.first_sample < stop:
                    yield block
            if reached >= stop:
                return

    def read(self, start: int, stop: int) -> Array:
        """Return samples [start, stop) in the unit of the topic, NaN where the file has none.

        Raises `RecordingError` for a damaged chunk, or a range with almost no samples for its size.
        """
        self.refuse_void(start, stop)
        values = np.empty(stop - start)
        reached = start
        for block in self.blocks(start, stop):
            begin, end = max(block.first_sample, start), min(block.stop, stop)
            values[reached - start : begin - start] = np.nan
            block_samples = block.samples[begin - block.first_sample : end - block.first_sample]
            np.multiply(block_samples, self.scale, out=values[begin - start : end - start], dtype=np.float64)
            reached = end
        values[reached - start :] = np.nan
        return values

    def refuse_void(self, start: int, stop: int) -> None:
        """Raise `RecordingError` if the file has almost no samples in a long range."""
        if stop - start <= LARGE_RANGE:
            return
        begin, end = np.searchsorted(self._ends, [start, stop], side="right")
        chunks = self._chunks[int(begin) : int(end) + 1]
        # No sample takes less than four bytes in a chunk.
        max_samples = int(np.minimum(self._container.summary.unpacked[chunks], 1 << 40).sum()) // 4
        if max_samples * LEAST_SHARE < stop - start:
            raise self._error(
                f"samples {start} to {stop - 1}: at most {max_samples} of them are in the file. Choose a range "
                "before or after them (--from, --to)."
            )

    def holes(self) -> Iterator[tuple[int, int]]:
        """Yield the ranges [first, stop) of samples that are missing before the last one; reads all."""
        reached = 0
        for block in self.blocks(0, self.stop):
            if block.first_sample > reached:
                yield reached, block.first_sample
            reached = block.stop


def _joined(blocks: list[SampleBlock]) -> list[SampleBlock]:
    """Join contiguous blocks of a chunk; copies, so that the unpacked chunk does not stay in memory."""
    if any(block.stop != later.first_sample for block, later in pairwise(blocks)):
        return [block._replace(samples=block.samples.copy()) for block in blocks]
    return [blocks[0]._replace(samples=np.concatenate([block.samples for block in blocks]))] if blocks else []
