"""Files are byte-identical to those of the mcap package's own writer."""

from io import BytesIO

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from daq.core.mcap_file.compression import lz4, zstd, zstd_for_samples
from daq.core.mcap_file.writer import ChunkedFile, Message, Messages

# Messages of three chunks: channel, log time, publish time (ns, up to 64 bits), data, sequence number.
CHUNKS = [
    [Message(1, 5, 3, b"first", 0), Message(2, 4, 4, b"", 7), Message(1, 9, 9, b"x" * 300, 1)],
    [],
    [Message(2, 2**63, 2**63, bytes(1000), 8)],
]


def file_by_chunked_file(compressor):
    stream = BytesIO()
    file = ChunkedFile(stream, "test 1")
    schema = file.add_schema("pkg.Thing", "protobuf", b"\x01\x02")
    for topic in ("/a", "/b"):
        file.add_channel(topic, "protobuf", schema, {"unit": "m", "name": topic})
    is_written = [file.add_chunk(chunk, compressor) for chunk in CHUNKS[:2]]
    file.add_metadata("run", {"seed": "1"})
    file.add_attachment(1, 2, "scene.yaml", "application/yaml", b"name: x")
    is_written.append(file.add_chunk(CHUNKS[2], compressor))
    file.finish()
    assert is_written == [True, False, True]
    return stream.getvalue()


def file_by_mcap_package(compression):
    stream = BytesIO()
    writer = Writer(stream, chunk_size=2**62, compression=CompressionType[compression.upper()])
    writer.start(profile="", library="test 1")
    schema = writer.register_schema("pkg.Thing", "protobuf", b"\x01\x02")
    for topic in ("/a", "/b"):
        writer.register_channel(topic, "protobuf", schema, {"unit": "m", "name": topic})

    def add(chunk):
        for channel, log_time, publish_time, data, sequence in chunk:
            writer.add_message(channel, log_time, data, publish_time, sequence)
        writer.flush()

    add(CHUNKS[0])
    writer.add_metadata("run", {"seed": "1"})
    writer.add_attachment(1, 2, "scene.yaml", "application/yaml", b"name: x")
    add(CHUNKS[2])
    writer.finish()
    return stream.getvalue()


@pytest.mark.parametrize("compressor", [zstd(), zstd_for_samples(), lz4()])
def test_writer_equals_the_package_writer(compressor, monkeypatch):
    monkeypatch.setattr("zstandard.compress", compressor.compress)
    assert file_by_chunked_file(compressor) == file_by_mcap_package(compressor.name.decode())


def test_batched_messages_equal_single_messages():
    times, sequence, channels = np.array([7, 9, 2**63], np.uint64), np.arange(3), [2, 1]
    data = np.random.default_rng(0).integers(0, 256, (2, 3, 28)).astype(np.uint8)
    batch = Messages(channels, times, times, data, sequence)
    single_messages = [
        Message(channels[row], int(times[column]), int(times[column]), data[row, column].tobytes(), column)
        for row in range(2)
        for column in range(3)
    ]
    # The batch is between a single message and a batch of one.
    before = Message(1, 2**63 + 5, 1, b"before", 0)
    after = Messages([3], times[:1], times[:1], data[:1, :1], sequence[2:])
    written = []
    for chunk in ([before, batch, after], [before, *single_messages, Message(3, 7, 7, data[0, 0].tobytes(), 2)]):
        stream = BytesIO()
        file = ChunkedFile(stream, "test 1")
        assert file.add_chunk(chunk, zstd())
        file.finish()
        written.append(stream.getvalue())
    assert written[0] == written[1]


def test_file_without_chunks_can_be_read():
    stream = BytesIO()
    ChunkedFile(stream, "test 1").finish()
    summary = make_reader(BytesIO(stream.getvalue())).get_summary()
    assert summary is not None
    assert summary.statistics.message_count == 0
