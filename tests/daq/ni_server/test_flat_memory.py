"""The server stores nothing of tasks and connections that clients have closed."""

import gc
from itertools import pairwise

import nidaqmx
from nidaqmx.constants import AcquisitionType

import daq
from daq.extras.ni_server.client_defaults import open_channel
from tests.daq.client import RATE

# The bench stores its motion of the last 2 s, which these tasks exceed.
TASKS, SAMPLES = 40, 1024


def acquire(rig):
    """Connect a client, acquire with a task, and disconnect."""
    with (
        open_channel(rig.address) as channel,
        nidaqmx.Task(grpc_options=nidaqmx.GrpcSessionOptions(channel, "")) as task,
    ):
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0", min_val=-500.0, max_val=500.0)
        task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.FINITE, samps_per_chan=SAMPLES)
        task.read(SAMPLES)


def count_objects():
    """Return the number of objects that the garbage collector tracks."""
    gc.collect()
    return len(gc.get_objects())


def test_closed_connections_leave_no_objects():
    with daq.connect("bare-structure", clock="fast") as rig:
        counts = []
        for _ in range(4):
            for _ in range(TASKS):
                acquire(rig)
            counts.append(count_objects())
    # A leak adds objects in each round; the server's pool of threads grows in some rounds only.
    assert min(later - earlier for earlier, later in pairwise(counts)) < TASKS
