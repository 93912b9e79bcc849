"""Behavior of NI's driver on which scripts for hardware rely: times, triggers, scales, saved tasks and logs."""

import numpy as np
import pytest
from nidaqmx import Scale
from nidaqmx.constants import (
    READ_ALL_AVAILABLE,
    AcquisitionType,
    LoggingMode,
    LoggingOperation,
    TriggerType,
    VoltageUnits,
)
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.errors import DaqError
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.system.storage import PersistedTask

import daq
from daq.extras.ni_device.clock import ManualClock
from tests.daq.client import RATE, Task, connect, options, pass_samples, raises_code, reads_waveforms


class WallClock(ManualClock):
    """A manual clock whose times count from 1970, as those of the real clock."""

    is_free_running = True


@pytest.fixture
def chassis():
    return connect("bare-structure", "fast")


def add_inputs(task, channels="cDAQ1Mod1/ai0", samples=100, **timing):
    """Add voltage inputs with a sample clock to a task."""
    task.ai_channels.add_ai_voltage_chan(channels, min_val=-500.0, max_val=500.0)
    task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=samples, **timing)
    return task


@reads_waveforms
def test_waveform_starts_at_wall_clock_time(monkeypatch):
    clock, now = WallClock(), [1_700_000_000 * 10**9]  # ns since 1970, in 2023
    monkeypatch.setattr("daq.extras.ni_device.chassis.time.time_ns", lambda: now[0])
    connect("bare-structure", clock)
    start_times = []
    for idle_s in (0, 3, 100):
        now[0] += idle_s * 10**9
        with add_inputs(Task()) as task:
            task.start()
            clock.advance(100 / RATE)
            waveform = task.read_waveform(100)
        start_times.append(waveform.timing.start_time)
        assert waveform.timing.sample_interval.total_seconds() == pytest.approx(1 / RATE, abs=1e-9)
    intervals = [(start_time - start_times[0]).total_seconds() for start_time in start_times]
    assert intervals == pytest.approx([0.0, 3.0, 103.0], abs=1e-6)
    assert start_times[0].year == 2023


def test_on_demand_output_allows_any_input_rate():
    connect("bare-structure", "fast")
    with Task() as constant_output, Task() as input_task:
        constant_output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        constant_output.start()
        add_inputs(input_task)
        input_task.timing.samp_clk_rate = 10240.0
        assert len(input_task.read(100)) == 100
        assert constant_output.write(0.5) == 1


def test_trigger_source_names_its_device(chassis):
    with add_inputs(Task()) as task:
        task.triggers.start_trigger.cfg_dig_edge_start_trig("PFI0")
        assert task.triggers.start_trigger.dig_edge_src == "/cDAQ1/PFI0"
        assert task.triggers.start_trigger.trig_type == TriggerType.DIGITAL_EDGE


def test_output_event_of_input_task_is_rejected(chassis):
    with Task() as task:
        add_inputs(task)
        with raises_code(Code.EVERY_N_SAMPS_TRANSFERRED_FROM_BUFFER_EVENT_NOT_SUPPORTED_BY_DEVICE):
            task.register_every_n_samples_transferred_from_buffer_event(10, print)


def test_custom_scale_scales_readings(chassis):
    Scale.create_lin_scale("double", slope=2.0, y_intercept=1.0, grpc_options=options())
    with Task() as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0", "plain", min_val=-500.0, max_val=500.0)
        task.ai_channels.add_ai_voltage_chan(
            "cDAQ1Mod1/ai0", "scaled", min_val=-500.0, max_val=500.0,
            units=VoltageUnits.FROM_CUSTOM_SCALE, custom_scale_name="double",
        )  # fmt: skip
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=50)
        plain, scaled = np.array(task.read(50))
    np.testing.assert_allclose(scaled, 2.0 * plain + 1.0, rtol=1e-12)


def test_window_trigger_starts_within_window(chassis):
    with add_inputs(Task(), "cDAQ1Mod1/ai3", sample_mode=AcquisitionType.FINITE) as task:
        pass_samples(chassis, 2000)
        task.triggers.start_trigger.cfg_anlg_window_start_trig(0.4, 0.1, "cDAQ1Mod1/ai3")
        assert 0.1 <= task.read(100)[0] <= 0.4


def test_saved_task_is_loaded_with_its_settings(chassis):
    with add_inputs(Task("mine")) as task:
        task.save(overwrite_existing_task=True)
    with PersistedTask("mine", grpc_options=options()).load() as task:
        assert task.timing.samp_clk_rate == RATE
        assert np.shape(task.read(READ_ALL_AVAILABLE)) == (100,)


def test_paused_log_continues_in_another_file(chassis, tmp_path):
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.in_stream.configure_logging(str(first), LoggingMode.LOG_AND_READ, operation=LoggingOperation.CREATE)
        task.start()
        first_samples = task.read(100)
        task.in_stream.logging_pause = True
        task.read(50)
        task.in_stream.logging_pause = False
        task.in_stream.start_new_file(str(second))
        second_samples = task.read(70)
        task.stop()
    for path, expected in ((first, first_samples), (second, second_samples)):
        with daq.open(path) as recording:
            (channel,) = recording.channels.values()
            volts = recording.read(channel.name) * channel.sensitivity
        np.testing.assert_allclose(volts, expected, rtol=1e-9)


def test_start_trigger_time_is_known(chassis):
    with add_inputs(Task()) as task:
        trigger = task.triggers.start_trigger
        trigger.cfg_dig_edge_start_trig("/cDAQ1/PFI0")
        trigger.timestamp_enable = True
        task.read(READ_ALL_AVAILABLE)
        # The first pulse at the terminal PFI0 is 1 s after power-on.
        assert trigger.timestamp_val.timestamp() == pytest.approx(1.0, abs=1 / RATE)


def test_array_of_wrong_type_is_rejected(chassis):
    with add_inputs(Task()) as task, pytest.raises((TypeError, DaqError)):
        AnalogMultiChannelReader(task.in_stream).read_many_sample(np.zeros((1, 100), np.int32), 100)
