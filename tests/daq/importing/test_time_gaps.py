"""Missing rows of a file become lost samples; an incomplete last line is ignored."""

from contextlib import ExitStack
from pathlib import Path

import nptdms
import numpy as np
import pytest
import pyuff

from daq.extras.importing import clock
from daq.extras.importing.channel_table import Column
from daq.extras.importing.clock import clock_of_times, missing_rows
from daq.extras.importing.text_table import BLOCK_LINES, text_signals
from rig.core.base.errors import RecordingError, RunWarning
from tests.daq.importing.files import NAMES, SI_PER_UNIT, UNITS, random_samples

RATE = 2560.0  # Hz
SAMPLES = random_samples(4000)
# Ranges of samples that are missing in the file.
MISSING = [(700, 701), (2000, 2003), (2500, 3500)]
PRESENT = np.ones(4000, bool)
for first, stop in MISSING:
    PRESENT[first:stop] = False
TABLE = {name: Column(name, unit=unit) for name, unit in zip(NAMES, UNITS, strict=True)}


def write_text(path: Path, times: np.ndarray, channels: np.ndarray) -> None:
    heading = ",".join(["time [s]", *NAMES])
    np.savetxt(path, np.vstack([times, channels]).T, ["%.6f", *3 * ["%.9e"]], ",", header=heading, comments="")


def write_labview(path: Path, times: np.ndarray, channels: np.ndarray) -> None:
    heading = (
        "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t.\nX_Columns\tOne\n***End_of_Header***\t\n"
        "Channels\t3\nDelta_X\t0\t0\t0\n***End_of_Header***\t\nX_Value\t" + "\t".join(NAMES) + "\n"
    )
    lines = ["\t".join(f"{cell:.9e}" for cell in line) for line in np.vstack([times, channels]).T]
    path.write_text(heading + "\n".join(lines) + "\n")


def write_tdms(path: Path, times: np.ndarray, channels: np.ndarray) -> None:
    with nptdms.TdmsWriter(str(path)) as writer:
        columns = zip(("Time", *NAMES), np.vstack([times, channels]), strict=True)
        writer.write_segment([nptdms.ChannelObject("a", name, column) for name, column in columns])


def write_uff(path: Path, times: np.ndarray, channels: np.ndarray) -> None:
    for number, (name, channel) in enumerate(zip(NAMES, channels, strict=True), 1):
        pyuff.UFF(str(path)).write_sets(
            {
                "type": 58, "binary": 1, "func_type": 1, "id1": name, "rsp_node": number, "rsp_dir": 3,
                "ref_node": 0, "ref_dir": 0, "abscissa_spacing": 0, "abscissa_spec_data_type": 17,
                "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 0, "data": channel, "x": times,
            },
            mode="add",
        )  # fmt: skip


def write_npz(path: Path, times: np.ndarray, channels: np.ndarray) -> None:
    np.savez(path, time=times, **dict(zip(NAMES, channels, strict=True)))


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("ending", "write_file"),
    [("csv", write_text), ("lvm", write_labview), ("tdms", write_tdms), ("uff", write_uff), ("npz", write_npz)],
)
def test_missing_rows_are_imported_as_lost_samples(ending, write_file, tmp_path, imported):
    path = tmp_path / f"a.{ending}"
    write_file(path, np.arange(4000)[PRESENT] / RATE, SAMPLES[:, PRESENT])
    recording, messages = imported(path, table=TABLE)
    assert recording.rate == RATE and recording.samples == 4000
    for name, channel in zip(NAMES, SAMPLES * SI_PER_UNIT, strict=True):
        samples = recording.read(name)
        assert np.array_equal(np.isfinite(samples), PRESENT)
        np.testing.assert_allclose(samples[PRESENT], channel[PRESENT], rtol=1e-6)
        gaps = [gap for gap in recording.gaps if name in gap.channels]
        assert [(gap.first_sample, gap.last_sample + 1) for gap in gaps] == MISSING
    assert any("gaps in 3 places" in message and "1004 samples are missing" in message for message in messages)


def test_one_missing_sample_is_singular():
    with pytest.warns(RunWarning, match="1 sample is missing at 10 Hz"):
        clock_of_times(np.array([0.0, 0.1, 0.2, 0.4, 0.5]), 0.0, "times")


