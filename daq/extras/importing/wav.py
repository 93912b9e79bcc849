"""Read the tracks of a WAV file: integers of 8 to 32 bits or floats, even in files of more than 4 GB (RF64).

A WAV file consists of chunks: `fmt ` specifies the sample format, `data` contains the samples, and `ds64` contains the
sizes in RF64.
"""

from __future__ import annotations

import struct
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from daq.extras.importing.signal import Signal
from rig.core.base.arrays import Array
from rig.core.base.errors import RecordingError

# Format tags of the `fmt ` chunk.
_INTEGER, _FLOAT, _EXTENSIBLE = 1, 3, 0xFFFE
_SAMPLE_BYTES = {_INTEGER: (1, 2, 3, 4), _FLOAT: (4, 8)}
# Size field of a chunk whose size is stated in `ds64`, or not at all.
_SIZE_ELSEWHERE = 0xFFFFFFFF


def wav_signals(path: Path, _stack: ExitStack) -> list[Signal]:
    """List the tracks of a WAV file as signals without a unit, whose full scale is 1; samples are read when needed."""
    format_chunk, offset, size = _find_samples(path)
    format_tag, tracks, rate, _, frame_bytes, bits_per_sample = struct.unpack_from("<HHIIHH", format_chunk)
    if format_tag == _EXTENSIBLE and len(format_chunk) >= 26:
        (format_tag,) = struct.unpack_from("<H", format_chunk, 24)
    sample_bytes = frame_bytes // tracks if tracks else 0
    if sample_bytes not in _SAMPLE_BYTES.get(format_tag, ()) or frame_bytes != sample_bytes * tracks:
        raise RecordingError(
            f"{path}: a WAV file of format {format_tag} with {bits_per_sample} bits and {tracks} tracks. Export "
            "uncompressed samples: integers of 8, 16, 24 or 32 bits, or floats of 32 or 64 bits."
        )
    samples = size // frame_bytes
    if rate < 1:
        raise RecordingError(f"{path}: its header states a sample rate of {rate} Hz. Export it again.")
    if samples < 2:
        raise RecordingError(f"{path}: number of samples is {samples}; expected at least 2. Export a longer signal.")
    data = np.memmap(path, np.uint8, "r", offset, (samples, tracks, sample_bytes))
    full_scale = None if format_tag == _FLOAT else 1.0 - 2.0 ** (1 - 8 * sample_bytes)

    def track_signal(number: int) -> Signal:
        def read(start: int, stop: int) -> Array:
            return _decode(np.ascontiguousarray(data[start:stop, number]), format_tag == _FLOAT)

        name = f"track {number + 1}"
        return Signal(path.name, number + 1, name, "", samples, float(rate), read, full_scale=full_scale)

    return [track_signal(number) for number in range(tracks)]


def _decode(raw: NDArray[np.uint8], is_float: bool) -> Array:
    """Convert the bytes of samples, shape (samples, bytes), to numbers with full scale 1."""
    sample_bytes = raw.shape[1]
    if is_float:
        return raw.view(f"<f{sample_bytes}")[:, 0].astype(np.float64)
    if sample_bytes == 1:
        return (raw[:, 0].astype(np.float64) - 128.0) / 128.0
    # The bytes become the most significant of four, so that the sign bit is in its place.
    padded = np.zeros((raw.shape[0], 4), np.uint8)
    padded[:, 4 - sample_bytes :] = raw
    return padded.view("<i4")[:, 0] / 2.0**31


def _find_samples(path: Path) -> tuple[bytes, int, int]:
    """Return the content of the chunk `fmt `, and the position and size of the samples in bytes."""
    format_chunk, ds64_size = b"", 0
    file_size = path.stat().st_size
    with path.open("rb") as file:
        riff_head = file.read(12)
        if len(riff_head) < 12 or riff_head[:4] not in (b"RIFF", b"RF64") or riff_head[8:] != b"WAVE":
            raise RecordingError(f"{path} is not a WAV file, or its header is damaged. Export it again.")
        while len(chunk := file.read(8)) == 8:
            name, size = struct.unpack("<4sI", chunk)
            position = file.tell()
            if name == b"ds64":
                ds64_size = struct.unpack_from("<Q", file.read(min(size, 64)).ljust(16, b"\0"), 8)[0]
            elif name == b"fmt ":
                format_chunk = file.read(min(size, 64))
            elif name == b"data":
                if size == _SIZE_ELSEWHERE or riff_head[:4] == b"RF64":
                    size = ds64_size or size
                if len(format_chunk) < 16:
                    raise RecordingError(
                        f"{path} is damaged: its samples are not preceded by a description of their format. Export it "
                        "again."
                    )
                if size != _SIZE_ELSEWHERE and position + size > file_size:
                    raise RecordingError(
                        f"{path} is truncated: its header states {size} bytes of samples, but it contains "
                        f"{file_size - position}. Export it again."
                    )
                return format_chunk, position, min(size, file_size - position)
            file.seek(position + size + size % 2)
    raise RecordingError(f"{path} contains no samples: it is truncated or damaged. Export it again.")
