"""Compile machine code ahead of its use, the engine's and the measuring chain's side by side."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from daq.signal_chain.chain import Chain
from rig.scene.loading import load
from rig.simulation.motion import Motion

_POINTS = [f"body {number}" for number in (1, 2, 3)] + ["table"]
# Sensors with limits, delays and noise; without a decimation filter and with one.
_ACCELEROMETER = {
    "noise": 1e-5,
    "noise_corner": 10.0,
    "saturation": 10.0,
    "overload_recovery": 0.1,
    "resonance": 3e4,
}
_CHANNEL = {
    "accelerometer": {**_ACCELEROMETER, "bias": 1.0, "bias_settling": 1.0},
    "integrator": {"order": 2, "corner": 1.0},
}
_CONVERTERS = ({"rate": 5120.0, "skew": 1e-6}, {"rate": 5120.0, "filter": "delta_sigma"})


def warm_up() -> None:
    """Compile all kernels now, on two processors: after that nothing waits for it.

    It takes about a minute once for each version of shotrig, numba and the processor, and else some seconds.
    """
    rig_part = subprocess.Popen([sys.executable, "-c", "import rig; rig.warm_up()"])
    try:
        _warm_up_chain()
    finally:
        rig_part.wait()


def _warm_up_chain() -> None:
    scene = load("fig8-three-dampers")
    channels = [{"name": point.replace(" ", ""), "at": point, **_CHANNEL} for point in _POINTS]
    for converter in _CONVERTERS:
        limited = scene.replace(channels=channels, converter=converter)
        for each in (limited, scene):
            Chain(each, each.converter.sample_rate, _POINTS, ("shaker",)).measure(_impact())


def _impact() -> Motion:
    """Give a block with one break, in which the sensors reach their limits."""
    count, rows = 64, len(_POINTS)
    rest = np.zeros((rows, count))
    return Motion(
        first=0, displacement=rest, velocity=rest, acceleration=rest + 1e3 * (np.arange(count) > 32),
        gap=rest[:3], contact=np.zeros((3, count), dtype=np.int8), break_sample=np.array([8]),
        break_offset=np.array([1e-4]), break_displacement=np.zeros((rows, 1)),
        break_velocity=np.ones((2, rows, 1)), break_acceleration=np.zeros((2, rows, 1)), events=np.zeros(0),
    )  # fmt: skip
