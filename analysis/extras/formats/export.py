"""Export of recordings: CSV, NPZ, MATLAB, UFF 58 and WAV files; SEP-005 dictionaries."""

import csv
import math
import re
import shutil
import wave
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from analysis.core.recordings.opening import takes_path
from analysis.core.recordings.slices import Slice
from analysis.extras.formats.mat import write_mat
from analysis.extras.formats.uff import write_uff
from daq.core.recording.recording import Recording
from rig.core.base.errors import RunError, SceneError
from rig.core.base.escaping import escape_cell
from rig.core.base.output_files import atomic_write
from rig.core.base.progress import CountProgress

SEP_QUANTITIES = {"acceleration": "a", "velocity": "v", "displacement": "d", "force": "f", "voltage": "V"}


@takes_path
def sep005(
    recording: Recording, channels: Sequence[str] | None = None, from_s: float | None = None, to_s: float | None = None
) -> list[dict[str, Any]]:
    """Return channels as SEP-005 time series, the input format of the sdypy packages.

    Parameters
    ----------
    recording : daq.Recording, str or Path
        The samples are read into memory.
    channels : sequence of str, optional
        Names of channels; default: all.
    from_s, to_s : float, optional
        Limits of the segment [s].

    Returns
    -------
    list of dict
        ``data`` (NaN where samples were lost), ``name``, ``unit_str``, ``fs`` [Hz], ``quantity``, ``group``
        (location of the sensor) and, if the recording has a date, ``start_timestamp``.
    """
    segment = Slice.of(recording, channels, from_s, to_s)
    date = {}
    if recording.start_ns:
        since = timedelta(microseconds=recording.start_ns // 1000 + round(segment.start / recording.rate * 1e6))
        date = {"start_timestamp": (datetime(1970, 1, 1, tzinfo=UTC) + since).isoformat()}
    return [
        {
            "data": recording.read(info.name, segment.start, segment.stop),
            "name": info.name,
            "unit_str": "m/s²" if info.unit == "m/s^2" else info.unit,
            "fs": recording.rate,
            "quantity": SEP_QUANTITIES[info.quantity],
            "group": info.at,
            **date,
        }
        for info in segment.infos
    ]


def write_csv(segment: Slice, path: Path) -> None:
    """Write a CSV table: time in s, then the channels, in full precision; lost samples are ``nan``."""
    # Imported here, because the import takes a tenth of a second.
    import pyarrow
    import pyarrow.csv

    names = ["time [s]", *(escape_cell(f"{info.name} [{info.unit}]") for info in segment.infos)]
    with path.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerow(names)
    # The heading has quotes only where necessary; pyarrow cannot write such a heading.
    schema = pyarrow.schema([(str(column), pyarrow.float64()) for column in range(len(names))])
    options = pyarrow.csv.WriteOptions(include_header=False)
    with path.open("ab") as numbers, pyarrow.csv.CSVWriter(numbers, schema, write_options=options) as writer:
        for first, samples in segment.pieces(segment.channels):
            time = np.arange(first, first + samples.shape[1]) / segment.recording.rate
            columns = [pyarrow.array(column) for column in (time, *samples)]
            writer.write_batch(pyarrow.RecordBatch.from_arrays(columns, schema=schema))


def write_npz(segment: Slice, path: Path) -> None:
    """Write an array for each channel, and ``channels``, ``units``, ``rate`` [Hz] and ``start_s``."""
    members = {name: re.sub(r"[^\w.-]", "_", name) for name in segment.channels}
    arrays = ["channels", "units", "rate", "start_s", *members.values()]
    for name, member in members.items():
        if arrays.count(member) > 1:
            raise SceneError(
                f"{segment.recording.path}: channel {name!r} cannot be exported to .npz, because another array of the "
                f"file has the name {member!r}. Export as .uff or .csv."
            )
    with zipfile.ZipFile(path, "w") as archive:
        for name, member in members.items():
            with archive.open(_zip_entry(member), "w", force_zip64=True) as stream:
                header = {"descr": "<f8", "fortran_order": False, "shape": (segment.stop - segment.start,)}
                np.lib.format.write_array_header_1_0(stream, header)
                for _, samples in segment.pieces([name]):
                    stream.write(samples.astype("<f8").tobytes())
        rate = segment.recording.rate
        metadata = {
            "channels": np.array(list(members.values())),
            "units": np.array([info.unit for info in segment.infos]),
            "rate": np.array(rate),
            "start_s": np.array(segment.start / rate),
        }
        for member, array in metadata.items():
            with archive.open(_zip_entry(member), "w") as stream:
                np.lib.format.write_array(stream, array, allow_pickle=False)


def _zip_entry(name: str) -> zipfile.ZipInfo:
    # A fixed date makes the files of equal recordings identical.
    return zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))


