"""NI's client on a rig in this process, for tests that were written as scripts are."""

import nidaqmx
import pytest

import daq

_connected = []

reads_waveforms = pytest.mark.skipif(
    not hasattr(nidaqmx.Task, "read_waveform"), reason="this client is older than waveforms"
)


def connect(scene, clock="fast"):
    """Put an instrument in front of a scene, in place of the one before; give its chassis."""
    while _connected:
        _connected.pop().close()
    _connected.append(daq.connect(scene, clock=clock))
    return _connected[0].chassis


def options():
    """Give the session options of the rig that is connected."""
    return _connected[0]


class Task(nidaqmx.Task):
    """A task on the rig that was connected last."""

    def __init__(self, name=""):
        super().__init__(name, grpc_options=options())


def pass_samples(chassis, samples, rate=5120.0):
    """Let the bench move on by so many samples at a rate."""
    chassis.advance(round(samples * chassis.rate / rate))
