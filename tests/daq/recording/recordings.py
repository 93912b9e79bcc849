"""Small recordings with known content, made by the real recorder."""

import itertools
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.records import Message

import rig
from daq.core.recording.markers import EVENT_TYPE
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.arrays import Array

RATE = 2560.0  # Hz
# Sensitivities of the two channels.
VOLTS_PER_METER = 500.0  # body1
VOLTS_PER_ACCELERATION = 0.01  # body2, V per m/s^2
FLUSH_LENGTH = 1280  # Samples that the recorder writes to the disk together at this rate.
CONVERTER_24_BIT = {"converter": {"rate": RATE, "bits": 24, "range": 5.0}}
DISPLAY_AND_TRUTH = {"display": True, "truth": True}
ONE_DAMPER = {"dampers": [{"body": 2, "mass_ratio": 0.1, "clearance": 1e-3}]}


def make_scene(**changes: Any) -> rig.Scene:
    """Return the bare structure; by default its recordings have no display topics and no truth."""
    recording = {"display": False, "truth": False} | changes.pop("recording", {})
    return rig.load("bare-structure").replace(recording=recording, **changes)


def two_channels(rate: float = RATE, counts: bool = False) -> list[ChannelInfo]:
    """Return a displacement channel of body 1 and an acceleration channel of body 2."""
    volts_per_count = 10.0 / 2**24 if counts else None
    return [
        ChannelInfo("body1", "body 1", "displacement", VOLTS_PER_METER, rate, volts_per_count=volts_per_count),
        ChannelInfo("body2", "body 2", "acceleration", VOLTS_PER_ACCELERATION, rate, volts_per_count=volts_per_count),
    ]


def random_volts(samples: int, seed: int = 0) -> Array:
    """Return volts (2 channels, samples); as no two samples are equal, a misplaced sample is detected."""
    return np.random.default_rng(seed).standard_normal((2, samples))


def write_recording(path, samples, scene=None, piece_lengths=None, rate=RATE):
    """Record volts or counts (2 channels, samples) in pieces; their lengths repeat, by default there is one piece."""
    counts = np.issubdtype(samples.dtype, np.integer)
    scene = make_scene() if scene is None else scene
    lengths = itertools.cycle(piece_lengths or [samples.shape[1]])
    with Recorder(path, scene, two_channels(rate, counts), rate) as recorder:
        first = 0
        while first < samples.shape[1]:
            piece = samples[:, first : first + next(lengths)]
            if scene.recording.truth:
                recorder.write_truth(true_motion(first, piece.shape[1], len(scene.dampers)))
            recorder.write(piece)
            first += piece.shape[1]
        recorder.mark("measure", 100, 199, frequency=13.5)
    return path


def messages_of(path: Path, topic: str) -> list[Message]:
    """Return the messages of a topic in the order of the file, read and checked by the reference implementation."""
    with path.open("rb") as stream:
        result = list(make_reader(stream, validate_crcs=True).iter_messages([topic], log_time_order=False))
    return [message for _, _, message in result]


def true_motion(first: int, samples: int, dampers: int = 0, points: int = 4, rate: float = RATE) -> rig.Motion:
    """Return a true motion that is computed from the sample index, with an impact before each hundredth sample."""
    sample_number = np.arange(first, first + samples, dtype=float)
    displacement = 1e-3 * np.sin(0.01 * sample_number) * np.arange(1, points + 1)[:, None]
    impact_samples = [n for n in range(first, first + samples) if n and n % 100 == 0 and dampers]
    return rig.Motion(
        first=first,
        displacement=displacement,
        velocity=displacement + 1.0,
        acceleration=displacement + 2.0,
        gap=np.tile(5e-4 + 1e-9 * sample_number, (dampers, 1)),
        contact=np.tile((sample_number % 3).astype(np.int8), (dampers, 1)),
        discontinuity_sample=np.array(impact_samples, dtype=np.int64),
        discontinuity_offset=np.full(len(impact_samples), 1.0 / rate),
        discontinuity_displacement=np.zeros((points, len(impact_samples))),
        discontinuity_velocity=np.zeros((2, points, len(impact_samples))),
        discontinuity_acceleration=np.zeros((2, points, len(impact_samples))),
        events=np.array([(n / rate, 1, "floor", 0.25) for n in impact_samples], dtype=EVENT_TYPE),
    )


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Let the kernel reject each write that makes a file larger than this size in bytes, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
