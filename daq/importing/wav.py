"""Signals of a WAV file, read in place: whole numbers of 8 to 32 bits, floats, also of more than 4 GB (RF64)."""

from __future__ import annotations

import struct
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.importing.signal import Signal
from rig.arrays import Array
from rig.errors import RecordingError

# Format tags of the `fmt ` chunk.
_INTEGER, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
_BYTES = {_INTEGER: (1, 2, 3, 4), _FLOAT: (4, 8)}
# Stated size of a chunk whose size is stated in another chunk or not at all.
_UNKNOWN = 0xFFFFFFFF


def wav_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List the tracks of a WAV file; 1 in them is full scale, and they have no unit."""
    form, offset, size = _chunks(path)
    tag, tracks, rate, _, frame, bits = struct.unpack_from("<HHIIHH", form)
    if tag == _EXTENSIBLE and len(form) >= 26:
        (tag,) = struct.unpack_from("<H", form, 24)
    depth = frame // tracks if tracks else 0
    if depth not in _BYTES.get(tag, ()) or frame != depth * tracks:
        raise RecordingError(
            f"{path}: a WAV file of format {tag} with {bits} bits and {tracks} tracks; expected uncompressed samples: "
            "whole numbers of 8, 16, 24 or 32 bits, or floats of 32 or 64"
        )
    samples = size // frame
    if rate < 1 or samples < 2:
        raise RecordingError(
            f"{path}: its header states {rate} samples per second, and it contains {samples} samples. Export it again."
        )
    data = np.memmap(path, np.uint8, "r", offset, (samples, tracks, depth))
    full_scale = None if tag == _FLOAT else 1.0 - 2.0 ** (1 - 8 * depth)

    def track(number: int) -> Signal:
        def read(start: int, stop: int) -> Array:
            return _numbers(np.ascontiguousarray(data[start:stop, number]), tag == _FLOAT)

        name = f"track {number + 1}"
        return Signal(path.name, number + 1, name, "", samples, float(rate), read, full_scale=full_scale)

    return [track(number) for number in range(tracks)]


def _numbers(raw: NDArray[np.uint8], floats: bool) -> Array:
    """Convert the bytes of samples, shape (samples, bytes), into numbers with full scale 1."""
    depth = raw.shape[1]
    if floats:
        return raw.view(f"<f{depth}")[:, 0].astype(np.float64)
    if depth == 1:
        return (raw[:, 0].astype(np.float64) - 128.0) / 128.0
    # As the most significant bytes of four, so that the sign bit is in its place.
    padded = np.zeros((raw.shape[0], 4), np.uint8)
    padded[:, 4 - depth :] = raw
    return padded.view("<i4")[:, 0] / 2.0**31


def _chunks(path: Path) -> tuple[bytes, int, int]:
    """Return the format, and the offset and size in bytes of the samples."""
    form, size64 = b"", 0
    end = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12 or head[:4] not in (b"RIFF", b"RF64") or head[8:] != b"WAVE":
            raise RecordingError(f"{path} is not a WAV file, or its header is damaged. Export it again.")
        while len(chunk := file.read(8)) == 8:
            name, size = struct.unpack("<4sI", chunk)
            at = file.tell()
            if name == b"ds64":
                size64 = struct.unpack_from("<Q", file.read(min(size, 64)).ljust(16, b"\0"), 8)[0]
            elif name == b"fmt ":
                form = file.read(min(size, 64))
            elif name == b"data":
                size = size64 or size if size == _UNKNOWN or head[:4] == b"RF64" else size
                if len(form) < 16:
                    raise RecordingError(f"{path}: no format before its samples: the file is damaged. Export it again.")
                if size != _UNKNOWN and at + size > end:
                    raise RecordingError(
                        f"{path} is cut off: its header states {size} bytes of samples, it contains "
                        f"{end - at}. Export it again."
                    )
                return form, at, min(size, end - at)
            file.seek(at + size + size % 2)
    raise RecordingError(f"{path} contains no samples: it is cut off or damaged. Export it again.")
