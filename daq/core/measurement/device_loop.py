"""The test of a scene on any device that plays volts and returns readings, such as NI hardware with nidaqmx.

A device outputs samples from a queue. A new drive therefore takes effect only after the samples that wait in the queue.
The readings of a window begin earlier than its drive, as with the delay of a converter's filter (`Station.latency`).
"""

from collections.abc import Callable

import numpy as np

from daq.core.excitation.station import AbortedTest, Excitation, Station
from daq.core.measurement.bench_loop import RAMP_S, ramp_down
from rig.core.base.arrays import Array
from rig.core.scene.shaker import DRIVE_PER_VOLT


def run_on_device(
    excite: Callable[[Station], Excitation],
    station: Station,
    read: Callable[[int], Array],
    write: Callable[[Array], None],
    queued: int = 0,
) -> None:
    """Run a test on a device.

    Parameters
    ----------
    excite : callable
        Function that returns the test of a station, such as `daq.core.excitation.excitation`.
    station : Station
        Scene, channels, sample rate, and the functions that receive marks, progress and warnings.
    read : callable
        ``read(n)`` returns the next n readings in the units of the channels, shape (channels, n).
    write : callable
        Appends volts of the outputs, shape (outputs, n), to the queue of the device.
    queued : int
        Number of samples that wait in the queue.

    Raises
    ------
    RunError
        If the test aborts; the drive has then been ramped to zero.
    """
    volts_per_drive = np.array([[1.0 / DRIVE_PER_VOLT[shaker.drive_unit]] for shaker in station.scene.shakers])
    station.latency += queued
    write(np.zeros((len(volts_per_drive), queued)))
    last = np.zeros((len(station.inputs), 2))
    test = excite(station)
    drive = next(test)

    def play(samples: Array) -> Array:
        nonlocal last
        write(samples[: len(volts_per_drive)] * volts_per_drive)
        last = np.concatenate([last, samples], axis=1)[:, -2:]
        readings = read(samples.shape[1])
        station.now += samples.shape[1]
        return readings

    try:
        while True:
            drive = test.send(play(drive))
    except StopIteration:
        play(np.repeat(last[:, -1:], station.latency, axis=1))
    except AbortedTest:
        play(ramp_down(last, station.samples(RAMP_S)))
        raise
    finally:
        test.close()
        write(np.zeros((len(volts_per_drive), queued)))
