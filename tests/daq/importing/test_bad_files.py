"""Import of damaged and unusual files of every format: an error message, no recording, and no changed file."""

import gc
import json
import struct
import sys
import tracemalloc
import warnings
import zipfile
from contextlib import ExitStack
from pathlib import Path

import h5py
import nptdms
import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from scipy.io import savemat, wavfile
from typer.testing import CliRunner

import daq
from daq.commands.cli import app
from daq.extras.importing.channel_table import Column
from daq.extras.importing.files import signals_of
from rig.core.base.errors import RecordingError, RunWarning, SceneError, ShotrigError
from tests.daq.importing.files import NAMES, RATE, WRITERS, make_scene, random_samples, write_uff
from tests.daq.recording.recordings import random_volts, write_recording

pytestmark = [
    # Readers of other packages leave damaged files open and warn.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore"),
]
# Channel tables refer to columns by number, as damaged files may have no names.
TABLE = {name: Column(str(number), unit=unit) for number, (name, unit) in enumerate(zip(NAMES, "gVN", strict=True), 1)}
TABLE["body2"] = Column("2", unit="m/s^2")
EXTENSIONS = (".csv", ".tdms", ".uff", ".wav", ".npz", ".npy", ".mat", ".mcap")
CSV_LINE = b"0.0,1,2,3\n"
WAV_HEAD, WAV_DATA = b"RIFF\x40\0\0\0WAVEfmt \x10\0\0\0", b"data\4\0\0\0abcd"


