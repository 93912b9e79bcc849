"""Our side of the comparison: recordings, and what we make of them: `python -m tests.peers.ours FOLDER`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

import analysis
import daq
import rig
from analysis.exporting.export import export
from analysis.recordings.slices import Slice
from daq.recording.recording import Recording

BLOCK = 8.0
BODIES = ("body1", "body2", "body3")


def recorded(path: Path, shaker: dict[str, Any] | None, test: dict[str, Any], other: dict[str, Any]) -> Recording:
    """Record the structure without dampers, with sensors that add noise and nothing else."""
    sensor = {"sensitivity": 0.05, "noise": 2e-3}
    channels = [{"name": name, "at": f"body {name[-1]}", "accelerometer": sensor} for name in BODIES]
    scene = rig.load("fig4-structure").replace(
        shaker=shaker,
        test=test,
        channels=[*channels, other],
        converter={"rate": 2560.0, "bits": 24, "range": 10.0},
        recording={"display": False},
    )
    return daq.open(daq.record(scene, path, overwrite=True))


def estimators(folder: Path) -> dict[str, np.ndarray]:
    """Random noise from a table: windowed blocks of its channels, and the estimates we make of them."""
    shaker = {"kind": "table", "body": 1, "spring": 6600.0}
    test = {"kind": "random", "from": 5.0, "to": 70.0, "duration": 120.0, "force": 1.0}
    table = {"name": "table", "at": "table", "accelerometer": {"sensitivity": 0.05, "noise": 2e-3}}
    out: dict[str, np.ndarray] = {}
    with recorded(folder / "random.mcap", shaker, test, table) as rec:
        for estimator in ("H1", "H2", "Hv"):
            [curves] = analysis.frequency_responses(rec, BODIES, reference="table", estimator=estimator, block=BLOCK)
            out[estimator] = np.stack([curve.value for curve in curves])
        out["coherence"] = np.stack([curve.coherence for curve in curves])
        out["random_frequency"] = curves[0].frequency
        [marker] = [marker for marker in rec.markers if marker.kind == "measure"]
        size = int(BLOCK * rec.rate)
        starts = range(marker.first_sample, marker.end + 2 - size, size // 2)
        blocks = np.stack([[rec.read(name, at, at + size) for name in (*BODIES, "table")] for at in starts])
        out["raw_blocks"] = blocks
        out["blocks"] = (blocks - blocks.mean(axis=2, keepdims=True)) * signal.get_window("hann", size)
        out["rate"] = np.array(rec.rate)
    return out


def poles(folder: Path) -> dict[str, np.ndarray]:
    """Hits with a hammer: accelerances, the modes we find in them, and the channels as a UFF file."""
    test = {"kind": "impulse", "body": 1, "peak": 100.0, "width": 4e-3, "repeats": 4, "interval": 16.0}
    hammer = {"name": "hammer", "at": "hammer", "hammer": {"sensitivity": 2e-3, "noise": 5e-3}}
    out: dict[str, np.ndarray] = {}
    with recorded(folder / "hits.mcap", None, test, hammer) as rec:
        [curves] = analysis.frequency_responses(rec, motion="acceleration")
        modes = analysis.identify(curves, count=3)
        export(Slice.of(rec), folder / "hits.uff", overwrite=True)
        for name in rec.channels:
            out[f"samples {name}"] = rec.read(name)
    out["hit_frequency"] = curves[0].frequency
    out["accelerance"] = np.stack([curve.value for curve in curves])
    out["pole_Hz"], out["pole_damping"], out["shapes"] = modes.frequency, modes.damping, modes.shapes
    return out


if __name__ == "__main__":
    place = Path(sys.argv[1])
    place.mkdir(parents=True, exist_ok=True)
    np.savez(place / "ours.npz", **estimators(place), **poles(place))  # type: ignore[arg-type]
