"""A block of samples of one channel as a protobuf message: encoded by one pack, decoded by one view."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from daq.recording.layout import Timebase
from daq.recording.protobuf import Schema, descriptors, message_class, varint
from rig.errors import RecordingError

if TYPE_CHECKING:
    from daq.signal_chain.channel import ChannelInfo
    from rig.scene.scene import Scene

# Storage type of samples: schema, protobuf type and numpy type in the file.
SCHEMAS: dict[str, tuple[str, str, np.dtype[Any]]] = {
    "float64": ("shotrig.BlockFloat64", "double", np.dtype("<f8")),
    "float32": ("shotrig.BlockFloat32", "float", np.dtype("<f4")),
    "counts": ("shotrig.BlockCounts", "sfixed32", np.dtype("<i4")),
}
SAMPLE_TYPE: dict[str, np.dtype[Any]] = {schema: kind for schema, _, kind in SCHEMAS.values()}

# The four fields in the order of their numbers: three of eight bytes behind their tags, then the samples.
_HEAD = struct.Struct("<BqBQBdB")
_TAGS = (0x09, 0x11, 0x19, 0x22)


class SampleBlock(NamedTuple):
    """Samples of one channel as stored in the file."""

    t0_ns: int  # time of the first sample, nanoseconds since the epoch of the recording
    first_sample: int  # Number of the first sample
    rate: float  # Samples per second, Hz
    samples: NDArray[Any]  # the stored numbers; a view into the message, read-only; shape (samples,)

    @property
    def stop(self) -> int:
        """Number of the sample after the last one."""
        return self.first_sample + self.samples.size

    @property
    def clock(self) -> Timebase:
        """The sample clock that the block states."""
        return Timebase(self.rate, self.t0_ns - Timebase(self.rate).time_ns(self.first_sample))


@lru_cache
def block_schema(schema: str) -> Schema:
    """Describe a block schema (a key of `SAMPLE_TYPE`) for the file."""
    samples = next(protobuf_type for name, protobuf_type, _ in SCHEMAS.values() if name == schema)
    head = (("t0_ns", "sfixed64"), ("first_sample", "fixed64"), ("sample_rate_hz", "double"))
    package, message = schema.split(".")
    described = descriptors(package, ((message, (*head, ("samples", f"{samples}[]"))),))
    return Schema(schema, "protobuf", described, "protobuf")


def encode(clock: Timebase, first_sample: int, samples: NDArray[Any]) -> NDArray[np.uint8]:
    """Encode successive blocks of samples, (channels, blocks, samples), as (channels, blocks, bytes).

    The samples have a type of `SAMPLE_TYPE`. A block is
    {sfixed64 t0_ns = 1; fixed64 first_sample = 2; double sample_rate_hz = 3; repeated samples = 4}.

    >>> data = encode(Timebase(5120.0), 512, np.array([[[1.5, 2.5]]]))
    >>> decode(memoryview(data[0, 0]), "shotrig.BlockFloat64").samples
    array([1.5, 2.5])
    """
    _, blocks, length = samples.shape
    size, (tag0, tag1, tag2, tag3) = varint(length * samples.itemsize), _TAGS
    firsts = [first_sample + block * length for block in range(blocks)]
    heads = [_HEAD.pack(tag0, clock.time_ns(first), tag1, first, tag2, clock.rate, tag3) + size for first in firsts]
    messages = np.empty((len(samples), blocks, len(heads[0]) + length * samples.itemsize), np.uint8)
    messages[..., : len(heads[0])] = np.frombuffer(b"".join(heads), np.uint8).reshape(blocks, -1)
    messages[..., len(heads[0]) :] = np.ascontiguousarray(samples).view(np.uint8)
    return messages


def decode(data: memoryview, schema: str) -> SampleBlock:
    """Decode a block of a schema in `SAMPLE_TYPE`, without a copy; raise `RecordingError` for other bytes."""
    kind = SAMPLE_TYPE[schema]
    if len(data) > _HEAD.size:
        tag0, t0_ns, tag1, first, tag2, rate, tag3 = _HEAD.unpack_from(data)
        size = _size_prefix(len(data))
        place = _HEAD.size + len(size)
        if (tag0, tag1, tag2, tag3) == _TAGS and data[_HEAD.size : place] == size:
            try:
                return SampleBlock(t0_ns, first, rate, np.frombuffer(data, kind, offset=place))
            except ValueError:
                raise RecordingError(f"{len(data) - place} bytes are not a whole number of {schema} samples") from None
    return _decode_any(data, schema)


@lru_cache(maxsize=64)
def _size_prefix(message: int) -> bytes:
    """Encode the size of the samples in a message of `message` bytes, more than its head."""
    body = message - _HEAD.size
    longest = len(varint(body))
    return next((size for n in (longest, longest - 1) if len(size := varint(body - n)) == n), b"")


def _decode_any(data: memoryview, schema: str) -> SampleBlock:
    """Decode a block of another writer: zero fields left out, or fields in another order."""
    from google.protobuf.message import DecodeError

    message = message_class(block_schema(schema).data, schema)()
    try:
        message.ParseFromString(bytes(data))
    except DecodeError as error:
        raise RecordingError(f"a message of {len(data)} bytes is not a {schema} ({error}).") from error
    samples: NDArray[Any] = np.array(message.samples, dtype=SAMPLE_TYPE[schema])
    return SampleBlock(message.t0_ns, message.first_sample, message.sample_rate_hz, samples)


def stored_as(scene: Scene, channels: Sequence[ChannelInfo]) -> str:
    """Return the storage type of samples, a key of `SCHEMAS`: the scene's, or else that of the converter."""
    if scene.recording.samples is not None:
        return scene.recording.samples
    return "counts" if all(info.volts_per_count is not None for info in channels) else "float64"
