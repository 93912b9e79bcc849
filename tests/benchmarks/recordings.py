"""Speed and memory of writing and reading recordings: `python -m tests.benchmarks.recordings`."""

import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import daq
import rig
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo

# Locations of the four channels.
LOCATIONS = ("body 1", "body 2", "body 3", "table")


def time_to_write(path: Path, rate: float, seconds: int, display: bool) -> float:
    """Write four channels of float64 noise in blocks of 0.1 s; return the elapsed time, s. Noise is incompressible."""
    scene = rig.load("bare-structure").replace(recording={"display": display, "samples": "float64"})
    channels = [ChannelInfo(at.replace(" ", ""), at, "acceleration", 0.01, rate) for at in LOCATIONS]
    block_samples = round(rate / 10)
    noise = np.random.default_rng(1).standard_normal((4, 20 * block_samples))
    start = time.perf_counter()
    with Recorder(path, scene, channels, rate) as recorder:
        for number in range(10 * seconds):
            first = number % 20 * block_samples
            recorder.write(noise[:, first : first + block_samples])
    return time.perf_counter() - start


def peak_memory() -> float:
    """Return the peak memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(folder: Path, one_hour: bool) -> Iterator[str]:
    """Yield a line for each result; `one_hour`: also measure a recording of one hour (6 GB, minutes)."""
    rate, seconds = 10240.0, 300
    path = folder / "blocks-of-1024.mcap"
    elapsed = time_to_write(path, rate, seconds, display=False)
    megabytes = 4 * 8 * rate * seconds / 1e6
    yield f"write, blocks of 1024 float64 samples: {megabytes / elapsed:.0f} MB/s"
    with daq.open(path) as recording:
        shortest = min(_elapsed(lambda: [recording.read(name) for name in recording.channels]) for _ in range(5))
    yield f"read to numpy with checksums, blocks of 1024: {megabytes / shortest:.0f} MB/s"
    if not one_hour:
        return
    rate, path = 51200.0, folder / "hour.mcap"
    elapsed = time_to_write(path, rate, 3600, display=True)
    yield f"an hour at 4 x 51.2 kS/s with display: written in {elapsed:.0f} s, {path.stat().st_size / 1e9:.2f} GB"
    yield f"peak memory so far: {peak_memory():.0f} MiB"
    middle = 1800 * round(rate)

    def one_second() -> None:
        with daq.open(path) as recording:
            for name in recording.channels:
                recording.read(name, middle, middle + round(rate))

    shortest = min(_elapsed(one_second) for _ in range(5))
    yield f"opening it and reading one second of all channels: {1e3 * shortest:.1f} ms"
    with daq.open(path) as recording:
        elapsed = _elapsed(lambda: sum(samples.shape[1] for _, samples in recording.blocks()))
    speed = 4 * 8 * rate * 3600 / 1e6 / elapsed
    yield f"reading all of it in blocks: {speed:.0f} MB/s, peak memory {peak_memory():.0f} MiB"


def _elapsed(action: Callable[[], object]) -> float:
    """Return the elapsed time of a call, s."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        for line in measure(Path(folder), one_hour="--hour" in sys.argv):
            print(line, flush=True)
