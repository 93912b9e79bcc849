"""NI's client package nidaqmx, connected to a virtual rig in this process: tasks, inputs and outputs for tests."""

import contextlib

import nidaqmx
import pytest
from nidaqmx.errors import DaqError

import daq

RATE = 5120.0  # Hz
_connected = []

reads_waveforms = pytest.mark.skipif(
    not hasattr(nidaqmx.Task, "read_waveform"), reason="this client is older than waveforms"
)


def connect(scene, clock="fast"):
    """Connect an instrument to a scene for all later tasks, in place of the previous one; return its chassis."""
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


def add_inputs(task, channels="Dev1/ai0", **timing):
    """Add voltage inputs to a task, with a sample clock if `timing` is given."""
    task.ai_channels.add_ai_voltage_chan(channels, min_val=-500.0, max_val=500.0)
    if timing:
        task.timing.cfg_samp_clk_timing(RATE, **timing)
    return task


def add_output(task, volts, **timing):
    """Add an output with a sample clock to a task, and write its samples, V."""
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
    task.timing.cfg_samp_clk_timing(RATE, **timing)
    task.write(volts)
    return task


@contextlib.contextmanager
def raises_code(code, hint="", kind=DaqError, samples=None):
    """Expect the driver's error of that code, with a hint in its text, after a number of samples per channel."""
    with pytest.raises(kind) as caught:
        yield
    assert caught.value.error_code == code
    assert hint in str(caught.value)
    if samples is not None:
        direction = "written" if kind is nidaqmx.errors.DaqWriteError else "read"
        assert getattr(caught.value, f"samps_per_chan_{direction}") == samples


def pass_samples(chassis, samples, rate=RATE):
    """Advance the bench by a number of samples at a rate."""
    chassis.advance(round(samples * chassis.rate / rate))
