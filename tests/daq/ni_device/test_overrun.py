"""A full input buffer of 1000 samples: overwritten samples are reported, or the acquisition stops."""

import re

import pytest
from nidaqmx.constants import AcquisitionType, OverwriteMode
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.errors import DaqReadError

from daq.extras.ni_device.clock import ManualClock
from tests.daq.client import Task, add_inputs, connect, pass_samples, raises_code


@pytest.fixture
def chassis():
    return connect("bare-structure", ManualClock())


def start_acquisition(task):
    """Start continuous acquisition into a buffer of 1000 samples."""
    add_inputs(task, sample_mode=AcquisitionType.CONTINUOUS)
    task.in_stream.input_buf_size = 1000
    task.start()


def test_overrun_is_counted_and_reading_continues(chassis):
    with Task() as task:
        start_acquisition(task)
        pass_samples(chassis, 1300)  # 300 more than the buffer
        with raises_code(Code.SAMPLES_NO_LONGER_AVAILABLE, "300 samples", kind=DaqReadError):
            task.read(100)
        assert task.in_stream.curr_read_pos == 300
        assert len(task.read(1000)) == 1000
        pass_samples(chassis, 10)
        assert len(task.read(10)) == 10
        assert not task.is_task_done()


@pytest.mark.parametrize("block_size", [1, 999])
def test_full_buffer_overflows_at_each_delay(chassis, block_size):
    with Task() as task:
        start_acquisition(task)
        pass_samples(chassis, 2600)
        for number in range(3):
            with raises_code(Code.SAMPLES_NO_LONGER_AVAILABLE, kind=DaqReadError):
                task.read(1)
            assert task.in_stream.avail_samp_per_chan == 1000
            assert task.in_stream.curr_read_pos == 1600 + number * block_size
            pass_samples(chassis, block_size)


def test_every_loss_is_counted_once(chassis):
    with Task() as task:
        start_acquisition(task)
        n_read = n_lost = 0
        for _ in range(40):
            pass_samples(chassis, 400)
            try:
                n_read += len(task.read(100))
            except DaqReadError as error:
                n_lost += int(re.search(r"(\d+) samples per channel were overwritten", str(error))[1])
            assert task.in_stream.curr_read_pos == n_read + n_lost
        assert n_lost > 0


def test_full_buffer_without_overwriting_stops(chassis):
    with Task() as task:
        task.in_stream.overwrite = OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES
        start_acquisition(task)
        pass_samples(chassis, 1400)
        assert len(task.read(1000)) == 1000
        with raises_code(Code.ACQ_STOPPED_TO_PREVENT_INPUT_BUFFER_OVERWRITE, kind=DaqReadError):
            task.read(1)
