"""A device that plays volts from a queue on the virtual bench of a scene, as nidaqmx does on hardware."""

from typing import Any

import numpy as np

import rig
from daq.core.excitation import Station, excitation
from daq.core.measurement.bench_loop import BenchLoop
from daq.core.measurement.device_loop import run_on_device
from daq.core.virtual_bench.bench import Bench, Block
from rig.core.base.arrays import Array
from rig.core.base.errors import RunError
from rig.core.scene.shaker import DRIVE_PER_VOLT

Markers = list[tuple[str, int, int, dict[str, Any]]]


class MarkedRun(BenchLoop):
    """A run on the bench that stores its markers and its drive."""

    def __init__(self, scene: rig.Scene) -> None:
        super().__init__(scene)
        self.markers: Markers = []
        self.drives: list[Array] = []
        self.reason = ""
        test = excitation(self.station)
        try:
            self.run_test(test, next(test))
        except RunError as error:
            self.reason = str(error)

    def mark(self, kind: str, first: int, stop: int, **fields: Any) -> None:
        self.markers.append((kind, first, stop, fields))

    def report(self, fraction: float, message: str) -> None:
        """Ignore the progress."""

    def on_block(self, block: Block, readings: Array) -> None:
        """Ignore the blocks."""

    def on_window(self, first: int, drive: Array, overload: Any) -> None:
        self.drives.append(drive)

    def of_kind(self, kind: str) -> list[dict[str, Any]]:
        """Return the fields of the markers of a kind."""
        return [fields for name, _, _, fields in self.markers if name == kind]


def run_device(scene: rig.Scene, queued: int) -> Markers:
    """Run the test of a scene on a device with a queue; return its markers."""
    bench = Bench(scene)
    queue, markers = np.zeros((len(bench.inputs), 0)), Markers()

    def write(volts: Array) -> None:
        nonlocal queue
        queue = np.concatenate([queue, volts], axis=1)

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
