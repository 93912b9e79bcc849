"""Import of foreign files: samples, rate, units, clock, overloads, gaps, channel tables and `daq import`."""

import errno
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import pyuff
from scipy.io import wavfile
from typer.testing import CliRunner

import daq
import rig
from daq.commands.cli import app
from daq.extras.importing import text_table
from daq.extras.importing.channel_table import Column
from daq.extras.importing.files import signals_of
from daq.extras.importing.text_table import text_signals
from daq.extras.importing.units import quantity_and_scale
from rig.core.base.errors import RecordingError, RunWarning, SceneError, ShotrigError
from tests.daq.importing.files import (
    NAMES,
    RATE,
    SI_PER_UNIT,
    UNITS,
    WRITERS,
    make_scene,
    random_samples,
    write_csv,
    write_tdms,
)

# pyuff leaves a binary file open that it wrote.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
# A WAV file contains no channel names, and its samples are relative to full scale.
WAV_TABLE = {
    name: Column(str(number), unit=unit)
    for number, (name, unit) in enumerate(zip(NAMES, ("78.4532 m/s^2", "8 m/s^2", "8 N"), strict=True), 1)
}


@pytest.mark.parametrize("form", WRITERS)
def test_foreign_file_gives_its_samples_and_rate(form, tmp_path, imported):
    ending, write, error = WRITERS[form]
    rows = random_samples()
    write(tmp_path / f"a{ending}", rows)
    table = WAV_TABLE if form in ("wav", "w64", "flac") else None
    recording, messages = imported(tmp_path / f"a{ending}", table=table)
    assert recording.rate == RATE and not messages
    samples = np.array([recording.read(name) for name in NAMES])
    expected = rows * SI_PER_UNIT
    np.testing.assert_allclose(samples, expected, rtol=0, atol=max(error, 1e-15) * abs(expected).max())
    assert [marker.kind for marker in recording.markers] == ["measure"]
    # The source shows that drive and converter are not those of the virtual rig.
    assert recording.source == f"a{ending}"
    assert recording.markers[0].fields == {"from": 5.0, "to": 400.0}
    assert recording.scene.channels == make_scene().channels and recording.scene.converter.rate == RATE


@pytest.mark.parametrize("kind", [np.uint8, np.int16, "int24", np.int32, np.float32, np.float64])
def test_wav_full_scale_is_the_converter_range(kind, tmp_path, imported):
    rows = np.random.default_rng(3).uniform(-0.9, 0.9, (2, 3000))
    path = tmp_path / "a.wav"
    if kind == "int24":
        _write_24_bits(path, rows)
    elif np.dtype(kind).kind == "f":
        wavfile.write(path, 2048, rows.T.astype(kind))
    else:
        full_scale = 2.0 ** (8 * np.dtype(kind).itemsize - 1)
        wavfile.write(path, 2048, np.rint(rows.T * full_scale + (128 if kind is np.uint8 else 0)).astype(kind))
    scene = make_scene(converter="converter: {range: 5 V}")
    table = {"body1": Column("1", sensitivity="100 mV/g"), "body2": Column("2", unit="2 V", sign=-1)}
    if np.dtype(kind if kind != "int24" else "i4").kind == "f":
        table["body1"] = Column("1", unit="5 V", sensitivity="100 mV/g")
    recording, _ = imported(path, scene, table=table)
    # One count of 8 or 16 bits, as a ratio to full scale; 2^-22 for the finer formats.
    tolerance = 2.0 ** (-7 if kind is np.uint8 else -15 if kind is np.int16 else -22)
    # Sensitivity of 100 mV/g in the table, 10 mV/g in the scene.
    volts1, volts2 = recording.read("body1") * 0.1 / 9.80665, recording.read("body2") * 0.01 / 9.80665
    assert np.abs(volts1 / 5.0 - rows[0]).max() <= tolerance
    assert np.abs(volts2 / -2.0 - rows[1]).max() <= tolerance


def _write_24_bits(path, rows):
    """Write the format WAVE_FORMAT_EXTENSIBLE with three bytes a sample, as measurement cards do."""
    integers = np.ascontiguousarray(np.rint(rows.T * 2**23).astype("<i4"))
    data = integers.view(np.uint8).reshape(*integers.shape, 4)[..., :3].tobytes()
    guid = bytes.fromhex("0100000000001000800000aa00389b71")
    format_fields = np.array([0xFFFE, 2], "<u2").tobytes() + np.array([2048, 2048 * 6], "<u4").tobytes()
    format_fields += np.array([6, 24, 22, 24], "<u2").tobytes() + np.array([3], "<u4").tobytes() + guid
    chunk = b"fmt " + np.array([len(format_fields)], "<u4").tobytes() + format_fields
    chunk += b"LIST" + np.array([3], "<u4").tobytes() + b"odd\0"
    chunk += b"data" + np.array([len(data)], "<u4").tobytes() + data
    path.write_bytes(b"RIFF" + np.array([4 + len(chunk)], "<u4").tobytes() + b"WAVE" + chunk)


