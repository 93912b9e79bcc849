"""Speed of the measurement chain (sensors and converter), with effects added one after another.

    python -m tests.benchmarks.chain

Times are CPU times of one thread. Set OPENBLAS_NUM_THREADS=1: otherwise idle threads of BLAS are included.
"""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rig
from daq.core.recording.recorder import Recorder
from daq.core.signal_chain.chain import Chain
from daq.core.signal_chain.converter import Quantizer
from daq.core.virtual_bench.bench import Bench
from rig.core.scene.scene import Scene
from rig.core.simulation.plant import Plant

RATE = 51200.0  # samples per second
SECONDS = 4
BLOCK_SAMPLES = 5120
# Long enough that the 10 ms for opening and closing a recording are negligible.
RECORDED_SECONDS = 20
LOCATIONS = ("body 1", "body 2", "body 3", "table")

# Effects added by each step: their name, and the keys added to accelerometer, integrator and converter.
EFFECT_STEPS: tuple[tuple[str, dict[str, Any], dict[str, Any] | None, dict[str, Any]], ...] = (
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
    ("saturation, recovery", {"saturation": "50 g", "overload_recovery": "10 ms"}, {"saturation": "12 V"}, {}),
    ("bias, settling", {"bias": "10 V", "bias_settling": "2 s"}, {}, {}),
    ("white noise", {"noise": "20 ug/sqrt(Hz)"}, {"noise": "50 nV/sqrt(Hz)"}, {"noise": "50 nV/sqrt(Hz)"}),
    ("1/f noise", {"noise_corner": "10 Hz"}, {}, {}),
    ("AC coupling", {}, {}, {"coupling": "AC"}),
    ("decimation filter", {}, {}, {"filter": "delta_sigma"}),
    ("skew", {}, {}, {"skew": "1 us"}),
    ("jitter, clock error", {}, {}, {"jitter": "1 ns", "clock_error": "10 ppm"}),
)


def scenes_with_effects(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Yield the name of the last added effect, and the scene with all effects up to it."""
    sensor: dict[str, Any] = {}
    integrator: dict[str, Any] | None = None
    converter: dict[str, Any] = {"rate": RATE}
    for name, sensor_keys, integrator_keys, converter_keys in EFFECT_STEPS:
        sensor, converter = sensor | sensor_keys, converter | converter_keys
        if integrator_keys is not None:
            integrator = (integrator or {}) | integrator_keys
        channels = [
            {"name": location.replace(" ", ""), "at": location, "accelerometer": sensor, "integrator": integrator}
            for location in LOCATIONS
        ]
        yield name, scene.replace(channels=channels, converter=converter)


def full_scene() -> Scene:
    """Return a scene with three dampers and an electrodynamic shaker, measured with all effects."""
    *_, (_, scene) = scenes_with_effects(rig.load("fig8-three-dampers"))
    return scene


def tone_block(first: int) -> NDArray[np.float64]:
    """Return a block of the drive voltage that begins at a sample: 3 V at 34.8 Hz, near the second mode."""
    return 3.0 * np.sin(2 * np.pi * 34.8 / RATE * np.arange(first, first + BLOCK_SAMPLES))[None]


def measure() -> Iterator[str]:
    """Yield a line for each added effect: time per channel and sample, and speed of four channels in times real time.

    A discontinuity is an instant between two samples at which a velocity or acceleration jumps.
    """
    for name, scene in scenes_with_effects(rig.load("fig8-three-dampers")):
        rate = scene.converter.true_rate
        shortest = np.inf
        # The first of four passes compiles; the shortest counts.
        for _ in range(4):
            plant = Plant(scene, rate)
            chain = Chain(scene, rate, plant.points, plant.inputs)
            converter = Quantizer(scene.converter)
            elapsed, discontinuities = 0.0, 0
            for first in range(0, round(SECONDS * RATE), BLOCK_SAMPLES):
                drive = tone_block(first)
                motion = plant.advance(drive)
                discontinuities += motion.discontinuity_sample.size
                start = time.process_time()
                converter.convert(chain.measure(motion, drive))
                elapsed += time.process_time() - start
            shortest = min(shortest, elapsed)
        per_sample = shortest / (SECONDS * RATE * len(LOCATIONS))
        yield (
            f"{name:36s} {per_sample * 1e9:6.1f} ns per channel and sample, {SECONDS / shortest:5.0f} times real time, "
            f"{discontinuities / SECONDS:.0f} discontinuities a second"
        )
    scene = full_scene()
    for name, display in (("all effects, recorded", False), ("all effects, recorded with display", True)):
        elapsed = min(recording_time(scene.replace(recording={"display": display})) for _ in range(4))
        yield f"{name:36s} simulation included: {RECORDED_SECONDS / elapsed:5.1f} times real time"


def recording_time(scene: Scene) -> float:
    """Run a bench, record its samples, and return the CPU time, s."""
    bench = Bench(scene)
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        with Recorder(Path(folder) / "chain.mcap", scene, bench.channels, bench.rate) as recorder:
            for first in range(0, round(RECORDED_SECONDS * RATE), BLOCK_SAMPLES):
                recorder.write(bench.acquire(tone_block(first)).samples)
        return time.process_time() - start


if __name__ == "__main__":
    for line in measure():
        print(line)