def test_gaps_are_detected_at_limits_of_blocks(tmp_path):
    present = np.delete(np.arange(2 * BLOCK_LINES + 100), [BLOCK_LINES, BLOCK_LINES + 1, 2 * BLOCK_LINES + 5])
    path = tmp_path / "a.csv"
    path.write_text("t [s],a [g]\n" + "".join(f"{number / 1000:.4f},{number}\n" for number in present))
    with ExitStack() as stack, pytest.warns(RunWarning, match="2 places.* 3 samples are missing at 1000 Hz"):
        (signal,) = text_signals(path, stack)
        values = signal.read(0, signal.samples)
    assert np.flatnonzero(np.isnan(values)).tolist() == [BLOCK_LINES, BLOCK_LINES + 1, 2 * BLOCK_LINES + 5]
    assert (values[~np.isnan(values)] == present).all()


@pytest.mark.parametrize(
    "times",
    [
        np.cumsum(np.random.default_rng(1).exponential(1.0, 500)),
        np.arange(500) + 0.4 * (np.arange(500) > 250),
        np.where(np.arange(500) > 250, np.arange(500) + 2000.0, np.arange(500)),
        np.where(np.arange(500) > 250, np.arange(500) - 20.0, np.arange(500)),
    ],
    ids=["random", "half a sample", "mostly lost", "backwards"],
)
def test_no_gaps_in_unevenly_spaced_times(times):
    assert missing_rows(times, 0.0) == []


@pytest.mark.parametrize("cut_bytes", [1, 4, 10, 20, 40, 48])
def test_truncated_last_line_is_omitted(cut_bytes, tmp_path, imported):
    path = tmp_path / "a.csv"
    write_text(path, np.arange(4000) / RATE, SAMPLES)
    data = path.read_bytes()
    path.write_bytes(data[: -1 - cut_bytes])
    recording, messages = imported(path, table=TABLE)
    assert recording.samples == 3999
    np.testing.assert_allclose(recording.read("force"), SAMPLES[2, :3999], rtol=1e-9)
    assert any("last line is invalid or truncated, and is not imported" in message for message in messages)


@pytest.mark.parametrize("rows", [11, 50, BLOCK_LINES + 1])
def test_truncated_line_after_few_rows_is_omitted(rows, tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t [s],a [g]\n" + "\n".join(f"{k / 100:.2f},{k + 0.5:.3f}" for k in range(rows))[:-1])
    with ExitStack() as stack, pytest.warns(RunWarning, match="last line is invalid or truncated, and is not imported"):
        assert text_signals(path, stack)[0].samples == rows - 1


def test_times_need_little_memory(tmp_path, monkeypatch):
    # The program itself takes 200 MB.
    monkeypatch.setenv("SHOTRIG_MEMORY", "210 MB")
    path = tmp_path / "a.csv"
    path.write_text("t [s],a [g]\n" + "".join(f"{k / 1000:.3f},1\n" for k in range(300_000)))
    with ExitStack() as stack:
        assert text_signals(path, stack)[0].rate == 1000.0


@pytest.mark.filterwarnings("ignore::rig.core.base.errors.RunWarning")
@pytest.mark.parametrize("jitter", [0.0, 0.3], ids=["gaps", "jitter"])
def test_clock_is_the_same_in_blocks(jitter, monkeypatch):
    numbers = np.delete(np.arange(1000), [] if jitter else [127, 128, 129, 600])
    times = 1.7e9 + (numbers + jitter * np.random.default_rng(3).uniform(-1.0, 1.0, numbers.size)) / 64.0
    whole = clock_of_times(times, 0.0, "times")
    monkeypatch.setattr(clock, "_BLOCK_TIMES", 64)
    in_blocks = clock_of_times(times, 0.0, "times")
    # A time since 1970 has a resolution of 0.24 µs.
    assert in_blocks == whole._replace(start_s=pytest.approx(whole.start_s, rel=0, abs=1e-6))
    assert list(whole.missing) == ([] if jitter else [(127, 3), (597, 1)])


def test_complete_last_line_without_end_is_read(tmp_path):
    # The last number has fewer digits before its decimal mark than all others.
    path = tmp_path / "a.csv"
    path.write_text("t [s],a [g]\n" + "\n".join(f"{k / 100:.2f},{1.5 if k == 40 else 123.5:.3f}" for k in range(41)))
    with ExitStack() as stack:
        assert text_signals(path, stack)[0].read(0, 41)[-1] == 1.5


def test_truncated_inner_line_is_rejected(tmp_path, imported):
    path = tmp_path / "a.csv"
    write_text(path, np.arange(4000) / RATE, SAMPLES)
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*lines[:2000], lines[2000][:9] + "\n", *lines[2001:]]))
    with pytest.raises(RecordingError, match="line 2001: 2 columns"):
        imported(path, table=TABLE)
