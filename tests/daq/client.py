"""NI's client connected to a rig in this process."""

import nidaqmx
import pytest

import daq

_connected = []

reads_waveforms = pytest.mark.skipif(
    not hasattr(nidaqmx.Task, "read_waveform"), reason="this client is older than waveforms"
)


def connect(scene, clock="fast"):
    """Connect an instrument to a scene, in place of the previous one, and return its chassis."""
    while _connected:
        _connected.pop().close()
    _connected.append(daq.connect(scene, clock=clock))
    return _connected[0].chassis


def options():
    """Return the session options of the connected rig."""
    return _connected[0]


class Task(nidaqmx.Task):
    """A task on the rig that was connected last."""

    def __init__(self, name=""):
        super().__init__(name, grpc_options=options())


def pass_samples(chassis, samples, rate=5120.0):
    """Advance the bench by a number of samples at a rate."""
    chassis.advance(round(samples * chassis.rate / rate))
