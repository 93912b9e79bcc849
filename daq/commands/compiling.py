"""Compilation of the machine code of the simulation and of the measuring chain in advance, in two processes."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from daq.core.signal_chain.chain import Chain
from rig.core.scene.loading import load
from rig.core.simulation.motion import Motion

_POINTS = [f"body {number}" for number in (1, 2, 3)] + ["table"]
# A sensor with limits and noise; converters with and without a decimation filter.
_ACCELEROMETER = {"noise": 1e-5, "noise_corner": 10.0, "saturation": 10.0, "overload_recovery": 0.1, "resonance": 3e4}
_CHANNEL = {
    "accelerometer": {**_ACCELEROMETER, "bias": 1.0, "bias_settling": 1.0},
    "integrator": {"order": 2, "corner": 1.0},
}
_CONVERTERS = ({"rate": 5120.0, "skew": 1e-6}, {"rate": 5120.0, "filter": "delta_sigma"})


def warm_up() -> None:
    """Compile all kernels (compiled functions) now, on two processors so that later calls need not wait.

    The first call takes about a minute; later calls take some seconds, until shotrig, numba or the processor change.
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
        for variant in (limited, scene):
            Chain(variant, variant.converter.sample_rate, _POINTS, ("shaker",)).measure(_impact())


def _impact() -> Motion:
    """Return a block of motion with one discontinuity (jump of velocity), in which the sensors reach their limits."""
    samples, rows = 64, len(_POINTS)
    zeros = np.zeros((rows, samples))
    return Motion(
        first=0, displacement=zeros, velocity=zeros, acceleration=zeros + 1e3 * (np.arange(samples) > 32),
        gap=zeros[:3], contact=np.zeros((3, samples), dtype=np.int8), discontinuity_sample=np.array([8]),
        discontinuity_offset=np.array([1e-4]), discontinuity_displacement=np.zeros((rows, 1)),
        discontinuity_velocity=np.ones((2, rows, 1)), discontinuity_acceleration=np.zeros((2, rows, 1)),
        events=np.zeros(0),
    )  # fmt: skip
