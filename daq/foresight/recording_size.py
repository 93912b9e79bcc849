"""Predicted size of a recording: a part of the rehearsal is written."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from daq.recording.recorder import Recorder
from daq.virtual_bench.bench import Bench
from daq.virtual_bench.stream import Block
from rig.scene.scene import Scene


def recording_size(scene: Scene, bench: Bench, blocks: Iterable[Block], seconds: float) -> float:
    """Estimate the size of the recording of a test of a duration in s from some of its blocks, bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "size.mcap"
        written = 0
        with Recorder(path, scene, bench.channels, bench.rate) as recorder:
            empty = recorder.size
            for block in blocks:
                if not block.samples.shape[1]:
                    continue
                if scene.recording.truth:
                    motion = replace(block.motion, first=written, events=block.motion.events[:0])
                    recorder.write_truth(motion)
                recorder.write(block.samples)
                written += block.samples.shape[1]
        whole = path.stat().st_size
    return empty + (whole - empty) / max(written, 1) * seconds * bench.rate