def write_wav(segment: Slice, path: Path, speed: float = 1.0) -> list[str]:
    """Write 24-bit sound, each channel scaled to full scale.

    Return a line of text with the full-scale value of each channel.

    `speed`: playback speed factor: with 10, a tone of 30 Hz sounds at 300 Hz. Raises `RecordingError` if samples were
    lost. Raises `SceneError` if the sound is too long for a WAV file, or its rate cannot be stored in the file header.
    """
    segment.reject_gaps("a WAV file")
    recording, n_channels, rate = segment.recording.path, len(segment.channels), segment.recording.rate * speed
    if not (math.isfinite(rate) and 1 <= round(rate) < 2**31 // (3 * n_channels)):
        limit = 2**31 // (3 * n_channels)
        raise SceneError(
            f"{recording}: `speed` {speed:g} gives {rate:g} samples per second; a WAV file allows 1 to {limit:.2g}. "
            "Choose another `speed`."
        )
    if (n_bytes := (segment.stop - segment.start) * n_channels * 3) >= 2**32 - 1024:
        raise SceneError(
            f"{recording}: a WAV file is limited to 4 GB (these samples: {n_bytes / 1e9:.3g} GB). Export fewer "
            "channels (`channel`) or a segment (`from_s`, `to_s`)."
        )
    peaks = np.zeros(n_channels)
    for _, samples in segment.pieces(segment.channels):
        peaks = np.maximum(peaks, np.abs(samples).max(axis=1))
    full_scale = np.where(peaks > 0, peaks, 1.0)
    with path.open("wb") as stream, wave.open(stream, "wb") as sound:
        sound.setnchannels(n_channels)
        sound.setsampwidth(3)
        sound.setframerate(round(rate))
        for _, samples in segment.pieces(segment.channels):
            integers = np.ascontiguousarray(np.rint(samples.T / full_scale * (2**23 - 1)), dtype="<i4")
            # 24-bit samples are the lower three of four bytes; the channels are interleaved.
            sound.writeframesraw(integers.view(np.uint8).reshape(*integers.shape, 4)[..., :3].tobytes())
    return [
        f"{info.name}: full scale is {value:.6g} {info.unit}"
        for info, value in zip(segment.infos, full_scale, strict=True)
    ]


WRITERS: dict[str, Callable[[Slice, Path], None]] = {
    ".csv": write_csv, ".npz": write_npz, ".mat": write_mat, ".uff": write_uff, ".unv": write_uff,
}  # fmt: skip
# Number of bytes per sample; for text formats, with an average number of digits.
_BYTES_PER_SAMPLE = {".csv": 20.0, ".npz": 8.0, ".mat": 8.0, ".wav": 3.0, ".uff": 20.25, ".unv": 20.25}


def expected_bytes(segment: Slice, ending: str) -> float:
    """Estimate the size of the exported file [bytes]; in CSV files the time is an additional column."""
    columns = len(segment.channels) + (ending == ".csv")
    return (segment.stop - segment.start) * (_BYTES_PER_SAMPLE[ending] * columns)


def extension_of(path: Path) -> str:
    """Return the extension, which determines the format; raise `SceneError` if it is not supported."""
    extension = path.suffix.lower()
    if extension not in _BYTES_PER_SAMPLE:
        raise SceneError(
            f"{path}: unknown format {extension!r}. Choose a name that ends in one of {', '.join(_BYTES_PER_SAMPLE)}."
        )
    return extension


def export(
    segment: Slice, path: Path, speed: float = 1.0, overwrite: bool = False, progress: CountProgress | None = None
) -> list[str]:
    """Write a segment of a recording in the format of the file name extension; return messages for the user.

    The arguments are those of `analysis.export`. Raises `SceneError` if the extension is unknown, the file exists, or
    the format cannot contain the segment. Raises `RecordingError` if the recording is damaged, or the format cannot
    represent lost samples. Raises `RunError` if the file cannot be written.
    """
    kind = extension_of(path)
    if speed != 1.0 and kind != ".wav":
        raise SceneError(f"{path}: `speed` applies only to sound. Omit `speed`, or choose a name that ends in .wav.")
    if progress is not None:
        # WAV reads all samples twice, because it needs the peak values first.
        total = (2 if kind == ".wav" else 1) * len(segment.channels) * (segment.stop - segment.start)
        segment = replace(segment, on_read=_report_to(progress, total))
    with atomic_write(path, overwrite) as temporary:
        needed, free_bytes = expected_bytes(segment, kind), shutil.disk_usage(temporary.parent).free
        # A table of numbers with few digits requires only about a quarter of the expected size.
        if needed > 4 * free_bytes:
            raise RunError(
                f"{path}: the file would take about {needed / 1e6:.3g} MB, and its disk has {free_bytes / 1e6:.3g} MB "
                "left. Write to another disk, or export a segment (`from_s`, `to_s`) or fewer channels (`channel`)."
            )
        if kind == ".wav":
            return write_wav(segment, temporary, speed)
        WRITERS[kind](segment, temporary)
    return []


def _report_to(progress: CountProgress, total: int) -> Callable[[int], None]:
    """Return a callback that takes the number of samples read since its last call, and reports the sum."""
    samples_read = 0

    def count_samples(samples: int) -> None:
        nonlocal samples_read
        samples_read += samples
        progress(samples_read, total)

    return count_samples