def npy_file(shape: str, descr: str = "'<f8'") -> bytes:
    """Return a numpy file with this shape in its header and 100 numbers."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header + bytes(800)


def write_compressed_zeros(path: Path, numbers: int) -> None:
    """Write an .npz file of zeros, which is a thousand times as large when it is unpacked."""
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("body1.npy", "w", force_zip64=True) as file,
    ):
        file.write(npy_file(f"({numbers},)")[:-800])
        for _ in range(numbers // 1_000_000):
            file.write(bytes(8_000_000))


@pytest.fixture(autouse=True, scope="module")
def earlier_objects() -> None:
    """Exclude objects of earlier tests from the garbage collection after each import, which would take longer."""
    gc.collect()
    gc.freeze()


def rejection_message(path: Path, folder: Path) -> str:
    """Return the error message of an import; check that no recording is written and the file is unchanged."""
    before = path.read_bytes() if path.is_file() else b""
    with pytest.raises((RecordingError, SceneError)) as error:
        daq.import_files(path, make_scene(), folder / "r.mcap", table=TABLE)
    gc.collect()
    assert not (folder / "r.mcap").exists() and not list(folder.glob(".*.mcap"))
    assert (path.read_bytes() if path.is_file() else b"") == before
    return str(error.value)


BAD_FILES = {
    "missing.csv": None,
    "a folder.csv": "folder",
    "unknown.xyz": b"1,2,3\n",
    "no ending": b"1,2,3\n",
    **{f"empty{ending}": b"" for ending in EXTENSIONS if ending != ".mat"},
    **{f"noise{ending}": np.random.default_rng(1).bytes(4000) for ending in EXTENSIONS},
    **{f"text{ending}": b"to whom it may concern\n" * 9 for ending in EXTENSIONS if ending != ".mat"},
    "heading only.csv": b"time [s],a,b,c\n",
    "one line.csv": b"time [s],a,b,c\n" + CSV_LINE,
    "ragged.csv": b"time [s],a,b,c\n" + CSV_LINE + b"0.1,1,2\n0.2,1,2,3\n",
    "word in it.csv": b"time [s],a,b,c\n" + CSV_LINE + b"0.1,1,two,3\n0.2,1,2,3\n",
    "backwards.csv": b"time [s],a,b,c\n0.2,1,2,3\n0.1,1,2,3\n0.0,1,2,3\n",
    "constant time.csv": b"time [s],a,b,c\n" + 5 * CSV_LINE,
    "time in kg.csv": b"time [kg],a,b,c\n0,1,2,3\n1,1,2,3\n",
    "nan times.csv": b"time [s],a,b,c\nnan,1,2,3\nnan,1,2,3\n",
    "zeros inside.csv": b"time,a\n" + bytes(100),
    "two columns.csv": b"time [s],a,b\n0,1,2\n1,1,2\n2,1,2\n",
    "no rate.csv": b"a,b,c\n1,2,3\n2,3,4\n3,4,5\n",
    "riff.wav": b"RIFF\x10\0\0\0WAVE",
    "avi.wav": b"RIFF\x10\0\0\0AVI LIST" + bytes(30),
    "no format.wav": b"RIFF\x24\0\0\0WAVEdata\x04\0\0\0\0\0\0\0",
    "compressed.wav": WAV_HEAD + struct.pack("<HHIIHH", 17, 3, 8000, 4000, 3, 4) + WAV_DATA,
    "no tracks.wav": WAV_HEAD + struct.pack("<HHIIHH", 1, 0, 8000, 0, 0, 16) + WAV_DATA,
    "rate of zero.wav": WAV_HEAD + struct.pack("<HHIIHH", 1, 1, 0, 0, 2, 16) + WAV_DATA,
    "endless.npy": npy_file("(99999999999999999999999,)"),
    "no shape.npy": npy_file("(-5,)"),
    "open bracket.npy": npy_file("(100,)", "(" * 500),
    "long cell.csv": b"time [s],a,b,c\n" + b"x" * 200_000 + b"\n" + 50 * CSV_LINE,
    "hdf5.mat": b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + b" " * 86 + b"\0\2IM" + b"\x89HDF\r\n\x1a\n" + bytes(500),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_unusable_file_is_rejected_with_message(name, tmp_path):
    path = tmp_path / name
    if BAD_FILES[name] == "folder":
        path.mkdir()
    elif BAD_FILES[name] is not None:
        path.write_bytes(BAD_FILES[name])
    # A message is a sentence, not only a name or a number.
    assert len(rejection_message(path, tmp_path)) > 20


@pytest.mark.parametrize(
    ("form", "fraction"),
    # Each import of a MATLAB file starts a process.
    [(form, fraction) for form in WRITERS for fraction in ([0.5] if "mat" in form else [0.02, 0.5, 0.97])],
)
def test_truncated_file_is_rejected_or_partly_imported(form, fraction, tmp_path):
    ending, write_file, _ = WRITERS[form]
    rows = random_samples(600)
    write_file(tmp_path / f"whole{ending}", rows)
    data = (tmp_path / f"whole{ending}").read_bytes()
    path = tmp_path / f"truncated{ending}"
    path.write_bytes(data[: int(fraction * len(data))])
    try:
        daq.import_files(path, make_scene(), tmp_path / "r.mcap", table=TABLE)
    except (RecordingError, SceneError) as error:
        assert path.name in str(error) and not (tmp_path / "r.mcap").exists()
        return
    with daq.open(tmp_path / "r.mcap") as recording:
        count = recording.samples
        samples = recording.read("force")
        valid = np.isfinite(samples)
        # A line of text may end inside its last number, which is undetectable.
        np.testing.assert_allclose(samples[valid][:-1], rows[2, :count][valid][:-1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("form", WRITERS)
def test_wrong_bytes_give_message_or_samples(form, tmp_path):
    ending, write_file, _ = WRITERS[form]
    write_file(tmp_path / f"whole{ending}", random_samples(300))
    data = (tmp_path / f"whole{ending}").read_bytes()
    random = np.random.default_rng(len(form))
    for number in range(3 if "mat" in form else 8):
        damaged = bytearray(data)
        # Most of the metadata is at the beginning.
        header_end = len(damaged) if number % 2 else min(len(damaged), 600)
        for position in random.integers(0, header_end, 1 + number):
            damaged[position] = random.integers(256)
        path = tmp_path / f"wrong{ending}"
        path.write_bytes(damaged)
        try:
            daq.import_files(path, make_scene(), tmp_path / "r.mcap", table=TABLE, overwrite=True)
        except (RecordingError, SceneError):
            continue
        with daq.open(tmp_path / "r.mcap") as recording:
            recording.check()


def test_file_without_samples_lists_its_content(tmp_path):
    savemat(tmp_path / "a.mat", {"text": "hello", "few": np.arange(3.0), "fs": 100.0})
    assert "no array of samples; it contains text" in rejection_message(tmp_path / "a.mat", tmp_path)
    np.savez(tmp_path / "b.npz", a=np.zeros(50) + 1j)
    assert "no array of samples" in rejection_message(tmp_path / "b.npz", tmp_path)
    np.savez(tmp_path / "c.npz", a=np.zeros((50, 3)), fs=-1.0)
    assert "expected a sample rate" in rejection_message(tmp_path / "c.npz", tmp_path)
    np.savez(tmp_path / "d.npz", a=np.array([{"x": 1}], dtype=object))
    assert "d.npz" in rejection_message(tmp_path / "d.npz", tmp_path)


def test_missing_column_and_units_name_file_and_remedy(tmp_path):
    table = np.vstack([np.arange(100) / RATE, random_samples(100)]).T
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="time,body1,body2,force", comments="")
    with pytest.raises(SceneError) as error:
        daq.import_files(tmp_path / "a.csv", make_scene(), tmp_path / "r.mcap")
    body1, body2, force = str(error.value).splitlines()
    assert "'body1' in a.csv is not stated" in body1 and "unit: m/s^2" in body1 and "unit: m/s^2" in body2
    assert "'force' in a.csv is not stated" in force and "`unit: N`," in force and "m/s^2" not in force
    with pytest.raises(SceneError, match=r"body1: no column 'body1 \[g\]' in a\.csv; there are 1: body1, .*'body1'\?"):
        daq.import_files(tmp_path / "a.csv", make_scene(), tmp_path / "r.mcap", table={"body1": Column("body1 [g]")})


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"body1": {"colum": "body1"}}, r"table: body1: unknown key 'colum'; .*Did you mean 'column'\?"),
        ({"body1": {"unit": "g"}}, "table: body1: column missing"),
        ({"body1": None}, "table: body1: got None; expected a column or a mapping such as"),
        ({"bdy1": {"column": "body1"}}, "bdy1"),
        ([("body1", "ai0")], "table: got .*; expected a file or a mapping such as"),
    ],
)
def test_mistake_in_table_from_python_is_named(columns, message, tmp_path):
    np.savetxt(tmp_path / "a.csv", random_samples(100).T, delimiter=",", header="body1,body2,force", comments="")
    with pytest.raises(SceneError, match=message):
        daq.import_(tmp_path / "a.csv", make_scene(), tmp_path / "r.mcap", table=columns)


def test_listing_prints_nothing_before_an_error(tmp_path):
    np.savetxt(tmp_path / "a.csv", random_samples(100).T, delimiter=",")
    for unsuitable in ("missing.csv", "folder.csv"):
        (tmp_path / "folder.csv").mkdir(exist_ok=True)
        result = CliRunner().invoke(app, ["import", str(tmp_path / "a.csv"), str(tmp_path / unsuitable)])
        assert unsuitable in str(result.exception) and result.output == ""


def test_truncated_wav_is_rejected(tmp_path):
    wavfile.write(tmp_path / "a.wav", int(RATE), np.zeros((500, 3), np.int16))
    data = bytearray((tmp_path / "a.wav").read_bytes())
    data[40:44] = struct.pack("<I", 10**6)
    (tmp_path / "a.wav").write_bytes(data)
    assert "truncated" in rejection_message(tmp_path / "a.wav", tmp_path)


def test_uff_without_time_histories_names_the_command(tmp_path):
    write_uff(tmp_path / "a.uff", random_samples(50))
    text = (tmp_path / "a.uff").read_text(encoding="utf-8")
    (tmp_path / "b.uff").write_text(text.replace("    58", "    82"))
    assert "contains no data set 58" in rejection_message(tmp_path / "b.uff", tmp_path)
    lines = text.splitlines(keepends=True)
    type_lines = [number + 6 for number, line in enumerate(lines) if line.startswith("    58")]
    for number in type_lines:
        lines[number] = "    4" + lines[number][5:]
    (tmp_path / "c.uff").write_text("".join(lines))
    assert "to `analysis modes`" in rejection_message(tmp_path / "c.uff", tmp_path)


def test_own_recording_is_not_imported(tmp_path):
    path = write_recording(tmp_path / "a.mcap", random_volts(600))
    assert "is a recording already" in rejection_message(path, tmp_path)


def test_constant_and_implausible_channels_are_reported(tmp_path):
    rows = random_samples(600)
    rows[0], rows[2] = 3.0, 1e9 * rows[2]
    WRITERS["tdms"][1](tmp_path / "a.tdms", rows)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        daq.import_files(tmp_path / "a.tdms", make_scene(), tmp_path / "r.mcap")
    message = "\n".join(str(warning.message) for warning in caught)
    assert "body1 ('body1' of a.tdms) reads 29.4199 m/s^2 throughout" in message
    assert "force ('force' of a.tdms) reads up to" in message and "wrong unit or sensitivity" in message


def write_json_topic(
    path: Path, messages: list[bytes], schemas: int = 0, compression: CompressionType = CompressionType.ZSTD
) -> None:
    """Write all messages of one topic, and schemas of 100 kB, into one chunk of any unpacked size."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 40, compression=compression, repeat_schemas=False)
        writer.start()
        for number in range(schemas):
            writer.register_schema(f"{number}", "jsonschema", bytes(100_000))
        channel = writer.register_channel("/a", "json", 0)
        for time, data in enumerate(messages):
            writer.add_message(channel, 1_000_000 * time, data, 1_000_000 * time)
        writer.finish()


