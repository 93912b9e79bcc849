"""How fast the measurement chain is, effect by effect and as a whole: `python -m tests.benchmarks.chain`.

CPU time of one thread; set OPENBLAS_NUM_THREADS=1, or idle threads of a linear algebra library count as well.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import rig
from daq.recording.recorder import Recorder
from daq.signal_chain.chain import Chain
from daq.signal_chain.converter import Quantiser
from daq.virtual_bench.bench import Bench
from rig.scene.scene import Scene
from rig.simulation.plant import Plant

RATE, SECONDS, BLOCK = 51200.0, 4, 5120
# A recording takes some 10 ms to begin and to end, which is not what is asked for here.
RECORDED_SECONDS = 20
PLACES = ("body 1", "body 2", "body 3", "table")

# Each step adds to the accelerometer, the integrator or the converter of those before it.
LADDER: tuple[tuple[str, dict[str, Any], dict[str, Any] | None, dict[str, Any]], ...] = (
    ("ideal", {}, None, {}),
    ("resonance, low cut-off", {"resonance": "30 kHz", "low_cutoff": "0.5 Hz"}, None, {}),
    ("integrator", {}, {"order": 2, "corner": "1 Hz", "gain": 1000.0, "low_cutoff": "0.5 Hz"}, {}),
    ("24 bits", {}, {}, {"bits": 24, "range": "5 V"}),
    (
        "tolerance, temperature, transverse",
        {
            "sensitivity": "100 mV/g",
            "sensitivity_tolerance": "5 %",
            "temperature_drift": "0.05 %/K",
            "temperature_change": "10 K",
            "transverse": "3 %",
        },
        {},
        {},
    ),
    (
        "saturation, recovery",
        {"saturation": "50 g", "overload_recovery": "10 ms"},
        {"saturation": "12 V"},
        {},
    ),
    ("bias, settling", {"bias": "10 V", "bias_settling": "2 s"}, {}, {}),
    ("white noise", {"noise": "20 ug/sqrt(Hz)"}, {"noise": "50 nV/sqrt(Hz)"}, {"noise": "50 nV/sqrt(Hz)"}),
    ("1/f noise", {"noise_corner": "10 Hz"}, {}, {}),
    ("AC coupling", {}, {}, {"coupling": "AC"}),
    ("decimation filter", {}, {}, {"filter": "delta_sigma"}),
    ("skew", {}, {}, {"skew": "1 us"}),
    ("jitter, clock error", {}, {}, {"jitter": "1 ns", "clock_error": "10 ppm"}),
)


def steps(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Give the scene with ever more effects."""
    sensor: dict[str, Any] = {}
    integrator: dict[str, Any] | None = None
    converter: dict[str, Any] = {"rate": RATE}
    for name, to_sensor, to_integrator, to_converter in LADDER:
        sensor, converter = sensor | to_sensor, converter | to_converter
        if to_integrator is not None:
            integrator = (integrator or {}) | to_integrator
        channels = [
            {"name": place.replace(" ", ""), "at": place, "accelerometer": sensor, "integrator": integrator}
            for place in PLACES
        ]
        yield name, scene.replace(channels=channels, converter=converter)


def full_scene() -> Scene:
    """Give three dampers and an electrodynamic shaker, measured with every effect the product has."""
    return [step for _, step in steps(rig.load("fig8-three-dampers"))][-1]


def measure() -> Iterator[str]:
    """Yield a line for each step: time per channel and sample, and how many times real time four channels run."""
    scene = rig.load("fig8-three-dampers")
    for name, step in steps(scene):
        rate = step.converter.true_rate
        best = np.inf
        # The first pass compiles.
        for _ in range(4):
            plant = Plant(step, rate)
            chain = Chain(step, rate, plant.points, plant.inputs)
            converter = Quantiser(step.converter)
            took, breaks = 0.0, 0
            for first in range(0, round(SECONDS * RATE), BLOCK):
                drive = 3.0 * np.sin(2 * np.pi * 34.8 / RATE * np.arange(first, first + BLOCK))[None]
                motion = plant.advance(drive)
                breaks += motion.break_sample.size
                began = time.process_time()
                converter.convert(chain.measure(motion, drive))
                took += time.process_time() - began
            best = min(best, took)
        each = best / (SECONDS * RATE * len(PLACES))
        yield (
            f"{name:36s} {each * 1e9:6.1f} ns per channel and sample, {SECONDS / best:5.0f} times real time, "
            f"{breaks / SECONDS:.0f} breaks a second"
        )
    scene = full_scene()
    for name, display in (("all, and recorded", False), ("all, recorded with display", True)):
        took = min(record(scene.replace(recording={"display": display})) for _ in range(4))
        yield f"{name:36s} motion and all: {RECORDED_SECONDS / took:5.1f} times real time"


def record(scene: Scene) -> float:
    """Run a bench and record what it gives; give the CPU time that takes, s."""
    bench = Bench(scene)
    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        with Recorder(Path(folder) / "chain.mcap", scene, bench.channels, bench.rate) as recorder:
            for first in range(0, round(RECORDED_SECONDS * RATE), BLOCK):
                drive = 3.0 * np.sin(2 * np.pi * 34.8 / RATE * np.arange(first, first + BLOCK))[None]
                recorder.write(bench.acquire(drive).samples)
        return time.process_time() - began


if __name__ == "__main__":
    for line in measure():
        print(line)
