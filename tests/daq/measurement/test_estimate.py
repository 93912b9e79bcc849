"""The estimated memory and disk space of a test are compared with the memory and disk space that it uses."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import rig
from daq.core.measurement.estimate import CHANNEL_COPIES, check_resources, estimate
from daq.core.recording.layout import block_length, flush_length
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.channel import ChannelInfo
from rig.core.base.errors import RunError

RATE = 5120.0  # Hz


def scene_with_channels(n_channels: int) -> rig.Scene:
    """Return a scene with this number of ideal channels on body 1."""
    channels = [{"name": f"c{i}", "at": "body 1"} for i in range(n_channels)]
    return rig.load("bare-structure").replace(converter={"rate": RATE}, channels=channels)


def test_memory_grows_with_channels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few, many, too_many = (estimate(scene_with_channels(count)) for count in (10, 2000, 4000))
    bytes_per_channel = (many.memory - few.memory) / (2000 - 10)
    assert few.memory < 0.4e9  # the program alone has 0.33 GB
    assert 0.25e6 < bytes_per_channel < 0.35e6  # signal path, and buffers of half a second
    check_resources(many, tmp_path / "a.mcap")
    with pytest.raises(RunError, match=r"all its channels.* would need 1\.\d+ GB of memory"):
        check_resources(too_many, tmp_path / "a.mcap")
    monkeypatch.setenv("SHOTRIG_MEMORY", "4GB")
    check_resources(too_many, tmp_path / "a.mcap")


def test_thousands_of_bodies_are_rejected_before_the_test(tmp_path: Path) -> None:
    count = 2000
    scene = rig.load("bare-structure")
    structure = {"masses": [1.0] * count, "springs": [1e6] * count, "damping": {"modal": 0.01}}
    with pytest.raises(RunError, match=r"matrices of its structure.*SHOTRIG_MEMORY"):
        check_resources(estimate(scene.replace(structure=structure)), tmp_path / "a.mcap")


def test_recorder_uses_estimated_memory(tmp_path: Path) -> None:
    n_channels, n_samples = 300, flush_length(RATE)
    infos = [ChannelInfo(f"c{i}", "body 1", "acceleration", 0.01, RATE) for i in range(n_channels)]
    scene = rig.load("bare-structure").replace(recording={"display": True, "truth": False})
    samples = np.random.default_rng(0).standard_normal((n_channels, n_samples))
    with Recorder(tmp_path / "a.mcap", scene, infos, RATE) as recorder:
        recorder.write(samples)
        tracemalloc.start()
        try:
            for _ in range(5):
                recorder.write(samples)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    # The next buffers of the file and of the display are allocated, but not yet filled, and take no memory.
    unfilled_buffers = 2 * samples.nbytes
    assert peak - unfilled_buffers < CHANNEL_COPIES * 8.0 * (n_samples + 2 * block_length(RATE)) * n_channels


def test_true_motion_is_in_estimated_size() -> None:
    scene = rig.load("fig8-three-dampers")
    size_without, size_with = (
        estimate(scene.replace(recording=scene.recording.replace(truth=truth))).disk for truth in (False, True)
    )
    assert size_with > 2.0 * size_without