@pytest.mark.skipif(sys.platform != "linux", reason="not every system can limit a process")
@pytest.mark.parametrize("form", ["npz", "mat", "chunk", "message", "fields", "schemas", "uff", "csv"])
def test_file_that_exceeds_memory_is_rejected(form, tmp_path, monkeypatch):
    # The program itself takes 200 MB.
    monkeypatch.setenv("SHOTRIG_MEMORY", "202 MB" if form in ("csv", "npz", "schemas") else "200 MB")
    path = tmp_path / f"zeros.{form}"
    match form:
        case "npz":
            write_compressed_zeros(path, 1_000_000)
        case "mat":
            savemat(path, {"body1": np.zeros(14_000_000)}, do_compression=True)
        case "uff" | "csv":
            WRITERS["csv" if form == "csv" else "uff text"][1](path, random_samples(20_000))
        case _:
            path = path.with_suffix(".mcap")
            contents = {
                "chunk": [b'{"a": 1.0}' + 100_000_000 * b" "],
                "message": [b'{"a": [' + 10_000_000 * b"0.0," + b"0.0]}"],
                "fields": [json.dumps({f"{k}": 1.0 for k in range(100_000)}).encode()],
                "schemas": [b'{"a": 1.0}'],
            }
            write_json_topic(path, contents[form], schemas=10 * (form == "schemas"))
            assert path.stat().st_size < 200_000
    with pytest.raises(ShotrigError, match=rf"{path.name}.* 0\.2(02)? GB.*SHOTRIG_MEMORY"):
        daq.import_files(path, make_scene(), tmp_path / "r.mcap", table=TABLE)
    assert not (tmp_path / "r.mcap").exists()


