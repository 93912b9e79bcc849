"""The samples of one topic of a recording, read by sample index.

A topic contains the samples of a channel, or of a true motion, as blocks in compressed chunks. Only the chunks that are
needed are decoded.
"""

from collections import OrderedDict
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from daq.core.mcap_file.reader import Container
from daq.core.recording.layout import MAX_VOLTS, WRITER_REMEDY, Timebase, stated_clock
from daq.core.recording.sample_block import SCHEMAS, SampleBlock, check_block, decode, decode_contiguous
from daq.core.signal_chain.field_checks import MAX_SAMPLES, NOT_ZERO, check
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError
from rig.core.numerics.runs import runs_of

# Number of samples above which a request is compared with the file first: a wrong index must not exhaust the memory.
_LARGE_RANGE = 1 << 22
# Largest ratio of requested samples to samples in the file; a damaged sample number must not exhaust the memory.
_MAX_REQUESTED_PER_STORED = 16
# Voltages above this multiple of the converter's range are treated as invalid. The factor admits readings that were
# imported with a wrong unit or range; `daq import` reports such a mistake.
_MAX_RANGES = 1000.0
# Memory for decoded samples [bytes], cached because an analysis reads a measured segment several times.
_MAX_CACHE_BYTES = 1 << 27


class BlockCache:
    """Cache of the latest decoded blocks of a recording by channel number and chunk, up to `_MAX_CACHE_BYTES`."""

    def __init__(self) -> None:
        self._blocks: OrderedDict[tuple[int, int], list[SampleBlock]] = OrderedDict()
        self._bytes = 0

    def get(self, channel: int, chunk: int) -> list[SampleBlock] | None:
        """Return the blocks of a channel in a chunk; None if they are not in the cache."""
        return self._blocks.get((channel, chunk))

    def store(self, channel: int, chunk: int, blocks: list[SampleBlock]) -> None:
        """Store the blocks of a channel in a chunk; remove the oldest entries."""
        self._blocks[channel, chunk] = blocks
        self._bytes += _size_bytes(blocks)
        while len(self._blocks) > 1 and self._bytes > _MAX_CACHE_BYTES:
            self._bytes -= _size_bytes(self._blocks.popitem(last=False)[1])


def _size_bytes(blocks: list[SampleBlock]) -> int:
    return sum(block.samples.nbytes for block in blocks)


