"""How fast recordings are written and read, and how much memory that takes: `python -m tests.benchmarks.recordings`."""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import daq
import rig
from daq.recording.recorder import Recorder
from daq.signal_chain.channel import ChannelInfo

CHANNELS = ("body 1", "body 2", "body 3", "table")


def record(path: Path, rate: float, seconds: int, display: bool) -> float:
    """Write noise as float64, which nothing shrinks, in pieces of 0.1 s; give the time it took, s."""
    scene = rig.load("bare-structure").replace(recording={"display": display, "samples": "float64"})
    channels = [ChannelInfo(at.replace(" ", ""), at, "acceleration", 0.01, rate) for at in CHANNELS]
    piece = round(rate / 10)
    noise = np.random.default_rng(1).standard_normal((4, 20 * piece))
    began = time.perf_counter()
    with Recorder(path, scene, channels, rate) as recorder:
        for turn in range(10 * seconds):
            first = turn % 20 * piece
            recorder.write(noise[:, first : first + piece])
    return time.perf_counter() - began


def peak_memory() -> float:
    """Give the largest memory this process ever took, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(folder: Path, hour: bool) -> Iterator[str]:
    """Yield lines with figures; `hour` takes 6 GB of disk and some minutes."""
    rate, seconds = 10240.0, 300
    path = folder / "blocks-of-1024.mcap"
    took = record(path, rate, seconds, display=False)
    megabytes = 4 * 8 * rate * seconds / 1e6
    yield f"write, blocks of 1024 float64 samples: {megabytes / took:.0f} MB/s"
    with daq.open(path) as recording:
        best = min(_timed(lambda: [recording.read(name) for name in recording.channels]) for _ in range(5))
    yield f"read to numpy with checksums, blocks of 1024: {megabytes / best:.0f} MB/s"
    if not hour:
        return
    rate, path = 51200.0, folder / "hour.mcap"
    took = record(path, rate, 3600, display=True)
    yield f"an hour at 4 x 51.2 kS/s with display: written in {took:.0f} s, {path.stat().st_size / 1e9:.2f} GB"
    yield f"peak memory of writing it: {peak_memory():.0f} MB"
    middle = 1800 * round(rate)

    def one_second() -> None:
        with daq.open(path) as recording:
            for name in recording.channels:
                recording.read(name, middle, middle + round(rate))

    yield f"open, and one second of all channels: {1e3 * min(_timed(one_second) for _ in range(5)):.1f} ms"
    with daq.open(path) as recording:
        took = _timed(lambda: sum(samples.shape[1] for _, samples in recording.blocks()))
    yield f"all of it in blocks: {4 * 8 * rate * 3600 / 1e6 / took:.0f} MB/s, peak memory {peak_memory():.0f} MB"


def _timed(action: object) -> float:
    assert callable(action)
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for line in measure(Path(folder), hour="--hour" in sys.argv):
            print(line, flush=True)