def test_chunk_of_other_size_is_refused(tmp_path):
    write_json_topic(tmp_path / "a.mcap", [b'{"a": 1.0}', 9000 * b" " + b'{"a": 2.0}'], compression=CompressionType.LZ4)
    content = bytearray((tmp_path / "a.mcap").read_bytes())
    # The size of the unpacked chunk is followed by a checksum and by the name of the compression.
    struct.pack_into("<Q", content, content.index(b"lz4") - 16, 1000)
    (tmp_path / "a.mcap").write_bytes(content)
    assert "decompresses to a different size" in rejection_message(tmp_path / "a.mcap", tmp_path)


@pytest.mark.parametrize("ending", ["npz", "npy"])
def test_one_byte_numbers_take_little_memory(ending, tmp_path):
    numbers, path = np.zeros(3_000_000, np.int8), tmp_path / f"a.{ending}"
    if ending == "npz":
        np.savez(path, body1=numbers, fs=RATE)
    else:
        np.save(path, numbers)
    tracemalloc.start()
    try:
        with ExitStack() as stack:
            signals_of(path, stack)[0].read(0, 1000)
            peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # The file has 3 MB of samples; as doubles they would take 24 MB.
    assert peak < 8_000_000


def test_tdms_channel_with_incomplete_scaling_is_rejected(tmp_path):
    scales = {"NI_Number_Of_Scales": 2, "NI_Scale[1]_Scale_Type": "Linear", "wf_increment": 1e-3}
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as file:
        rows = random_samples(100).astype(np.int16)
        file.write_segment(
            [nptdms.ChannelObject("group", name, row, scales) for name, row in zip(NAMES, rows, strict=True)]
        )
    assert "cannot be read as a TDMS file" in rejection_message(tmp_path / "a.tdms", tmp_path)


def test_recursive_matlab_cells_are_rejected(tmp_path):
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        cell = file.create_dataset("a", (1, 100), h5py.ref_dtype)
        for index in range(100):
            cell[0, index] = cell.ref
    header = b"MATLAB 7.3 MAT-file, Platform: PCWIN64".ljust(124) + b"\0\2IM"
    data = (tmp_path / "a.mat").read_bytes()
    (tmp_path / "a.mat").write_bytes(header + data[len(header) :])
    assert "a.mat has more than 100000 values" in rejection_message(tmp_path / "a.mat", tmp_path)


def test_modules_in_current_folder_are_not_imported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    WRITERS["mat"][1](tmp_path / "a.mat", random_samples(600))
    for name in ("random", "struct", "scipy", "numpy"):
        (tmp_path / f"{name}.py").write_text("import sys\n\nsys.exit(3)\n")
    daq.import_files(tmp_path / "a.mat", make_scene(), tmp_path / "r.mcap", table=TABLE)
    with daq.open(tmp_path / "r.mcap") as recording:
        assert recording.samples == 600


def test_truncated_tdms_file_gives_one_warning(tmp_path, caplog):
    WRITERS["tdms"][1](tmp_path / "whole.tdms", random_samples(600))
    data = (tmp_path / "whole.tdms").read_bytes()
    (tmp_path / "truncated.tdms").write_bytes(data[: len(data) - 1000])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", RunWarning)
        daq.import_files(tmp_path / "truncated.tdms", make_scene(), tmp_path / "r.mcap")
    assert [
        str(warning.message) for warning in caught if "truncated.tdms is truncated or damaged" in str(warning.message)
    ]
    assert not caplog.records
