"""Small recordings with known content, made by the real recorder."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Message
from numpy.typing import NDArray

import rig
from daq.recording.markers import EVENT_TYPE
from daq.recording.recorder import Recorder
from daq.signal_chain.channel import ChannelInfo
from rig.arrays import Array

RATE = 2560.0
GROUP = 1280
BITS = {"converter": {"rate": RATE, "bits": 24, "range": 5.0}}
ALL = {"display": True, "truth": True}
DAMPERS = {"dampers": [{"body": 2, "mass_ratio": 0.1, "clearance": 1e-3}]}


def scene(**changes: Any) -> rig.Scene:
    """The bare structure; by default without display and truth."""
    recording = {"display": False, "truth": False} | changes.pop("recording", {})
    return rig.load("bare-structure").replace(recording=recording, **changes)


def channels(rate: float = RATE, counts: bool = False) -> list[ChannelInfo]:
    """Body 1 reads displacement, body 2 acceleration."""
    size = 10.0 / 2**24 if counts else None
    return [
        ChannelInfo("body1", "body 1", "displacement", 500.0, rate, volts_per_count=size),
        ChannelInfo("body2", "body 2", "acceleration", 0.01, rate, volts_per_count=size),
    ]


def signal(samples: int, seed: int = 0) -> Array:
    """Volts of both channels: no two samples are equal, so that a misplaced one shows."""
    return np.random.default_rng(seed).standard_normal((2, samples))


def write(
    path: Path, samples: NDArray[Any], of: rig.Scene | None = None, pieces: list[int] | None = None, rate: float = RATE
) -> Path:
    """Record samples in pieces of the given sizes, which are used in turn."""
    counts = np.issubdtype(samples.dtype, np.integer)
    of = scene() if of is None else of
    with Recorder(path, of, channels(rate, counts), rate) as recorder:
        place, turn = 0, 0
        while place < samples.shape[1]:
            size = (pieces or [samples.shape[1]])[turn % len(pieces or [0])]
            part = samples[:, place : place + size]
            if of.recording.truth:
                recorder.write_truth(motion(place, part.shape[1], len(of.dampers)))
            recorder.write(part)
            place, turn = place + size, turn + 1
        recorder.mark("measure", 100, 199, frequency=13.5)
    return path


def messages(path: Path, topic: str) -> list[Message]:
    """Messages of a topic in the order of the file, read by the reference implementation with all checks."""
    with path.open("rb") as stream:
        result = list(make_reader(stream, validate_crcs=True).iter_messages([topic], log_time_order=False))
    return [message for _, _, message in result]


def motion(first: int, samples: int, dampers: int = 0, points: int = 4, rate: float = RATE) -> rig.Motion:
    """A true motion that encodes the sample number, with impacts every 100 samples, just before a sample."""
    k = np.arange(first, first + samples, dtype=float)
    rows = 1e-3 * np.sin(0.01 * k) * np.arange(1, points + 1)[:, None]
    hits = [n for n in range(first, first + samples) if n and n % 100 == 0 and dampers]
    return rig.Motion(
        first=first,
        displacement=rows,
        velocity=rows + 1.0,
        acceleration=rows + 2.0,
        gap=np.tile(5e-4 + 1e-9 * k, (dampers, 1)),
        contact=np.tile((k % 3).astype(np.int8), (dampers, 1)),
        break_sample=np.array(hits, dtype=np.int64),
        break_offset=np.full(len(hits), 1.0 / rate),
        break_displacement=np.zeros((points, len(hits))),
        break_velocity=np.zeros((2, points, len(hits))),
        break_acceleration=np.zeros((2, points, len(hits))),
        events=np.array([(n / rate, 1, "floor", 0.25) for n in hits], dtype=EVENT_TYPE),
    )


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """The kernel refuses to let any file grow beyond this, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
