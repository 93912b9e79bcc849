"""Export of channels as WAV sound, for example to listen to impacts."""

from __future__ import annotations

import math
import wave
from pathlib import Path

import numpy as np

from analysis.recordings.slices import Slice
from rig.errors import SceneError


def write_wav(stretch: Slice, path: Path, speed: float = 1.0) -> list[float]:
    """Write 24-bit sound, with each channel scaled to full scale.

    `speed`: playback speed factor: with 10, a tone of 30 Hz sounds at 300 Hz. Returns full-scale value of each
    channel, in its unit. Raises `RecordingError` if samples were lost. Raises `SceneError` if the sound is too long
    for a WAV file, or its rate cannot be stored in the file header.
    """
    stretch.need_all("a WAV file")
    rate = stretch.recording.rate * speed
    if not (math.isfinite(rate) and 1 <= round(rate) < 2**31 // (3 * len(stretch.channels))):
        raise SceneError(f"a WAV file cannot play {rate:g} samples per second; choose another --speed")
    if (stretch.stop - stretch.start) * len(stretch.channels) * 3 >= 2**32 - 1024:
        raise SceneError("a WAV file holds 4 GB at most; export fewer channels or a stretch (--from, --to)")
    peaks = np.zeros(len(stretch.channels))
    for _, samples in stretch.pieces(stretch.channels):
        peaks = np.maximum(peaks, np.abs(samples).max(axis=1))
    full = np.where(peaks > 0, peaks, 1.0)
    with path.open("wb") as stream, wave.open(stream, "wb") as sound:
        sound.setnchannels(len(stretch.channels))
        sound.setsampwidth(3)
        sound.setframerate(round(rate))
        for _, samples in stretch.pieces(stretch.channels):
            whole = np.ascontiguousarray(np.rint(samples.T / full * (2**23 - 1)), dtype="<i4")
            # 24-bit samples are the lower three of four bytes; the channels are interleaved.
            sound.writeframesraw(whole.view(np.uint8).reshape(*whole.shape, 4)[..., :3].tobytes())
    return [float(value) for value in full]
