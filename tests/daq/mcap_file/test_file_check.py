"""`Recording.check` reports damage of any significant bit; an accepted file reads without change."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

import daq
from daq.mcap_file.file_check import check_file
from daq.mcap_file.reader import Container
from rig.errors import RecordingError
from tests.daq.recording.recordings import DAMPERS, scene, signal, write


@pytest.fixture(scope="module")
def intact_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bench_scene = scene(recording={"truth": True, "samples": "float32"}, **DAMPERS)
    return write(tmp_path_factory.mktemp("whole") / "a.mcap", signal(300), bench_scene)


def spans(data: bytes) -> list[tuple[int, int, int]]:
    """Opcode, beginning and end of each record."""
    place, result = 8, []
    while place < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, place)
        result.append((opcode, place, place + 9 + length))
        place += 9 + length
    return result


def content(path: Path) -> list[object]:
    """All data that a reader gets from a recording."""
    with daq.open(path) as recording:
        samples = [recording.read(name).tolist() for name in recording.channels]
        truth = [recording.truth(kind).tolist() for kind in ("displacement", "gap", "contact")]
        rest = recording.markers, recording.events.tolist(), recording.metadata, recording.scene
        return [samples, truth, *rest, recording.channels, recording.samples]


def undetected(path: Path, intact_file: Path, places: list[int]) -> list[int]:
    """Flip a bit of each byte in turn; return the bytes whose damage is not reported."""
    data, undetected_places = bytearray(intact_file.read_bytes()), []
    for place in places:
        data[place] ^= 1 << place % 8
        path.write_bytes(data)
        try:
            with daq.open(path) as recording:
                recording.check()
            assert content(path) == content(intact_file)
            undetected_places.append(place)
        except RecordingError:
            pass
        data[place] ^= 1 << place % 8
    return undetected_places


def test_flipped_bits_in_message_indexes_are_reported(intact_file: Path, tmp_path: Path) -> None:
    indexes = [span for span in spans(intact_file.read_bytes()) if span[0] == Opcode.MESSAGE_INDEX]
    places = [place for _, begin, end in indexes for place in range(begin, end)]
    assert len(places) > 300
    assert undetected(tmp_path / "a.mcap", intact_file, places[::2]) == []


@pytest.mark.parametrize("step", [151, pytest.param(19, marks=pytest.mark.thorough)])
def test_undetected_bits_have_no_effect(intact_file: Path, tmp_path: Path, step: int) -> None:
    data = intact_file.read_bytes()
    undetected_places = undetected(tmp_path / "a.mcap", intact_file, list(range(0, len(data), step)))
    # Only the name of the writing program, and packed bytes that unpack to the same records.
    name = range(data.index(b"shotrig"), next(end for opcode, _, end in spans(data) if opcode == Opcode.HEADER))
    assert len([place for place in undetected_places if place not in name]) < 0.001 * len(data) + 1


def test_checksum_of_the_data_section_is_verified(intact_file: Path, tmp_path: Path) -> None:
    data = bytearray(intact_file.read_bytes())
    begin = next(begin for opcode, begin, _ in spans(bytes(data)) if opcode == Opcode.DATA_END)
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
        numbers = [writer.register_channel(topic, "json", 0, {"a": "b"}) for topic in ("/a", "/b")]
        for time in (5, 3, 9, 8, 20, 1):
            for number in numbers:
                writer.add_message(number, time, b'{"value": 1.0}' * 3, time)
        writer.add_attachment(1, 2, "notes", "text/plain", b"text")
        writer.add_metadata("run", {"rate": "1"})
        writer.finish()
    with Container(path) as container:
        check_file(container)
