"""`Recording.check` reports damage of any significant bit; a file that passes the check has unchanged content."""

import struct
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

import daq
from daq.core.mcap_file.file_check import check_file
from daq.core.mcap_file.reader import Container
from rig.core.base.errors import RecordingError
from tests.daq.recording.recordings import ONE_DAMPER, make_scene, random_volts, write_recording


@pytest.fixture(scope="module")
def intact_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = make_scene(recording={"truth": True, "samples": "float32"}, **ONE_DAMPER)
    return write_recording(tmp_path_factory.mktemp("whole") / "a.mcap", random_volts(300), scene)


def record_spans(data: bytes) -> list[tuple[int, int, int]]:
    """Return opcode, beginning and end of each record, between the signatures of 8 bytes at both ends of the file."""
    begin, spans = 8, []
    while begin < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, begin)
        spans.append((opcode, begin, begin + 9 + length))
        begin += 9 + length
    return spans


def content(path: Path) -> list[object]:
    """Return all data that a reader gets from a recording."""
    with daq.open(path) as recording:
        samples = [recording.read(name).tolist() for name in recording.channels]
        truth = [recording.truth(kind).tolist() for kind in ("displacement", "gap", "contact")]
        descriptions = recording.markers, recording.metadata, recording.scene, recording.channels, recording.samples
        return [samples, truth, recording.events.tolist(), *descriptions]


def undetected_flips(path: Path, intact_file: Path, positions: list[int]) -> list[int]:
    """Flip a bit of each byte in turn; return the positions whose damage is not reported, but has no effect."""
    data, true, undetected = intact_file.read_bytes(), content(intact_file), []
    path.write_bytes(data)
    with path.open("r+b", buffering=0) as file:
        for position in positions:
            file.seek(position)
            file.write(bytes([data[position] ^ 1 << position % 8]))
            try:
                # Damaged data is never read, also without a check.
                assert content(path) == true
                with daq.open(path) as recording:
                    recording.check()
                undetected.append(position)
            except RecordingError as error:
                assert str(path) in str(error)
            file.seek(position)
            file.write(data[position : position + 1])
    return undetected


def test_flipped_bits_in_message_indexes_are_reported(intact_file: Path, tmp_path: Path) -> None:
    indexes = [span for span in record_spans(intact_file.read_bytes()) if span[0] == Opcode.MESSAGE_INDEX]
    positions = [position for _, begin, end in indexes for position in range(begin, end)]
    assert len(positions) > 300
    assert undetected_flips(tmp_path / "a.mcap", intact_file, positions[::5]) == []


def test_undetected_flipped_bits_have_no_effect(intact_file: Path, tmp_path: Path) -> None:
    data = intact_file.read_bytes()
    # At least one bit in the content of every record is flipped.
    positions = {*range(0, len(data), 113), *(begin + 9 for _, begin, _ in record_spans(data))}
    undetected = undetected_flips(tmp_path / "a.mcap", intact_file, sorted(positions))
    # A changed program name, and packed bytes that unpack to the same records, have no effect.
    header_end = next(end for opcode, _, end in record_spans(data) if opcode == Opcode.HEADER)
    program_name = range(data.index(b"shotrig"), header_end)
    assert len([position for position in undetected if position not in program_name]) < 0.01 * len(positions)


def test_checksum_of_the_data_section_is_verified(intact_file: Path, tmp_path: Path) -> None:
    data = bytearray(intact_file.read_bytes())
    begin = next(begin for opcode, begin, _ in record_spans(bytes(data)) if opcode == Opcode.DATA_END)
    struct.pack_into("<I", data, begin + 9, 1)
    (tmp_path / "a.mcap").write_bytes(data)
    with (
        daq.open(tmp_path / "a.mcap") as recording,
        pytest.raises(RecordingError, match="checksum of the data section"),
    ):
        recording.check()


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("chunked", [True, False])
def test_files_of_the_reference_writer_pass(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=200, compression=compression, use_chunking=chunked, enable_data_crcs=True)
        writer.start("profile", "another program")
        channel_ids = [writer.register_channel(topic, "json", 0, {"a": "b"}) for topic in ("/a", "/b")]
        for time in (5, 3, 9, 8, 20, 1):
            for channel_id in channel_ids:
                writer.add_message(channel_id, time, b'{"value": 1.0}' * 3, time)
        writer.add_attachment(1, 2, "notes", "text/plain", b"text")
        writer.add_metadata("run", {"rate": "1"})
        writer.finish()
    with Container(path) as container:
        check_file(container)
