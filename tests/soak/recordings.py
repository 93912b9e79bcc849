"""Damaged recordings, as from a failing disk, and recordings with invalid contents but correct checksums."""

import json
import random
import struct
from pathlib import Path
from typing import Any

from daq.core.mcap_file.compression import zstd
from daq.core.mcap_file.reader import Container
from daq.core.mcap_file.summary import with_checksum
from daq.core.mcap_file.writer import ChunkedFile, Message
from daq.core.recording import layout
from tests.soak.scenes import ESCAPE, MARKUP, UNUSUAL_NUMBERS, UNUSUAL_TEXTS, invalid_scene

# Unusual values of metadata.
UNUSUAL_JSON: tuple[Any, ...] = (
    None,
    True,
    [],
    {},
    [[1, 2]],
    {"a": 1},
    "text",
    ESCAPE,
    MARKUP,
    "x" * 60_000,
    [1e308] * 100,
    -1,
    0,
    10**300,
    1.5,
    2**40,
    2**62,
    2**63,
)


def damage(source: bytes, rng: random.Random) -> bytes:
    """Return the bytes of a file, damaged at one to five random positions."""
    data = bytearray(source)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        position = rng.randrange(len(data)) if data else 0
        kind = rng.randrange(9)
        if kind == 0:  # cut off the end
            data[position:] = b""
        elif kind == 1 and data:  # flip a bit
            data[position] ^= 1 << rng.randrange(8)
        elif kind == 2:  # overwrite with zeros
            size = rng.choice((1, 8, 512, 4096, 65536))
            data[position : position + size] = bytes(len(data[position : position + size]))
        elif kind == 3:  # overwrite with random bytes
            size = rng.choice((1, 9, 512, 5000))
            data[position : position + size] = rng.randbytes(len(data[position : position + size]))
        elif kind == 4:  # remove bytes
            del data[position : position + rng.choice((1, 7, 512, 4096))]
        elif kind == 5:  # insert bytes
            data[position:position] = rng.randbytes(rng.choice((1, 7, 512)))
        elif kind == 6:  # overwrite with bytes of another position
            source_position, size = rng.randrange(len(data) + 1), rng.choice((16, 512, 4096))
            data[position : position + size] = data[source_position : source_position + size]
        elif kind == 7:  # cut off the beginning
            data[:position] = b""
        elif len(data) > position + 8:  # write an extreme number, such as a length
            struct.pack_into("<Q", data, position, rng.choice((0, 1, 2**31, 2**63, 2**64 - 1, 2**40)))
    return bytes(data)


def write_invalid_recording(source: Path, target: Path, rng: random.Random) -> str:
    """Copy a recording with one kind of invalid content but correct checksums; return its description."""
    kind = rng.choice(
        ("channel", "channel", "channel", "marker", "event", "metadata", "scene", "time", "name", "chunk", "many")
    )
    description = kind
    with Container(source) as container, target.open("wb") as file:
        summary = container.summary
        copy = ChunkedFile(file, "soak")
        schemas = {0: 0}
        for number, schema in summary.schemas.items():
            schemas[number] = copy.add_schema(schema.name, schema.encoding, schema.data)
        sample_channels = [
            number for number, channel in summary.channels.items() if channel.topic.startswith(layout.RAW)
        ]
        changed_channel = rng.choice(sample_channels)
        # Numbers of the schemas and channels in the source: numbers in the copy.
        numbers = {}
        for number, channel in summary.channels.items():
            topic, metadata = channel.topic, dict(channel.metadata)
            if kind == "channel" and number == changed_channel:
                key = rng.choice([*metadata, "unit", "filter"])
                metadata[key] = _unusual_text(rng)
                description = f"{key} = {metadata[key][:40]!r}"
                if rng.random() < 0.1:
                    del metadata[key]
                    description = f"no {key}"
            if kind == "name" and number == changed_channel:
                topic = layout.RAW + rng.choice(UNUSUAL_TEXTS)
                metadata["name"] = topic.removeprefix(layout.RAW)
            numbers[number] = copy.add_channel(topic, channel.message_encoding, schemas[channel.schema_id], metadata)
        if kind == "many":
            for extra in range(rng.choice((10, 3000))):
                copy.add_channel(
                    f"{layout.RAW}extra{extra}", "protobuf", schemas[summary.channels[changed_channel].schema_id], {}
                )
        for chunk in range(len(summary.offsets)):
            messages = []
            for message in container.messages(chunk):
                channel, data = summary.channels[message.channel], bytes(message.data)
                times = [message.log_time, message.publish_time]
                if kind == "marker" and channel.topic == layout.MARKERS:
                    data = _with_unusual_value(data, rng)
                if kind == "event" and channel.topic == layout.EVENTS:
                    data = _with_unusual_value(data, rng)
                if kind == "time" and message.channel in sample_channels and chunk >= len(summary.offsets) // 2:
                    # The same shift for all blocks.
                    shift = 2 ** random.Random(str(summary.offsets)).choice((20, 27, 40, 62))
                    data, times = shift_block(data, times, shift)
                    description = f"time shifted by {shift} samples"
                messages.append(
                    Message(numbers[message.channel], *(time % 2**64 for time in times), data, message.sequence)
                )
            copy.add_chunk(messages, zstd())
        if kind == "chunk":
            # 64 MB of zeros, or millions of empty records of an unknown type.
            content = bytes(1 << 26) if rng.random() < 0.5 else struct.pack("<BQ", 0xEE, 0) * (7_000_000)
            for _ in range(rng.choice((1, 20))):
                _write_chunk(file, copy, content)
        records = container.metadata()
        changed_record = rng.choice(list(records))
        for record, fields in records.items():
            changed = {key: text for key, text in fields.items() if key != "crc32"}
            if kind == "metadata" and record == changed_record:
                key = rng.choice(list(changed))
                changed[key] = _unusual_text(rng)
                description = f"{record}.{key} = {changed[key][:40]!r}"
            copy.add_metadata(record, with_checksum(changed))
        scene = container.attachment(layout.SCENE_FILE) or b""
        if kind == "scene":
            scene = invalid_scene(rng).encode(errors="replace")
        copy.add_attachment(0, 0, layout.SCENE_FILE, "application/yaml", scene)
        copy.finish()
    return description


