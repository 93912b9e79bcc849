"""Export of recordings: CSV, NPZ, MATLAB, UFF 58 and WAV files, and SEP-005 dictionaries."""

from __future__ import annotations

import csv
import re
import shutil
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.exporting.mat import write_mat
from analysis.exporting.uff import write_uff
from analysis.exporting.wav import write_wav
from analysis.recordings.names import takes_path
from analysis.recordings.slices import Slice
from rig.errors import RunError, SceneError
from rig.output_files import replacing

if TYPE_CHECKING:
    from daq.recording.recording import Recording

SHOWN_UNITS = {"m/s^2": "m/s²"}
SEP_QUANTITIES = {"acceleration": "a", "velocity": "v", "displacement": "d", "force": "f", "voltage": "V"}


@takes_path
def sep005(
    recording: Recording,
    channels: Sequence[str] | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
) -> list[dict[str, Any]]:
    """Return channels as SEP-005 time series, the input format of the sdypy packages.

    Parameters
    ----------
    recording : daq.Recording, str or Path
        The samples are read into memory.
    from_s, to_s : float, optional
        Limits of the stretch, s.

    Returns
    -------
    list of dict
        ``data`` (NaN where samples were lost), ``name``, ``unit_str``, ``fs`` [Hz], ``quantity``, ``group``
        (location of the sensor) and, if the recording has a date, ``start_timestamp``.
    """
    stretch = Slice.of(recording, channels, from_s, to_s)
    series = []
    for info in stretch.infos:
        one: dict[str, Any] = {
            "data": recording.read(info.name, stretch.start, stretch.stop),
            "name": info.name,
            "unit_str": SHOWN_UNITS.get(info.unit, info.unit),
            "fs": recording.rate,
            "quantity": SEP_QUANTITIES[info.quantity],
            "group": info.at,
        }
        if recording.start_ns:
            since = timedelta(
                microseconds=recording.start_ns // 1000 + round(stretch.start / recording.rate * 1e6)
            )
            one["start_timestamp"] = (datetime(1970, 1, 1, tzinfo=UTC) + since).isoformat()
        series.append(one)
    return series


def write_csv(stretch: Slice, path: Path) -> None:
    """Write a CSV table: time in s, then the channels, in full precision; lost samples are ``nan``."""
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time [s]", *(f"{info.name} [{info.unit}]" for info in stretch.infos)])
        for first, samples in stretch.pieces(stretch.channels):
            time = np.arange(first, first + samples.shape[1]) / stretch.recording.rate
            writer.writerows(zip(time.tolist(), *samples.tolist(), strict=True))


def write_npz(stretch: Slice, path: Path) -> None:
    """Write an array for each channel, and ``channels``, ``units``, ``rate`` [Hz] and ``start_s``."""
    members = {name: re.sub(r"[^\w.-]", "_", name) for name in stretch.channels}
    taken = {"channels", "units", "rate", "start_s"}
    if len({*members.values()} | taken) < len(members) + len(taken):
        raise SceneError(f"the channels {', '.join(members)} cannot all be members of one .npz; choose fewer")
    with zipfile.ZipFile(path, "w") as archive:
        for name, member in members.items():
            with archive.open(_member(member), "w", force_zip64=True) as stream:
                shape = (stretch.stop - stretch.start,)
                header = {"descr": "<f8", "fortran_order": False, "shape": shape}
                np.lib.format.write_array_header_1_0(stream, header)
                for _, samples in stretch.pieces([name]):
                    stream.write(samples.astype("<f8").tobytes())
        rate = stretch.recording.rate
        rest = {
            "channels": np.array(list(members.values())),
            "units": np.array([info.unit for info in stretch.infos]),
            "rate": np.array(rate),
            "start_s": np.array(stretch.start / rate),
        }
        for member, array in rest.items():
            with archive.open(_member(member), "w") as stream:
                np.lib.format.write_array(stream, array, allow_pickle=False)


def _member(name: str) -> zipfile.ZipInfo:
    # With a fixed date, equal recordings yield identical files.
    return zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))


WRITERS: dict[str, Callable[[Slice, Path], Any]] = {
    ".csv": write_csv,
    ".npz": write_npz,
    ".mat": write_mat,
    ".wav": write_wav,
    ".uff": write_uff,
    ".unv": write_uff,
}
# Bytes for each sample, and bytes for the time at the beginning of each line.
_BYTES = {
    ".csv": (20.0, 20.0),
    ".npz": (8.0, 0.0),
    ".mat": (8.0, 0.0),
    ".wav": (3.0, 0.0),
    ".uff": (20.25, 0.0),
}
# Number of times that all samples are read: WAV needs the peak values first.
_PASSES = {".wav": 2}


def expected_bytes(stretch: Slice, ending: str) -> float:
    """Estimate the size of the exported file, bytes."""
    sample, line = _BYTES.get(ending, _BYTES[".uff"])
    return (stretch.stop - stretch.start) * (sample * len(stretch.channels) + line)


def kind_of(path: Path) -> str:
    """Return the file name ending, which determines the format.

    Raises `SceneError` if the format is not supported.
    """
    kind = path.suffix.lower()
    if kind not in WRITERS:
        raise SceneError(f"{path}: expected a name that ends in one of {', '.join(WRITERS)}")
    return kind


def export(
    stretch: Slice,
    path: Path,
    speed: float = 1.0,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Write a stretch of a recording in the format given by the file name ending.

    Parameters
    ----------
    path : Path
        Output file: ``.csv``, ``.npz``, ``.mat``, ``.wav``, ``.uff`` or ``.unv``.
    speed : float
        Playback speed factor; only for sound (.wav).
    overwrite : bool
        Whether an existing file with different content may be replaced.
    progress : callable, optional
        Called with (samples read, total).

    Returns
    -------
    list of str
        Messages for the user.

    Raises
    ------
    SceneError
        If the ending is unknown, the file exists, or the stretch does not fit the format.
    RecordingError
        If samples are lost that the format requires, or the recording is damaged.
    RunError
        If the file cannot be written, or the disk is too small.
    """
    kind = kind_of(path)
    if speed != 1.0 and kind != ".wav":
        raise SceneError("--speed is for sound (.wav)")
    if progress is not None:
        stretch = replace(stretch, on_read=_counter(stretch, _PASSES.get(kind, 1), progress))
    with replacing(path, overwrite or None) as part:
        needed, free = expected_bytes(stretch, kind), shutil.disk_usage(part.parent).free
        # A table of short numbers needs only about a quarter of the expected size.
        if needed > 4 * free:
            raise RunError(
                f"{path} would take about {needed / 1e6:.3g} MB, and its disk has {free / 1e6:.3g} MB left; choose "
                "another disk (-o), a stretch (--from, --to) or fewer channels"
            )
        if kind == ".wav":
            full = write_wav(stretch, part, speed)
            notes = [
                f"{info.name}: full scale is {value:.6g} {info.unit}"
                for info, value in zip(stretch.infos, full, strict=True)
            ]
        else:
            WRITERS[kind](stretch, part)
            notes = []
    return notes


def _counter(stretch: Slice, passes: int, progress: Callable[[int, int], None]) -> Callable[[int], None]:
    total, done = passes * len(stretch.channels) * (stretch.stop - stretch.start), 0

    def read(samples: int) -> None:
        nonlocal done
        done += samples
        progress(done, total)

    return read
