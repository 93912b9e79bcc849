"""A device that plays volts from a queue on the virtual bench of a scene, as nidaqmx does on hardware."""

from typing import Any

import numpy as np

import rig
from daq.core.excitation import Station, excitation
from daq.core.measurement.device_loop import run_on_device
from daq.core.virtual_bench.bench import Bench
from rig.core.base.arrays import Array
from rig.core.scene.shaker import DRIVE_PER_VOLT

Markers = list[tuple[str, int, int, dict[str, Any]]]


def run_device(scene: rig.Scene, queued: int, played: list[Array] | None = None) -> Markers:
    """Run the test of a scene on a device with a queue; return its markers, and append the volts to `played`."""
    bench = Bench(scene)
    queue, markers = np.zeros((len(bench.inputs), 0)), Markers()

    def write(volts: Array) -> None:
        nonlocal queue
        queue = np.concatenate([queue, volts], axis=1)
        if played is not None:
            played.append(volts)

    def read(samples: int) -> Array:
        nonlocal queue
        drive, queue = queue[:, :samples], queue[:, samples:]
        factor = np.array([[DRIVE_PER_VOLT[unit]] for unit in bench.drive_units])
        return bench.to_units(bench.acquire(drive * factor).samples)

    def mark(kind: str, first: int, stop: int, **fields: Any) -> None:
        markers.append((kind, first, stop, fields))

    station = Station(scene, bench.channels, bench.inputs, bench.rate, mark)
    run_on_device(excitation, station, read, write, queued)
    return markers