def _unusual_text(rng: random.Random) -> str:
    """Draw an unusual text, number or JSON value, as text."""
    if rng.random() < 0.3:
        return rng.choice(UNUSUAL_TEXTS)
    if rng.random() < 0.3:
        return repr(rng.choice(UNUSUAL_NUMBERS))
    return json.dumps(rng.choice(UNUSUAL_JSON))


def _with_unusual_value(data: bytes, rng: random.Random) -> bytes:
    """Return a JSON object with an unusual value of an existing or an additional key."""
    content = json.loads(data)
    content[rng.choice([*content, "channel", "reason", "settled"])] = rng.choice((*UNUSUAL_JSON, *UNUSUAL_NUMBERS))
    return json.dumps(content).encode()


def shift_block(data: bytes, times: list[int], shift: int) -> tuple[bytes, list[int]]:
    """Shift a block of samples by a number of samples, with its times [ns]; unchanged if it cannot be encoded."""
    from daq.core.recording.layout import Timebase
    from daq.core.recording.sample_block import decode, encode

    for schema in ("shotrig.BlockFloat64", "shotrig.BlockCounts", "shotrig.BlockFloat32"):
        try:
            block = decode(memoryview(data), schema)
            break
        except Exception:
            continue
    clock = Timebase(block.rate)
    first = block.first_sample + shift
    try:
        return encode(clock, first, block.samples[None, None]).tobytes(), [
            clock.time_ns(first + block.samples.size),
            clock.time_ns(first),
        ]
    except struct.error:
        return data, times


def _write_chunk(file: Any, copy: ChunkedFile, content: bytes) -> None:
    """Write a chunk with an extreme compression ratio."""
    import zlib

    from mcap import records
    from mcap.data_stream import RecordBuilder
    from zstandard import ZstdCompressor

    begin = file.tell()
    builder = RecordBuilder()
    records.Chunk(
        compression="zstd",
        data=ZstdCompressor().compress(content),
        message_start_time=0,
        message_end_time=0,
        uncompressed_crc=zlib.crc32(content),
        uncompressed_size=len(content),
    ).write(builder)
    file.write(builder.end())
    # The index claims that every channel has messages in the chunk.
    records.ChunkIndex(
        chunk_length=file.tell() - begin,
        chunk_start_offset=begin,
        compression="zstd",
        compressed_size=0,
        message_end_time=0,
        message_index_length=0,
        message_index_offsets=dict.fromkeys(range(1, 200), 0),
        message_start_time=0,
        uncompressed_size=len(content),
    ).write(builder)
    copy._chunk_indexes.append(builder.end())
