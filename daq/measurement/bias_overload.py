"""Detection of inputs that the bias of a sensor overloads without motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rig.scene.presets import filled_in

if TYPE_CHECKING:
    from rig.scene.scene import Scene

# Longest simulated settling, s: a bias is assumed to be constant after this time.
_LONGEST = 60.0


def bias_overload(scene: Scene, row: int, seconds: float) -> str | None:
    """Return a message if, in a simulation at rest, a bias overloads an input `seconds` after power-on."""
    from daq.virtual_bench.bench import Bench

    channel = None if scene.channels is None else scene.channels[row]
    if channel is None or channel.accelerometer is None:
        return None
    sensor = filled_in(channel.accelerometer)
    if not sensor.bias:
        return None
    bench = Bench(scene)
    still, overloaded = np.zeros((len(bench.inputs), max(1, round(bench.rate)))), False
    # Simulate in blocks of one second; the last block decides.
    for _ in range(max(1, round(min(seconds, _LONGEST)))):
        overloaded = bool(bench.acquire(still).overload[row].any())
    if not overloaded:
        return None
    settling, behind = "", ""
    if sensor.bias_settling is not None:
        settling = f" (time constant {sensor.bias_settling:g} s)"
    cures = ["bias: 0 V in its accelerometer (a sensor that was switched on long before)"]
    if channel.integrator is not None:
        behind = " behind its integrator"
        cures.append("a low_cutoff of several hertz or less gain in the integrator")
    elif filled_in(scene.converter).coupling != "AC":
        cures.append("coupling: AC in the converter")
    return (
        f"with the shaker at rest the bias of its sensor, {sensor.bias:g} V{settling}, overloads it{behind} as well; "
        f"expected {', '.join(cures)}, or a larger converter range"
    )