class Series:
    """The samples of one topic."""

    def __init__(self, container: Container, channel: Channel, block_cache: BlockCache) -> None:
        summary = container.summary
        self.topic, self.metadata = channel.topic, channel.metadata
        self._container, self._channel = container, channel.id
        self._schema = summary.schemas[channel.schema_id].name
        self._chunks = summary.chunks_of_channel.get(channel.id, np.empty(0, np.int64))
        self._block_cache = block_cache
        if self.metadata.get("stored", self.stored) != self.stored:
            raise self._error(
                f"the metadata state samples of type {self.metadata['stored']!r:.40}, the schema {self.stored!r}. "
                f"{WRITER_REMEDY}"
            )
        try:
            self.scale = float(self.metadata.get("scale", 1.0))
            check({"scale": self.scale}, {"scale": NOT_ZERO})
        except (ValueError, RecordingError):
            raise self._error(f"scale = {self.metadata['scale']!r}; expected {NOT_ZERO.expected}.") from None
        try:
            self._max_volts = min(MAX_VOLTS, _MAX_RANGES * float(self.metadata["range"]))
        except (KeyError, ValueError):
            self._max_volts = MAX_VOLTS

    @property
    def stored(self) -> str:
        """Type of the samples in the file: `float64`, `float32` or `counts`."""
        return next(stored for stored, (schema, _, _) in SCHEMAS.items() if schema == self._schema)

    def _error(self, problem: str) -> RecordingError:
        return RecordingError(f"{self._container.path}: {self.topic}: {problem}")

    @cached_property
    def clock(self) -> Timebase:
        """The sample clock from the metadata of the topic, otherwise from the first block."""
        try:
            clock = stated_clock(self.metadata)
        except RecordingError as error:
            raise self._error(f"{error} Correct rate and start_ns of the metadata.") from None
        if clock is not None:
            return clock
        for chunk in self._chunks:
            for block, _ in self._stored_blocks(int(chunk)):
                return block.clock
        raise self._error(
            "the topic has no samples and no sample rate. Remove it, or add its rate and start_ns to the metadata."
        )

    @cached_property
    def stop(self) -> int:
        """Number of the sample after the last sample."""
        for chunk in self._chunks[::-1]:
            blocks = self._decoded(int(chunk), self.clock)
            if blocks:
                return blocks[-1].stop
        return 0

    @cached_property
    def _chunk_stops(self) -> NDArray[np.int64]:
        """For each chunk: number of the sample after the last sample."""
        if not self._chunks.size:
            # Without samples, the clock may be unknown.
            return np.empty(0, np.int64)
        return self.clock.samples_at(self._container.summary.ends[self._chunks])

    def _decoded(self, chunk: int, clock: Timebase) -> list[SampleBlock]:
        """Return the decoded and checked blocks of this topic in a chunk."""
        blocks = self._block_cache.get(self._channel, chunk)
        if blocks is None:
            records = self._container.records(chunk)
            joined = decode_contiguous(records, self._channel, self._schema, clock)
            if joined is not None and joined.stop <= MAX_SAMPLES:
                blocks = [joined]
            else:
                blocks = []
                for block, log_time in self._stored_blocks(chunk, records):
                    try:
                        check_block(block, log_time, clock)
                    except RecordingError as error:
                        raise self._error(str(error)) from error
                    blocks.append(block)
                blocks = _join_contiguous(blocks)
            if self.stored != "counts":
                blocks = [self._without_invalid(block) for block in blocks]
            self._block_cache.store(self._channel, chunk, blocks)
        return blocks

    def _without_invalid(self, block: SampleBlock) -> SampleBlock:
        """Replace numbers that no converter outputs by NaN, the value of lost samples."""
        with np.errstate(invalid="ignore"):
            if block.samples.size == 0 or max(block.samples.max(), -block.samples.min()) < self._max_volts:
                return block
            return block._replace(samples=np.where(np.abs(block.samples) < self._max_volts, block.samples, np.nan))

    def _stored_blocks(self, chunk: int, records: memoryview | None = None) -> Iterator[tuple[SampleBlock, int]]:
        """Yield each block of this topic in a chunk, unchecked, with its log time in ns."""
        for message in self._container.messages(chunk, records):
            if message.channel == self._channel:
                try:
                    yield decode(message.data, self._schema), message.log_time
                except RecordingError as error:
                    raise self._error(
                        f"{error} Run `daq recover` to keep the other blocks, or record again."
                    ) from error

    def blocks(self, start: int, stop: int) -> Iterator[SampleBlock]:
        """Yield the blocks with samples of [start, stop), in order; contiguous blocks of a chunk are joined."""
        next_sample = 0
        for chunk in self._chunks[int(np.searchsorted(self._chunk_stops, start, side="right")) :]:
            blocks = self._decoded(int(chunk), self.clock)
            for block in blocks:
                if block.first_sample < next_sample:
                    first = block.first_sample
                    raise self._error(
                        f"blocks overlap: a block begins at sample {first}, but the previous block ends at sample "
                        f"{next_sample}. {WRITER_REMEDY}"
                    )
                next_sample = block.stop
                if block.stop > start and block.first_sample < stop:
                    yield block
            if next_sample >= stop:
                return

    def read(self, start: int, stop: int) -> Array:
        """Return samples [start, stop), NaN where the file has none; `RecordingError` if damaged or nearly empty."""
        self.reject_mostly_lost(start, stop)
        values = np.empty(stop - start)
        next_sample = start
        for block in self.blocks(start, stop):
            begin, end = max(block.first_sample, start), min(block.stop, stop)
            values[next_sample - start : begin - start] = np.nan
            block_samples = block.samples[begin - block.first_sample : end - block.first_sample]
            np.multiply(block_samples, self.scale, out=values[begin - start : end - start], dtype=np.float64)
            next_sample = end
        values[next_sample - start :] = np.nan
        return values

    def reject_mostly_lost(self, start: int, stop: int) -> None:
        """Raise `RecordingError` if almost all samples [start, stop) of a long range are missing in the file."""
        if stop - start <= _LARGE_RANGE:
            return
        begin, end = np.searchsorted(self._chunk_stops, [start, stop], side="right")
        chunks = self._chunks[int(begin) : int(end) + 1]
        # A sample takes at least four bytes in a chunk.
        max_samples = int(np.minimum(self._container.summary.unpacked[chunks], 1 << 40).sum()) // 4
        if max_samples * _MAX_REQUESTED_PER_STORED < stop - start:
            raise self._error(
                f"samples {start} to {stop - 1}: at most {max_samples} of them are in the file. Choose a range "
                "before or after them."
            )

    def missing_ranges(self) -> Iterator[tuple[int, int]]:
        """Yield the ranges [first, stop) of missing samples before the last sample; decodes the whole topic."""
        next_sample = 0
        for block in self.blocks(0, self.stop):
            if block.first_sample > next_sample:
                yield next_sample, block.first_sample
            yield from self._invalid_in(block)
            next_sample = block.stop

    def invalid_ranges(self) -> Iterator[tuple[int, int]]:
        """Yield the ranges [first, stop) of samples that no converter outputs; decodes the whole topic."""
        for block in self.blocks(0, self.stop) if self.stored != "counts" else ():
            yield from self._invalid_in(block)

    def _invalid_in(self, block: SampleBlock) -> Iterator[tuple[int, int]]:
        if self.stored != "counts":
            for first, stop in runs_of(np.isnan(block.samples)):
                yield block.first_sample + first, block.first_sample + stop


def _join_contiguous(blocks: list[SampleBlock]) -> list[SampleBlock]:
    """Join the blocks of a chunk if they are contiguous; the copies allow the unpacked chunk to be freed."""
    if any(block.stop != later.first_sample for block, later in pairwise(blocks)):
        return [block._replace(samples=block.samples.copy()) for block in blocks]
    return [blocks[0]._replace(samples=np.concatenate([block.samples for block in blocks]))] if blocks else []