def test_unmarked_hits_are_detected(tmp_path, imported):
    rows = 1e-3 * random_samples(12000)
    pulse = np.sin(np.pi * np.arange(1, 9) / 9)
    # The pulse at 1060 is a bounce: it follows the hit at 1000 after less than 0.2 s.
    for index, amplitude in ((1000, 80.0), (1060, 20.0), (5000, 50.0), (9000, 30.0)):
        rows[2, index : index + 8] -= amplitude * pulse
    write_csv(tmp_path / "a.csv", rows)
    scene = make_scene("{kind: impulse, body: 2, peak: 50 N, width: 4 ms}")
    recording, messages = imported(tmp_path / "a.csv", scene)
    hits = [marker for marker in recording.markers if marker.kind == "hit"]
    assert [round(hit.first_sample, -2) for hit in hits] == [1000, 5000, 9000]
    assert all(
        hit.first_sample < index and hit.end >= index + 7 for hit, index in zip(hits, (1000, 5000, 9000), strict=True)
    )
    assert [hit.fields["double"] for hit in hits] == [True, False, False]
    assert messages == ["impact 1: double (a second pulse of the force follows)"]


@pytest.mark.parametrize(
    ("repeats", "expected"),
    [
        ("", "2 impacts detected in the force, with peaks of 80 to 80 N"),
        ("repeats: 2", "2 impacts detected in the force, with peaks"),
        ("repeats: 5", "2 of 5 impacts detected in the force (test.repeats is 5), with peaks"),
        ("repeats: 1", "2 impacts detected in the force (test.repeats is 1), with peaks"),
    ],
)
def test_detected_hits_are_compared_with_test_repeats(repeats, expected, tmp_path):
    rows = np.zeros((3, 8000))
    rows[2, 1000:1008] = rows[2, 5000:5008] = 80.0
    write_csv(tmp_path / "a.csv", rows)
    scene = make_scene(f"{{kind: impulse, body: 2, peak: 50 N, width: 4 ms, {repeats}}}")
    (tmp_path / "bench.yaml").write_text(scene.to_yaml())
    result = CliRunner().invoke(app, ["import", str(tmp_path / "a.csv"), "--scene", str(tmp_path / "bench.yaml")])
    assert expected in result.output, result.output


def test_hits_without_motion_channel_suggest_no_analysis(tmp_path, imported):
    rows = 1e-3 * random_samples(4000)
    rows[2, 1000:1008] += 80.0
    write_csv(tmp_path / "a.csv", rows)
    scene = make_scene("{kind: impulse, body: 2, peak: 50 N, width: 4 ms}")
    force_alone = scene.replace(channels=scene.channels[2:])
    for bench, commands in ((scene, ["decay", "frf", "modes"]), (force_alone, [])):
        path = imported(tmp_path / "a.csv", bench)[0].path
        analyses = [f"analysis {command} {path}" for command in commands]
        assert daq.info(path).next_steps == (*analyses, f"daq replay {path}")


def test_clipped_and_lost_samples_are_marked(tmp_path, imported):
    rows = 20.0 * np.sin(0.05 * np.arange(4000)) + np.zeros((3, 1))
    rows += 0.1 * random_samples(4000)
    rows[1] = np.clip(rows[1], -15.0, 15.0)
    rows[0, 700:720] = np.nan
    write_csv(tmp_path / "a.csv", rows)
    recording, messages = imported(tmp_path / "a.csv")
    clipped = np.zeros(4000, bool)
    for marker in recording.overloads:
        assert marker.fields["channel"] == "body2"
        clipped[marker.first_sample : marker.stop] = True
    clipped_samples = np.flatnonzero(abs(rows[1]) == 15.0)
    assert clipped[clipped_samples].mean() > 0.95 and clipped.sum() < 1.2 * clipped_samples.size
    (gap,) = recording.gaps
    assert (gap.first_sample, gap.last_sample, gap.channels) == (700, 719, ("body1",))
    assert np.array_equal(np.isnan(recording.read("body1")), np.isnan(rows[0]))
    assert any("clipped" in note for note in messages) and any("lost" in note for note in messages)


def test_equal_peaks_of_coarse_samples_are_not_overloads(tmp_path, imported):
    rows = np.round(40.0 * np.sin(0.003 * np.arange(20000))) + np.zeros((3, 1))
    write_csv(tmp_path / "a.csv", rows)
    recording, _ = imported(tmp_path / "a.csv")
    assert not recording.overloads


def test_file_of_several_blocks_is_imported_completely(tmp_path, imported):
    rows = random_samples(200_000)
    write_tdms(tmp_path / "a.tdms", rows)
    recording, _ = imported(tmp_path / "a.tdms")
    np.testing.assert_allclose(recording.read("force"), rows[2], rtol=1e-15)


def test_fields_of_structured_array_are_signals(tmp_path):
    time, force = np.arange(100) / 1024.0, np.arange(100.0)
    np.save(tmp_path / "run.npy", np.rec.fromarrays([time, force], names="time,force"))
    with ExitStack() as stack:
        (signal,) = signals_of(tmp_path / "run.npy", stack)
        assert (signal.name, signal.rate) == ("force", 1024.0)
        np.testing.assert_array_equal(signal.read(0, 100), force)


def test_two_files_become_one_recording(tmp_path, imported):
    rows = random_samples()
    write_tdms(tmp_path / "a.tdms", rows)
    write_csv(tmp_path / "b.csv", rows[:, :4000])
    table = {"body1": Column("body1"), "force": Column("force", file="b.csv")}
    with pytest.raises(SceneError, match=r"several signals are called 'body1': a.tdms .* b.csv"):
        imported([tmp_path / "a.tdms", tmp_path / "b.csv"], table=table)
    table["body1"] = Column("body1", file="a")
    table["body2"] = Column("body2", file="a")
    recording, messages = imported([tmp_path / "a.tdms", tmp_path / "b.csv"], table=table)
    assert recording.samples == 5000 and recording.gaps[0].first_sample == 4000
    assert any("force (4000)" in note for note in messages)


