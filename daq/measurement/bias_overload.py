"""Whether a sensor's bias alone drives an input into overload, with nothing moving."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rig.scene.presets import filled_in

if TYPE_CHECKING:
    from rig.scene.scene import Scene

# Longer ago than this, a bias is taken to be where it was then, s.
_LONGEST = 60.0


def bias_overload(scene: Scene, row: int, seconds: float) -> str | None:
    """Say that a bias overloads an input, and what to do; None where it does not.

    It is tried out: the bench is switched on and left at rest for as long.

    Parameters
    ----------
    row : int
        Number of the channel, from 0.
    seconds : float
        Time since the bench was switched on, s.
    """
    from daq.bench.bench import Bench

    channel = None if scene.channels is None else scene.channels[row]
    if channel is None or channel.accelerometer is None:
        return None
    sensor = filled_in(channel.accelerometer)
    if not sensor.bias:
        return None
    bench = Bench(scene)
    still, overloaded = np.zeros((len(bench.inputs), max(1, round(bench.rate)))), False
    # One second at a time; the last one counts.
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
