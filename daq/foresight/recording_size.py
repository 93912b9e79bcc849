"""Predicted size of a recording: a part of the rehearsal is written."""

from __future__ import annotations

import tempfile
from collections import deque
from dataclasses import dataclass, field, replace
from pathlib import Path

from daq.recording.recorder import Recorder
from daq.virtual_bench.bench import Bench
from daq.virtual_bench.stream import Block
from rig.scene.scene import Scene

# Duration of the end of a rehearsal that is written, s.
_KEPT_S = 4.0


@dataclass
class LastBlocks:
    """The blocks of the last seconds of a rehearsal, at least `most` samples."""

    most: float
    blocks: deque[Block] = field(default_factory=deque)
    samples: int = 0

    @classmethod
    def of(cls, rate: float) -> LastBlocks:
        """Keep the part of a rehearsal that is written, at a sample rate in Hz."""
        return cls(_KEPT_S * rate)

    def add(self, block: Block) -> None:
        """Take the next block, and drop blocks that are no longer needed."""
        self.blocks.append(block)
        self.samples += block.samples.shape[1]
        while self.samples - self.blocks[0].samples.shape[1] > self.most:
            self.samples -= self.blocks.popleft().samples.shape[1]


def recording_size(scene: Scene, bench: Bench, blocks: list[LastBlocks], seconds: float) -> float:
    """Estimate the size of the recording of a test of a duration in s from the last blocks of its parts, bytes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "size.mcap"
        written = 0
        with Recorder(path, scene, bench.channels, bench.rate) as recorder:
            empty = recorder.size
            for block in (block for part in blocks for block in part.blocks):
                if not block.samples.shape[1]:
                    continue
                if scene.recording.truth:
                    motion = replace(block.motion, first=written, events=block.motion.events[:0])
                    recorder.write_truth(motion)
                recorder.write(block.samples)
                written += block.samples.shape[1]
        whole = path.stat().st_size
    return empty + (whole - empty) / max(written, 1) * seconds * bench.rate