@pytest.mark.parametrize("form", ["csv", "tdms"])
def test_late_release_is_reported_and_can_be_cut(form, tmp_path, imported):
    time = np.arange(6000) / RATE - 1.5
    rows = np.where(time < 0, 0.0, np.exp(-time) * np.cos(60.0 * time)) + 1e-4 * random_samples(6000)
    ending, write, _ = WRITERS[form]
    write(tmp_path / f"a{ending}", rows)
    scene = make_scene().replace(
        test={"kind": "free", "mode": 1, "amplitude": 1e-3}, shaker=None, channels=make_scene().channels[:2]
    )
    _, messages = imported(tmp_path / f"a{ending}", scene)
    assert any("moves most at 1.5 s" in note for note in messages)
    recording, messages = imported(tmp_path / f"a{ending}", scene, from_s=1.5, to_s=2.5)
    assert recording.samples == 2048 and not any("moves most" in note for note in messages)
    np.testing.assert_allclose(recording.read("body2"), rows[1, 3072:5120], rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("spacing", [0, 1])
def test_universal_file_may_have_times_in_milliseconds(spacing, tmp_path, imported):
    file, row = pyuff.UFF(str(tmp_path / "a.uff")), random_samples(600)[0]
    file.write_sets(
        {
            "type": 58, "binary": 0, "func_type": 1, "id1": "body1", "rsp_node": 1, "rsp_dir": 3, "ref_node": 0,
            "ref_dir": 0, "abscissa_spacing": spacing, "abscissa_spec_data_type": 17, "abscissa_axis_units_lab": "ms",
            "ordinate_spec_data_type": 12, "ordinate_axis_units_lab": "g", "orddenom_spec_data_type": 0, "data": row,
            "x": 1e3 * np.arange(row.size) / RATE,
        },
    )  # fmt: skip
    recording, _ = imported(tmp_path / "a.uff")
    assert recording.rate == RATE


def test_range_applies_to_voltages_with_their_offset(tmp_path, imported):
    rows = 3.0 + 0.3 * random_samples(2000)
    # Single samples at either end of the range of 5 V.
    rows[0, 300], rows[0, 1500] = -5.0, 5.0
    write_csv(tmp_path / "a.csv", rows)
    table = {"body1": Column("body1", unit="V", offset=3.0)}
    scene = make_scene(converter="converter: {range: 5 V}")
    recording, messages = imported(tmp_path / "a.csv", scene, table=table)
    overloads = [(marker.first_sample, marker.stop, marker.fields) for marker in recording.overloads]
    assert overloads == [(k, k + 1, {"channel": "body1"}) for k in (300, 1500)]
    assert not any("above the converter's range" in note for note in messages)


def test_reversed_times_are_rejected(tmp_path):
    write_csv(tmp_path / "a.csv", random_samples(600))
    with pytest.raises(SceneError, match=r"`from_s` 0\.2 s is after `to_s` 0\.1 s"):
        daq.import_files(tmp_path / "a.csv", make_scene(), tmp_path / "r.mcap", from_s=0.2, to_s=0.1)


def test_yaml_and_csv_tables_agree(tmp_path, imported):
    write_csv(tmp_path / "a.csv", random_samples(600))
    (tmp_path / "t.yaml").write_text(
        "body1: 2\nbody2: {column: body1, unit: 2 m/s^2, sign: -1, offset: 0.5, delay: 1 ms}\n"
    )
    (tmp_path / "t.csv").write_text("channel,column,unit,sign,offset,delay\nbody1,2\nbody2,body1,2 m/s^2,-1,0.5,1 ms\n")
    samples = []
    for name in ("t.yaml", "t.csv"):
        recording, _ = imported(tmp_path / "a.csv", table=tmp_path / name)
        assert recording.channels["body2"].delay == 1e-3
        samples.append([recording.read(channel) for channel in NAMES])
    np.testing.assert_array_equal(*samples)
    np.testing.assert_allclose(samples[0][1], -2.0 * (random_samples(600)[0] - 0.5), rtol=0, atol=1e-7)


LABVIEW_HEAD = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\t{name}\nDecimal_Separator\t{point}\n"
    "X_Columns\t{columns}\n***End_of_Header***\t\n"
)
END_OF_HEADER = "***End_of_Header***\t\n"


