"""Memory of commands that read a whole recording: it does not grow with the duration."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import daq
import rig
from analysis.core.recordings import slices
from analysis.core.recordings.slices import Slice
from analysis.extras.formats.export import export as export_segment
from daq.core.recording import channel_series
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from tests.peak_memory import peak_memory

RATE = 10240.0


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return recordings of four channels of noise that last 5 s and 10 s."""
    scene = rig.load("bare-structure").replace(recording={"display": False, "samples": "float64"})
    channels = [ChannelInfo(f"c{k}", f"body {k}", "acceleration", 0.01, RATE) for k in (1, 2, 3)]
    channels.append(ChannelInfo("table", "table", "acceleration", 0.01, RATE))
    paths = [tmp_path_factory.mktemp("memory") / f"{seconds}.mcap" for seconds in (5, 10)]
    random = np.random.default_rng(1)
    for path, seconds in zip(paths, (5, 10), strict=True):
        with Recorder(path, scene, channels, RATE) as recorder:
            for _ in range(seconds):
                recorder.write(random.standard_normal((4, round(RATE))))
    return paths


def check(recording: daq.Recording, _: Path) -> None:
    recording.check()


def export(ending: str) -> Callable[[daq.Recording, Path], Any]:
    return lambda recording, folder: export_segment(Slice.of(recording), folder / f"out{ending}", overwrite=True)


@pytest.fixture(autouse=True)
def short_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read recordings in pieces that are much shorter than they are."""
    monkeypatch.setattr(channel_series, "_MAX_CACHE_BYTES", 1 << 18)
    monkeypatch.setattr(slices, "PIECE_SAMPLES", 1 << 12)


@pytest.mark.parametrize(
    "command", [check, *map(export, (".csv", ".npz", ".uff", ".wav"))], ids=["check", ".csv", ".npz", ".uff", ".wav"]
)
def test_memory_does_not_grow_with_duration(recordings, tmp_path, command):
    peaks = []
    # The first file includes imports.
    for path in (recordings[0], *recordings):
        with daq.open(path) as recording:
            peaks.append(peak_memory(command, recording, tmp_path)[0])
    assert peaks[2] < 1.2 * peaks[1]


def test_matlab_file_needs_memory_of_one_channel(recordings: list[Path], tmp_path: Path) -> None:
    peaks = []
    with daq.open(recordings[1]) as recording:
        # The first file includes imports.
        for channels in (["c1"], ["c1"], None):
            segment = Slice.of(recording, channels)
            peaks.append(peak_memory(export_segment, segment, tmp_path / "a.mat", overwrite=True)[0])
    assert peaks[2] < 1.2 * peaks[1]
