"""Block of samples of one channel as a protobuf message."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from daq.core.mcap_file.chunk import MESSAGE_HEAD, RECORD_HEAD
from daq.core.mcap_file.protobuf import Schema, descriptor_set_bytes, message_class, varint
from daq.core.recording.layout import WRITER_REMEDY, Timebase
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.signal_chain.field_checks import MAX_SAMPLES
from rig.core.base.errors import RecordingError

if TYPE_CHECKING:
    from rig.core.scene.scene import Scene

# Schema, protobuf type and numpy type for each storage type of samples.
SCHEMAS: dict[str, tuple[str, str, np.dtype[Any]]] = {
    "float64": ("shotrig.BlockFloat64", "double", np.dtype("<f8")),
    "float32": ("shotrig.BlockFloat32", "float", np.dtype("<f4")),
    "counts": ("shotrig.BlockCounts", "sfixed32", np.dtype("<i4")),
}
# Numpy type of the samples for each schema.
SAMPLE_TYPE: dict[str, np.dtype[Any]] = {schema: kind for schema, _, kind in SCHEMAS.values()}

# Header of a protobuf message: three fields of eight bytes, each after its tag, and the tag of the samples.
_HEADER = struct.Struct("<BqBQBdB")
_TAGS = (0x09, 0x11, 0x19, 0x22)
# Maximum number of blocks that are decoded together; the recorder writes a few blocks to a chunk.
_MAX_JOINED_BLOCKS = 64


class SampleBlock(NamedTuple):
    """Successive samples of one channel, as stored in the file."""

    t0_ns: int  # time of the first sample, nanoseconds since the epoch of the recording
    first_sample: int  # index of the first sample
    rate: float  # samples per second [Hz]
    samples: NDArray[Any]  # the stored numbers, (samples,); a view of the message if `encode` wrote it

    @property
    def stop(self) -> int:
        """Number of the sample after the last sample."""
        return self.first_sample + self.samples.size

    @property
    def clock(self) -> Timebase:
        """The sample clock that the block states."""
        return Timebase(self.rate, self.t0_ns - Timebase(self.rate).time_ns(self.first_sample))


@lru_cache
def block_schema(schema: str) -> Schema:
    """Return the schema record of a block, for the file; `schema` is a key of `SAMPLE_TYPE`."""
    samples = next(protobuf_type for name, protobuf_type, _ in SCHEMAS.values() if name == schema)
    header = (("t0_ns", "sfixed64"), ("first_sample", "fixed64"), ("sample_rate_hz", "double"))
    package, message = schema.split(".")
    descriptor_set = descriptor_set_bytes(package, ((message, (*header, ("samples", f"{samples}[]"))),))
    return Schema(schema, "protobuf", descriptor_set, "protobuf")


def encode(clock: Timebase, first_sample: int, samples: NDArray[Any]) -> NDArray[np.uint8]:
    """Encode successive blocks of samples, (channels, blocks, samples), as (channels, blocks, bytes).

    The samples have a type of `SAMPLE_TYPE`. A block is
    {sfixed64 t0_ns = 1; fixed64 first_sample = 2; double sample_rate_hz = 3; repeated samples = 4}.

    >>> data = encode(Timebase(5120.0), 512, np.array([[[1.5, 2.5]]]))
    >>> decode(memoryview(data[0, 0]), "shotrig.BlockFloat64").samples
    array([1.5, 2.5])
    """
    _, blocks, length = samples.shape
    size_bytes, (tag0, tag1, tag2, tag3) = varint(length * samples.itemsize), _TAGS
    first_samples = [first_sample + block * length for block in range(blocks)]
    headers = [
        _HEADER.pack(tag0, clock.time_ns(first), tag1, first, tag2, clock.rate, tag3) + size_bytes
        for first in first_samples
    ]
    messages = np.empty((len(samples), blocks, len(headers[0]) + length * samples.itemsize), np.uint8)
    messages[..., : len(headers[0])] = np.frombuffer(b"".join(headers), np.uint8).reshape(blocks, -1)
    messages[..., len(headers[0]) :] = np.ascontiguousarray(samples).view(np.uint8)
    return messages


def decode(data: memoryview, schema: str) -> SampleBlock:
    """Decode a block; without a copy if `encode` wrote it. Raises `RecordingError` for invalid bytes."""
    kind = SAMPLE_TYPE[schema]
    if len(data) > _HEADER.size:
        tag0, t0_ns, tag1, first, tag2, rate, tag3 = _HEADER.unpack_from(data)
        size_bytes = _size_prefix(len(data))
        samples_offset = _HEADER.size + len(size_bytes)
        if (tag0, tag1, tag2, tag3) == _TAGS and data[_HEADER.size : samples_offset] == size_bytes:
            try:
                return SampleBlock(t0_ns, first, rate, np.frombuffer(data, kind, offset=samples_offset))
            except ValueError:
                stored_bytes = len(data) - samples_offset
                raise RecordingError(f"{stored_bytes} bytes are not a whole number of samples ({schema}).") from None
    return _decode_other_writer(data, schema)


def times_agree(clock: Timebase, first_sample: int, stop: int, t0_ns: int, log_time: int) -> bool:
    """Return whether start and log time (end) of a block agree with its sample indices within half a sample."""
    start_error = (t0_ns - clock.start_ns) * clock.rate * 1e-9 - first_sample
    end_error = (log_time - clock.start_ns) * clock.rate * 1e-9 - stop
    return abs(start_error) < 0.5 and abs(end_error) < 0.5


def check_block(block: SampleBlock, log_time: int, clock: Timebase) -> None:
    """Raise `RecordingError` if the sample numbers of a block contradict the clock, its times or its log time [ns]."""
    if block.stop > MAX_SAMPLES:
        raise RecordingError(f"a block ends at sample {block.stop}; expected at most {MAX_SAMPLES}. {WRITER_REMEDY}")
    if block.rate != clock.rate:
        raise RecordingError(
            f"the block at sample {block.first_sample} states a rate of {block.rate:.17g} Hz; expected "
            f"{clock.rate:.17g} Hz, as in the metadata or the first block. {WRITER_REMEDY}"
        )
    if not times_agree(clock, block.first_sample, block.stop, block.t0_ns, log_time):
        start_ns, end_ns = clock.time_ns(block.first_sample), clock.time_ns(block.stop)
        raise RecordingError(
            f"the block that begins at sample {block.first_sample} states the times {block.t0_ns} ns to {log_time} ns; "
            f"its sample numbers and the rate give {start_ns} ns to {end_ns} ns. {WRITER_REMEDY}"
        )


def decode_contiguous(records: memoryview, channel: int, schema: str, clock: Timebase) -> SampleBlock | None:
    """Decode and join the blocks of a chunk, if it has the form that the recorder writes; otherwise return None.

    Such a chunk contains only contiguous blocks of one channel and one length, whose times agree with the clock.
    Decoding the blocks one by one takes several times as long.
    """
    if len(records) < RECORD_HEAD.size:
        return None
    length = RECORD_HEAD.unpack_from(records)[1]
    count, remainder = divmod(len(records), RECORD_HEAD.size + length)
    layout = _contiguous_layout(length, count, schema) if not remainder and count <= _MAX_JOINED_BLOCKS else None
    if layout is None:
        return None
    numbers, samples, block_samples = layout
    expected = (int(Opcode.MESSAGE), length, channel, *_TAGS, clock.rate, _size_prefix(length - MESSAGE_HEAD.size))
    blocks = list(zip(*[iter(numbers.unpack(records))] * 14, strict=True))
    next_sample = blocks[0][9]
    for opcode, size, number, _, log_time, _, tag0, t0_ns, tag1, first, tag2, rate, tag3, size_bytes in blocks:
        stop = first + block_samples
        if (
            (opcode, size, number, tag0, tag1, tag2, tag3, rate, size_bytes) != expected
            or first != next_sample
            or not times_agree(clock, first, stop, t0_ns, log_time)
        ):
            return None
        next_sample = stop
    return SampleBlock(blocks[0][7], blocks[0][9], clock.rate, np.frombuffer(records, samples)["samples"].flatten())


@lru_cache(maxsize=64)
def _contiguous_layout(length: int, count: int, schema: str) -> tuple[struct.Struct, np.dtype[Any], int] | None:
    """Return the layout of `count` records of `length` bytes, each with one block; None for an impossible length."""
    # It consists of the numbers before the samples, the samples, and the number of samples of a block.
    kind, message_bytes = SAMPLE_TYPE[schema], length - MESSAGE_HEAD.size
    size_bytes = _size_prefix(message_bytes) if message_bytes > _HEADER.size else b""
    sample_bytes = message_bytes - _HEADER.size - len(size_bytes)
    if not size_bytes or sample_bytes < 1 or sample_bytes % kind.itemsize:
        return None
    formats = [part.format.lstrip("<") for part in (RECORD_HEAD, MESSAGE_HEAD, _HEADER)]
    numbers = struct.Struct("<" + f"{''.join(formats)}{len(size_bytes)}s{sample_bytes}x" * count)
    record_bytes, block_samples = RECORD_HEAD.size + length, sample_bytes // kind.itemsize
    head = ("head", f"V{record_bytes - sample_bytes}")
    return numbers, np.dtype([head, ("samples", kind, (block_samples,))]), block_samples


@lru_cache(maxsize=64)
def _size_prefix(message_bytes: int) -> bytes:
    """Return the encoded size (varint) of the samples in a message of this length."""
    # The length of the prefix depends on the size of the payload, which excludes the prefix; two lengths are tried.
    bytes_after_header = message_bytes - _HEADER.size
    max_prefix = len(varint(bytes_after_header))
    lengths = (max_prefix, max_prefix - 1)
    return next((prefix for n in lengths if len(prefix := varint(bytes_after_header - n)) == n), b"")


def _decode_other_writer(data: memoryview, schema: str) -> SampleBlock:
    """Decode a block of another writer, which may omit zero fields or order them differently."""
    from google.protobuf.message import DecodeError

    message = message_class(block_schema(schema).data, schema)()
    try:
        message.ParseFromString(bytes(data))
    except DecodeError as error:
        raise RecordingError(
            f"a block of {len(data)} bytes cannot be read; expected format {schema} ({error})."
        ) from error
    samples: NDArray[Any] = np.array(message.samples, dtype=SAMPLE_TYPE[schema])
    return SampleBlock(message.t0_ns, message.first_sample, message.sample_rate_hz, samples)


def stored_as(scene: Scene, channels: Sequence[ChannelInfo]) -> str:
    """Return the storage type of samples, a key of `SCHEMAS`, as stated in the scene or implied by the converter."""
    if scene.recording.samples is not None:
        return scene.recording.samples
    return "counts" if all(info.volts_per_count is not None for info in channels) else "float64"