@pytest.mark.parametrize("columns", ["No", "One", "Multi"])
@pytest.mark.parametrize(("separator", "point"), [("\t", "."), ("\t", ","), (",", ".")])
def test_labview_text_has_names_units_and_clock(columns, separator, point, tmp_path, imported):
    rows = random_samples(400)
    name = "Tab" if separator == "\t" else "Comma"

    def line(cells):
        return separator.join(cells) + "\n"

    def number(value):
        return f"{value:.6f}".replace(".", point)

    def with_time_cells(cells):
        """Return the cells of the channels, with an empty time cell after each if every channel has its own times."""
        return [cell_or_time for cell in cells for cell_or_time in (cell, "")] if columns == "Multi" else list(cells)

    heading = LABVIEW_HEAD.format(name=name, point=point, columns=columns).replace("\t", separator)
    heading += line(["Channels", "3"])
    interval = f"{1 / RATE:.6E}".replace(".", point)
    for key, *cells in (
        ("Samples", "400", "400", "400"),
        ("Y_Unit_Label", "m/s^2", "g", "Newtons"),
        ("X0", *[number(0.0)] * 3),
        ("Delta_X", *[interval] * 3),
    ):
        heading += line([key, *with_time_cells(cells)])
    has_time_columns = columns == "Multi"
    heading += END_OF_HEADER
    heading += line(
        ["X_Value", *(["body1", "X_Value", "body2", "X_Value", "force"] if has_time_columns else NAMES), "Comment"]
    )
    lines = []
    for k, row in enumerate(rows.T):
        time = "" if columns == "No" else number(k / RATE)
        cells = (
            [cell_or_time for value in row for cell_or_time in (time, number(value))]
            if has_time_columns
            else [time, *map(number, row)]
        )
        lines.append(line([*cells, "lost contact"] if k % 7 == 0 else cells))
    (tmp_path / "a.lvm").write_text(heading + "".join(lines))
    recording, messages = imported(tmp_path / "a.lvm")
    assert recording.rate == RATE and not messages
    np.testing.assert_allclose(recording.read("force"), rows[2], rtol=0, atol=1e-6)
    np.testing.assert_allclose(recording.read("body2"), 9.80665 * rows[1], rtol=0, atol=1e-5)


@pytest.mark.parametrize("form", ["text", "array"])
def test_unnamed_evenly_rising_column_is_time(form, tmp_path, imported):
    rows = np.vstack([np.arange(400) / RATE - 0.01, random_samples(400)])
    if form == "text":
        np.savetxt(tmp_path / "a.txt", rows.T, fmt="%.9e")
    else:
        np.savez(tmp_path / "a.npz", measured=rows.T)
    file = next(tmp_path.glob("a.*"))
    table = {name: Column(str(k), unit="m/s^2" if name != "force" else "N") for k, name in enumerate(NAMES, 1)}
    recording, messages = imported(file, table=table)
    assert recording.rate == RATE
    np.testing.assert_allclose(recording.read("body1"), rows[1], rtol=1e-6)
    assert any("rises evenly" in text and "is used as times" in text for text in messages)


@pytest.mark.parametrize("index", ["table.axis1", "table.index"])
def test_index_used_as_times_is_reported(index, tmp_path):
    np.savez(tmp_path / "a.npz", **{index: 0.5 * np.arange(400), "table.block0_values": random_samples(400).T})
    with ExitStack() as stack, pytest.warns(RunWarning, match=f"'{index}' rises evenly, by 0.5, and is used as times"):
        assert {signal.rate for signal in signals_of(tmp_path / "a.npz", stack)} == {2.0}


@pytest.mark.parametrize(
    ("clock", "milliseconds"), [("10:00:{:06.3f}", 3000), ("10:00:{:06.3f}", 1000), ("10:00:{:02.0f}", 3000)]
)
@pytest.mark.filterwarnings("ignore:.*its column 'ms' is not imported")
def test_elapsed_milliseconds_are_not_added_twice(clock, milliseconds, tmp_path):
    digits = 1000 if "02" in clock else 1
    rows = "".join(f"{clock.format(k // digits * digits / 1000)},{k % milliseconds},{k % 7}\n" for k in range(3000))
    (tmp_path / "a.csv").write_text("Time,ms,tip [g]\n" + rows)
    with ExitStack() as stack:
        (signal,) = signals_of(tmp_path / "a.csv", stack)
        assert (signal.name, signal.rate, signal.samples) == ("tip", 1000.0, 3000)


@pytest.mark.filterwarnings("ignore:.*the sample rate of its heading")
@pytest.mark.parametrize("heading", ["N,g", "Point,Base"])
def test_signal_named_like_line_number_is_imported(heading, tmp_path):
    rows = "".join(f"{k % 7},{k % 5}\n" for k in range(300))
    (tmp_path / "a.csv").write_text(f"Sample rate: 1000 Hz\n{heading}\n{rows}")
    with ExitStack() as stack:
        assert [signal.name for signal in signals_of(tmp_path / "a.csv", stack)] == heading.split(",")


def test_full_temporary_folder_is_named(tmp_path, monkeypatch):
    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(text_table, "TemporaryFile", fail)
    (tmp_path / "a.csv").write_text("t [s],a [g]\n0.0,1\n0.1,2\n")
    with ExitStack() as stack, pytest.raises(RecordingError, match=r"temporary file: No space left .* TMPDIR"):
        signals_of(tmp_path / "a.csv", stack)


def test_column_of_line_numbers_is_not_time(tmp_path, imported):
    np.savetxt(tmp_path / "a.txt", np.vstack([np.arange(1, 401), random_samples(400)]).T)
    table = {"body1": Column("2", unit="m/s^2")}
    with pytest.raises(SceneError, match="sample rate is not stated"):
        imported(tmp_path / "a.txt", table=table)


def test_uneven_times_are_reported(tmp_path, imported):
    rows = random_samples(400)
    jitter = np.random.default_rng(2).uniform(-0.2, 0.2, 400)
    for name, times in {"even": np.arange(400.0), "uneven": np.arange(400) + jitter}.items():
        np.savez(tmp_path / f"{name}.npz", time=times / RATE, body1=rows[0])
        table = {"body1": Column("body1", unit="g")}
        _, messages = imported(tmp_path / f"{name}.npz", table=table)
        assert any("from even spacing by up to" in text for text in messages) == (name == "uneven")


def test_missing_value_in_first_line_keeps_its_column(tmp_path, imported):
    lines = [f"{k / RATE:.9g},{k % 7},{'' if k == 0 else k % 5}" for k in range(400)]
    (tmp_path / "a.csv").write_text("\n".join(["time [s],body1 [g],body2 [g]", *lines]))
    recording, _ = imported(tmp_path / "a.csv")
    assert np.isnan(recording.read("body2")[0])
    np.testing.assert_allclose(recording.read("body2")[1:], 9.80665 * (np.arange(1, 400) % 5), rtol=1e-12)


@pytest.mark.parametrize("name", ["Fs", "sampling_frequency", "samplerate", "sr", "f_s", "sampling_rate_Hz"])
def test_sample_rate_is_known_by_any_name(name, tmp_path, imported):
    np.savez(tmp_path / "a.npz", **{name: RATE}, body1=random_samples(400)[0])
    recording, _ = imported(tmp_path / "a.npz", table={"body1": Column("body1", unit="g")})
    assert recording.rate == RATE


def labview_segments(starts, name="body1"):
    """Return a LabVIEW file with segments of three samples at 1 kHz."""
    heading = LABVIEW_HEAD.format(name="Tab", point=".", columns="No")
    segments = (
        f"Channels\t1\nY_Unit_Label\tg\nX0\t{start}\nDelta_X\t1.000000E-3\n{END_OF_HEADER}X_Value\t{name}\tComment\n"
        f"\t{number}.1\n\t{number}.2\n\t{number}.3\n\n"
        for number, start in enumerate(starts, 1)
    )
    return heading + "".join(segments)


def test_labview_channels_have_their_own_rates(tmp_path):
    heading = LABVIEW_HEAD.format(name="Tab", point=".", columns="One")
    heading += "Channels\t3\nSamples\t4\t4\t2\nDelta_X\t1.0E-3\t1.0E-3\t1.0\n" + END_OF_HEADER
    rows = "0.000\t0.5\t1.5\t2.5\n0.001\t0.6\t1.6\t2.6\n0.002\t0.7\t1.7\t\n0.003\t0.8\t1.8\t\n"
    (tmp_path / "a.lvm").write_text(f"{heading}X_Value\tbody1\tbody2\tlevel\n{rows}")
    with ExitStack() as stack:
        signals = text_signals(tmp_path / "a.lvm", stack)
        assert [(signal.samples, signal.rate) for signal in signals] == [(4, 1000.0), (4, 1000.0), (2, 1.0)]


def test_labview_segments_are_joined(tmp_path):
    (tmp_path / "a.lvm").write_text(labview_segments([0.0, 0.003, 5.0]))
    with ExitStack() as stack, pytest.warns(RunWarning, match="3 segments are joined; samples are lost between 1"):
        [signal] = text_signals(tmp_path / "a.lvm", stack)
        samples = signal.read(0, signal.samples)
    np.testing.assert_array_equal(samples[np.isfinite(samples)], [1.1, 1.2, 1.3, 2.1, 2.2, 2.3, 3.1, 3.2, 3.3])
    assert np.isnan(samples[6:-3]).all()


@pytest.mark.parametrize("heading_lines", [1, 5, 6])
def test_labview_segment_without_samples_is_omitted(heading_lines, tmp_path):
    text = labview_segments([0.0, 5.0, 9.0]).splitlines(keepends=True)
    (tmp_path / "a.lvm").write_text("".join(text[: len(text) - 10 + heading_lines]))
    with ExitStack() as stack, pytest.warns(RunWarning) as caught:
        [signal] = text_signals(tmp_path / "a.lvm", stack)
        assert signal.samples == 6 + 16
    assert any("1 of its 3 segments contain no samples" in str(each.message) for each in caught)


def test_different_labview_segments_are_refused(tmp_path):
    text = labview_segments([0.0]) + labview_segments([0.0], "body2").split(END_OF_HEADER, 1)[1].lstrip()
    (tmp_path / "a.lvm").write_text(text)
    with ExitStack() as stack, pytest.raises(RecordingError, match="channels of its segments differ"):
        text_signals(tmp_path / "a.lvm", stack)


def test_uncertain_labview_clock_is_reported(tmp_path, imported):
    heading = LABVIEW_HEAD.format(name="Tab", point=".", columns="No")
    heading += (
        "Channels\t1\nSamples\t9\nY_Unit_Label\tg\nX0\t0\nDelta_X\t0.000977\n" + END_OF_HEADER + "X_Value\tbody1\n"
    )
    (tmp_path / "a.lvm").write_text(heading + "".join(f"\t{value}\n" for value in (0.1, -0.1, 0.2)))
    _, messages = imported(tmp_path / "a.lvm")
    assert any("9 samples, but the table has only 3" in text for text in messages)
    assert any("1023.02 to 1024.07 Hz" in text for text in messages)


# Text of a wrong table: pattern of its error message.
WRONG_TABLES = {
    "channels: [body1": r"no closing \]",
    "- body1": "expected a line for each channel",
    "": "names no channel",
    "body1: {columns: 1}": r"unknown key 'columns'.*'column'\?",
    "body1: {unit: g}": "column missing",
    "body1: {column: 1, sign: up}": "expected 1 or -1",
    "body1: {column: 1, offset: little}": "expected a number",
    "body1: {column: 1, delay: 2 kg}": "expected a time",
    "body1: {column: 1, rate: -3}": "expected a sample rate",
    "body1: {column: 1, unit: furlong}": "unknown unit 'furlong'",
    "body1: {column: 1, sensitivity: 100 mV/g}": "only for a signal in volts",
    "body1: {column: 1, unit: V, sensitivity: 1 kg}": "not a unit of voltage per acceleration",
    "body1: {column: 3}\nforce: {column: 1}": "Assign another column, or correct unit",
    "body1: {column: 7}": "no column '7' in a.csv; there are 1: body1",
    "body1: {column: 1, file: z.csv}": "file: 'z.csv' is not imported; the imported files are a.csv",
    "bodi1: {column: 1}": r"not a channel of the scene.*'body1'\?",
    "body1: 1\nbody2: 1": "the same signal",
    "body1: {column: 1, rate: 10}\nbody2: {column: 2, rate: 20}": "several rates",
}


@pytest.mark.parametrize("text", WRONG_TABLES)
def test_wrong_table_is_rejected_with_message(text, tmp_path, imported):
    write_csv(tmp_path / "a.csv", random_samples(100))
    (tmp_path / "t.yaml").write_text(text)
    with pytest.raises(SceneError, match=WRONG_TABLES[text]):
        imported(tmp_path / "a.csv", table=tmp_path / "t.yaml")
    assert not (tmp_path / "r.mcap").exists()


def test_contradicting_rates_name_the_remedy(tmp_path, imported):
    write_csv(tmp_path / "a.csv", random_samples(100))
    with pytest.raises(
        SceneError,
        match=r"files state 2048 Hz.*5120 Hz\. If the files are right, set converter\.rate of the scene to 2048 Hz",
    ):
        imported(tmp_path / "a.csv", make_scene(converter="converter: {rate: 5120 Hz}"))
    table = {name: Column(name, rate=5120.0) for name in NAMES}
    recording, _ = imported(tmp_path / "a.csv", make_scene(converter="converter: {rate: 5120 Hz}"), table=table)
    assert recording.rate == 5120.0


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6)])
def test_unstated_unit_of_times_is_named(unit, factor, tmp_path, imported):
    times = factor * np.arange(100) / RATE
    table = np.vstack([times, random_samples(100)]).T
    scene = make_scene(converter="converter: {rate: 2048 Hz}")
    heading = ",".join(["time", *(f"{name} [{of}]" for name, of in zip(NAMES, UNITS, strict=True))])
    np.savetxt(tmp_path / "a.csv", table, "%.12g", ",", header=heading, comments="")
    with pytest.raises(SceneError, match=r"If the first column is in ([mu]s), name it `time \[\1\]`") as error:
        imported(tmp_path / "a.csv", scene)
    assert f"[{unit}]" in str(error.value) and "converter.rate=" not in str(error.value)
    corrected = heading.replace("time", f"time [{unit}]")
    np.savetxt(tmp_path / "a.csv", table, "%.12g", ",", header=corrected, comments="")
    recording, _ = imported(tmp_path / "a.csv", scene)
    assert recording.rate == RATE


@pytest.mark.parametrize(("heading", "factor"), [("time [ms]", 1.0), ("time [s]", 1e3), ("time [s]", 1.0)])
def test_implausible_unit_of_times_is_reported(heading, factor, tmp_path, imported):
    times = factor * np.arange(4000) / RATE
    names = (f"{name} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True))
    table = np.vstack([times, random_samples(4000)]).T
    np.savetxt(tmp_path / "a.csv", table, "%.12g", ",", header=",".join([heading, *names]), comments="")
    _, notes = imported(tmp_path / "a.csv", make_scene().replace(test=None))
    is_right = heading == "time [s]" and factor == 1.0
    assert any("Check the unit of the times" in note for note in notes) is not is_right


def test_import_command_lists_signals_without_overwriting(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_csv(tmp_path / "a.csv", random_samples(3000))
    (tmp_path / "bench.yaml").write_text(make_scene().to_si_yaml().replace("rate: 5120.0 Hz", "rate: 2048 Hz"))
    signal_list = CliRunner().invoke(app, ["import", "a.csv"])
    assert 'signal1: {column: "body1", unit: "g"}  # 3000 samples at 2048 Hz' in signal_list.output
    arguments = ["import", "a.csv", "--scene", "bench.yaml"]
    completed = CliRunner().invoke(app, arguments)
    assert completed.exit_code == 0 and "3000 samples of 3 channels" in completed.output, completed.output
    assert CliRunner().invoke(app, [*arguments, "-o", "new/folder/a.mcap"]).exit_code == 0
    content = Path("a.mcap").read_bytes()
    repeated = CliRunner().invoke(app, [*arguments, "--to", "1"])
    assert isinstance(repeated.exception, ShotrigError) and "exists" in str(repeated.exception)
    assert Path("a.mcap").read_bytes() == content
    Path("user.mcap").write_bytes(b"mine")
    rejected = CliRunner().invoke(app, [*arguments, "-o", "user.mcap"])
    assert isinstance(rejected.exception, RecordingError) and "exists" in str(rejected.exception)
    # Missing data is reported first.
    no_scene = CliRunner().invoke(app, ["import", "a.csv", "--scene", "nope.yaml"])
    assert "nope.yaml" in str(no_scene.exception) and "exists" not in str(no_scene.exception)
    no_file = CliRunner().invoke(app, ["import", "b.csv", "--scene", "bench.yaml", "-o", "a.mcap"])
    assert "b.csv: no such file" in str(no_file.exception)


def test_unit_that_contradicts_file_is_reported(tmp_path, imported):
    write_csv(tmp_path / "a.csv", random_samples(3000))
    # 1 / 9.80665 = 0.102; the file is in g.
    for unit, expected_message in (("m/s^2", "0.102 times"), ("mm", "displacement instead of acceleration"), ("g", "")):
        scene = make_scene()
        if unit == "mm":
            body1, *others = scene.channels
            scene = scene.replace(channels=[body1.replace(accelerometer=None), *others])
        table = {"body1": Column("body1", unit=unit)}
        _, messages = imported(tmp_path / "a.csv", scene, table=table)
        assert any(expected_message in message for message in messages) if expected_message else not messages


@pytest.mark.parametrize(
    ("unit", "expected"),
    [("MV", ("voltage", 1e6)), ("mV", ("voltage", 1e-3)), ("mv", ("voltage", 1e-3)), ("GN", ("force", 1e9)),
     ("gn", ("acceleration", 9.80665)), ("MN", ("force", 1e6)), ("mN", ("force", 1e-3)), ("Mm", ("displacement", 1e6)),
     ("mm", ("displacement", 1e-3)), ("Volts", ("voltage", 1.0)), ("Meters/Second^2", ("acceleration", 1.0))],
)  # fmt: skip
def test_case_of_unit_prefix_counts(unit, expected):
    assert quantity_and_scale(unit) == expected


def test_duplicate_file_is_rejected(tmp_path):
    write_csv(tmp_path / "a.csv", random_samples(3000))
    (tmp_path / "b.csv").write_bytes((tmp_path / "a.csv").read_bytes())
    with pytest.raises(RecordingError, match=r"b\.csv: the same content as .*a\.csv"):
        daq.import_files([tmp_path / "a.csv", tmp_path / "b.csv"], make_scene(), tmp_path / "r.mcap")


HIT_TEST = {"kind": "impulse", "body": 1, "peak": "100 N", "width": "4 ms"}


def write_hit(path: Path, peak: float, rate: float = 2048.0) -> None:
    times = np.arange(2048) / rate
    force = peak * np.exp(-0.5 * ((times - 0.1) / 1e-3) ** 2)
    decay = np.where(times > 0.1, np.exp(-20.0 * (times - 0.1)) * np.sin(300.0 * (times - 0.1)), 0.0)
    np.savetxt(
        path,
        np.column_stack([times, force, decay]),
        delimiter=",",
        header="time [s],hit [N],body1 [m/s^2]",
        comments="",
    )


def hammer_scene() -> rig.Scene:
    channels = [{"name": "hit", "at": "hammer"}, {"name": "body1", "at": "body 1"}]
    return rig.load("bare-structure", {"test": HIT_TEST, "channels": channels, "converter": None})


def test_files_of_one_hit_are_joined(tmp_path, imported):
    files = [tmp_path / f"hit{number}.csv" for number in (1, 2)]
    for file, peak in zip(files, (80.0, 100.0), strict=True):
        write_hit(file, peak)
    recording, notes = imported(files, hammer_scene())
    hits = [marker for marker in recording.markers if marker.kind == "hit"]
    assert [round(hit.fields["peak"]) for hit in hits] == [80, 100]
    assert {marker.first_sample for marker in recording.markers if marker.kind == "lost"} == {2048}
    assert any("2 files with the same signals are joined as impacts of one test" in note for note in notes)
    assert not any("no number" in note for note in notes)


def test_misspelled_force_of_hammer_is_an_error(tmp_path, imported):
    write_hit(tmp_path / "a.csv", 80.0)
    text = (tmp_path / "a.csv").read_text()
    (tmp_path / "a.csv").write_text(text.replace("hit [N]", "hti [N]"))
    with pytest.raises(SceneError, match=r"no channel measures a force(.|\n)*hit \(Did you mean 'hti'\?\)"):
        imported(tmp_path / "a.csv", hammer_scene())
    assert not (tmp_path / "r.mcap").exists()


def test_import_warns_of_missing_force_reference(tmp_path, imported):
    write_csv(tmp_path / "a.csv", random_samples(3000))
    text = (tmp_path / "a.csv").read_text()
    (tmp_path / "a.csv").write_text(text.replace("force", "forse"))
    _, notes = imported(tmp_path / "a.csv")
    assert any("force (Did you mean 'forse'?)" in note for note in notes)
    assert any("no channel measures the force on the structure" in note for note in notes)


@pytest.mark.filterwarnings("ignore:.*has no heading")
def test_force_and_response_may_have_separate_files(tmp_path, imported):
    times = np.arange(2048) / 2048.0
    force = np.where(times < 4e-3, 50.0 * np.sin(np.pi * times / 4e-3), 0.0)
    for name, values in (("force", force), ("response", np.exp(-20.0 * times) * np.sin(300.0 * times))):
        np.savetxt(tmp_path / f"{name}.txt", np.column_stack([times, values]))
    table = {"hit": Column("column 2", file="force", unit="N"), "body1": Column("column 2", file="response", unit="g")}
    files = [tmp_path / "force.txt", tmp_path / "response.txt"]
    recording, _ = imported(files, hammer_scene(), table=table)
    np.testing.assert_allclose(recording.read("hit"), force, rtol=0, atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*has no heading")
def test_times_of_three_digits_are_recognized(tmp_path):
    times = np.arange(4000) / 4000.0
    rows = "".join(f"{time:.2E}\t{np.sin(300.0 * time):.6f}\n" for time in times)
    (tmp_path / "a.txt").write_text(rows)
    listed = CliRunner().invoke(app, ["import", str(tmp_path / "a.txt")]).output
    assert 'signal1: {column: "column 2"}  # 4000 samples at 4000 Hz' in listed


def test_labview_spectrum_is_refused(tmp_path):
    heading = LABVIEW_HEAD.format(name="Tab", point=".", columns="One") + "Channels\t1\nDelta_X\t0.1\n" + END_OF_HEADER
    (tmp_path / "a.lvm").write_text(heading + "X_Value\tAcceleration (FFT - (RMS))\tComment\n0.0\t1.0\n0.1\t2.0\n")
    with pytest.raises(RecordingError, match="'Acceleration \\(FFT - \\(RMS\\)\\)' is a spectrum"):
        daq.import_files(tmp_path / "a.lvm", make_scene(), tmp_path / "r.mcap")


def test_joined_files_have_one_rate(tmp_path):
    write_hit(tmp_path / "a.csv", 80.0)
    write_hit(tmp_path / "b.csv", 90.0, 1024.0)
    with pytest.raises(RecordingError, match=r"the rate of 'hit' is 1024\.0, but a\.csv has 2048\.0"):
        daq.import_files([tmp_path / "a.csv", tmp_path / "b.csv"], hammer_scene(), tmp_path / "r.mcap")


def test_first_column_in_seconds_is_time(tmp_path):
    heading = "SignalCalc 240\nDate: 12/03/2021\n\nX-Axis(s)\tG1,1(m/s²)\tX2(N)\n"
    rows = "".join(f"{k / 1000:.6f}\t{k % 7}\t{k % 5}\n" for k in range(300))
    (tmp_path / "a.txt").write_bytes((heading + rows).encode("latin-1"))
    listed = CliRunner().invoke(app, ["import", str(tmp_path / "a.txt")]).output
    assert 'signal1: {column: "G1,1", unit: "m/s²"}  # 300 samples at 1000 Hz' in listed


@pytest.mark.parametrize(
    "lines",
    [
        "1,2\n3,-4.5e-3\n",
        "1,2\r\n3,4\r\n",
        "1,2\r3,4",
        "1, 2 \n 3,4\n",
        "1,\n,4\n",
        "nan,inf\n-inf,1e400\n",
        '"1",2\n3,4\n',
        "+1,2\n3,4\n",
        "1,2\n3,1e-400\n",
        "0.1,123456789.123456789\n1e23,5e-324\n",
    ],
)
def test_numbers_are_read_as_by_python(lines, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("a,b\n" + lines, newline="")
    expected = [[float(cell.strip(' "') or "nan") for cell in line.split(",")] for line in lines.splitlines()]
    with ExitStack() as stack:
        columns = [signal.read(0, 2) for signal in text_signals(path, stack)]
    np.testing.assert_array_equal(np.transpose(columns), expected)


def test_plain_numbers_are_parsed_in_blocks(tmp_path, monkeypatch):
    # Parsing line by line takes minutes for an hour of four channels.
    rows = "".join(f"{k / 1000},{k % 7}\n" for k in range(100_000))
    (tmp_path / "a.csv").write_text("time [s],body1 [g]\n" + rows)
    calls = []
    parse_line = text_table._Table._parse_line
    monkeypatch.setattr(text_table._Table, "_parse_line", lambda *each: calls.append(1) or parse_line(*each))
    monkeypatch.setattr(np, "loadtxt", lambda *_, **__: 1 // 0)
    with ExitStack() as stack:
        (signal,) = text_signals(tmp_path / "a.csv", stack)
        assert signal.read(65_536, 65_539).tolist() == [k % 7 for k in range(65_536, 65_539)]
    assert len(calls) < 100


def test_text_of_catman_is_read(tmp_path):
    heading = "catmanEasy ASCII\nMessrate: 1000 Hz\nZeit - Standard Messrate [s]\tKraft [N]\tBeschl 1 [m/s²]\n"
    rows = "".join(f"{k / 1000:.6f}\t{k % 7}\t{k % 5}\n" for k in range(300)).replace(".", ",")
    (tmp_path / "a.asc").write_bytes((heading + rows).encode("cp1252"))
    listed = CliRunner().invoke(app, ["import", str(tmp_path / "a.asc")]).output
    assert 'signal1: {column: "Kraft", unit: "N"}  # 300 samples at 1000 Hz' in listed
    assert 'signal2: {column: "Beschl 1", unit: "m/s²"}  # 300 samples at 1000 Hz' in listed
