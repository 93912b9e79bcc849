"""Errors have the codes and texts of NI's driver, and name the remedy.

Hints are parts of messages.
"""

import importlib
import re

import nidaqmx
import numpy as np
import pytest
from nidaqmx._grpc_interpreter import _ERROR_MESSAGES
from nidaqmx.constants import (
    AccelSensitivityUnits,
    AcquisitionType,
    Edge,
    RegenerationMode,
    TaskMode,
    TerminalConfiguration,
    VoltageUnits,
)
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.error_codes import DAQmxWarnings
from nidaqmx.errors import DaqError, DaqReadError, DaqResourceWarning, DaqWriteError

import rig
from daq.extras.ni_device.clock import ManualClock
from daq.extras.ni_server.calls.handlers import handler_of, script_function
from daq.extras.ni_server.protocol import methods
from tests.daq.client import RATE, Task, add_inputs, connect, options, pass_samples, raises_code


@pytest.fixture
def chassis():
    return connect("bare-structure", ManualClock())


def test_finished_task_gives_remaining_samples(chassis):
    with add_inputs(Task(), samps_per_chan=100) as task:
        task.start()
        pass_samples(chassis, 100)
        assert len(task.read(150)) == 100
        with raises_code(Code.SAMPLES_WILL_NEVER_BE_AVAILABLE, kind=DaqReadError, samples=0):
            task.read(1)


def test_dropped_samples_end_task_until_restart():
    scene = rig.load("bare-structure")
    # At 0.1 s, sample 512 of the task, the device loses 256 samples.
    dropped = {"at": "0.1 s", "samples": 256}
    scene = scene.replace(converter=scene.converter.replace(dropped_blocks=[dropped]))
    chassis = connect(scene, ManualClock())
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        pass_samples(chassis, 1000)
        with raises_code(Code.INPUT_FIFO_OVERFLOW_2, kind=DaqReadError, samples=512):
            task.read(1000)
        task.stop()
        task.start()
        pass_samples(chassis, 100)
        assert len(task.read(100)) == 100


def test_long_delay_of_machine_overflows_inputs(chassis):
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        # Delays relative to real time, s; up to 5 s are tolerated.
        assert not chassis.report_delay(1.0)
        assert chassis.report_delay(6.0)
        with raises_code(Code.INPUT_FIFO_OVERFLOW_2, "fast clock", kind=DaqReadError):
            task.read(1)


def start_output(task):
    """Start an output of 0.5 V that fails after 100 samples unless more are written."""
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
    task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
    task.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
    task.write(np.full(100, 0.5))
    task.start()


def test_error_of_full_buffer_names_its_cause(chassis):
    with Task() as task:
        start_output(task)
        with raises_code(Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN, "the timeout has expired", kind=DaqWriteError):
            task.write(np.zeros(50), timeout=-1.0)
        task.stop()
        task.out_stream.output_buf_size = 100
        with raises_code(Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN, "the task is not running", kind=DaqWriteError):
            task.write(np.zeros(150), timeout=-1.0)


def test_exhausted_output_buffer_is_reported_until_stop(chassis):
    with Task() as task:
        start_output(task)
        with raises_code(Code.SAMPLES_CAN_NOT_YET_BE_WRITTEN, kind=DaqWriteError, samples=0):
            task.write(np.zeros(50), timeout=1.0)
        pass_samples(chassis, 150)
        for call in (task.is_task_done, lambda: task.write(np.zeros(50)), task.is_task_done) * 2:
            with raises_code(Code.GEN_STOPPED_TO_PREVENT_REGEN_OF_OLD_SAMPLES):
                call()
        assert chassis.last_volts[0] == 0.5
        task.stop()
        assert task.is_task_done()
        assert task.write(np.zeros(50)) == 50


def test_exhausted_output_buffer_is_reported_on_stop(chassis):
    with Task() as task:
        start_output(task)
        pass_samples(chassis, 150)
        with raises_code(Code.GEN_STOPPED_TO_PREVENT_REGEN_OF_OLD_SAMPLES):
            task.stop()


def test_running_task_rejects_settings(chassis):
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        for change in (
            lambda: task.timing.cfg_samp_clk_timing(100.0),
            lambda: setattr(task.timing, "samp_clk_rate", 6000.0),
            lambda: task.ai_channels.add_ai_voltage_chan("Dev1/ai1"),
            lambda: setattr(task.ai_channels[0], "ai_max", 1.0),
            lambda: setattr(task.in_stream, "input_buf_size", 10),
            lambda: task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI0"),
            task.start,
            lambda: task.register_every_n_samples_acquired_into_buffer_event(10, print),
        ):
            with pytest.raises(DaqError) as caught:
                change()
            assert caught.value.error_code in (
                Code.CANNOT_SET_PROPERTY_WHEN_TASK_RUNNING,
                Code.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING,
                Code.CANNOT_REGISTER_DA_QMX_SOFTWARE_EVENT_WHILE_TASK_IS_RUNNING,
            )
            assert "stop()" in str(caught.value)


@pytest.mark.parametrize(
    "name, code, hint",  # hint: part of the message that names existing channels, or the wrong value
    [
        ("Nothing/ai0", Code.INVALID_DEVICE_ID, "cDAQ1Mod1"),
        ("Dev1/ai4", Code.PHYSICAL_CHAN_DOES_NOT_EXIST, "Dev1/ai3"),
        ("Dev1/xy0", Code.PHYSICAL_CHAN_DOES_NOT_EXIST, "ao0"),
        ("Dev1", Code.PHYSICAL_CHAN_DOES_NOT_EXIST, "cDAQ1Mod1/ai0"),
        ("Dev1/ai0:x", Code.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING, "Dev1/ai0:3"),
        ("Dev1/ai0:99999999", Code.INVALID_RANGE_OF_OBJECTS_SYNTAX_IN_STRING, "100000000"),
    ],
)
def test_error_of_missing_channel_names_existing_channels(chassis, name, code, hint):
    with Task() as task, raises_code(code, hint):
        task.ai_channels.add_ai_voltage_chan(name, min_val=-1.0, max_val=1.0)


def test_repeated_output_has_code_of_hardware(chassis):
    with Task() as task:
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0", "one")
        with raises_code(Code.REPEATED_PHYSICAL_CHAN, "Add each output only once"):
            task.ao_channels.add_ao_voltage_chan("Dev1/ao0", "two")


def test_inverted_limits_are_rejected_at_start(chassis):
    with Task() as task:
        channel = task.ai_channels.add_ai_voltage_chan("Dev1/ai0", min_val=10.0, max_val=-10.0)
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=10)
        with raises_code(Code.MIN_NOT_LESS_THAN_MAX, "the lower limit 10 is not below the upper limit -10"):
            task.start()
        channel.ai_min, channel.ai_max = -10.0, 10.0
        task.start()


def test_channel_limits_are_rejected_or_coerced():
    connect("fig8-three-dampers", ManualClock())
    with Task() as task:
        with raises_code(Code.INVALID_ATTRIBUTE_VALUE, "-50 to 50 g"):
            task.ai_channels.add_ai_accel_chan("Dev1/ai0", min_val=-100.0, max_val=100.0, sensitivity=100.0)
        channel = task.ai_channels.add_ai_accel_chan("Dev1/ai0", sensitivity=100.0)
        assert (channel.ai_min, channel.ai_max) == pytest.approx((-50.0, 50.0))
        assert channel.ai_rng_high == 5.0


@pytest.mark.parametrize("rate", [0.0, -1.0, 96000.0])
def test_impossible_rate_is_rejected(chassis, rate):
    with add_inputs(Task()) as task, raises_code(Code.INVALID_ATTRIBUTE_VALUE, "51200"):
        task.timing.cfg_samp_clk_timing(rate)


@pytest.mark.parametrize(
    "call, hint",
    [
        (lambda task: task.ai_channels.add_ai_accel_chan("Dev1/ai1", units=VoltageUnits.VOLTS), "m/s^2"),
        (
            lambda task: task.ai_channels.add_ai_force_iepe_chan(
                "Dev1/ai1", sensitivity_units=AccelSensitivityUnits.MILLIVOLTS_PER_G
            ),
            "mV/N",
        ),
        (
            lambda task: task.ai_channels.add_ai_voltage_chan("Dev1/ai1", terminal_config=TerminalConfiguration.RSE),
            "PSEUDO_DIFF",
        ),
        (lambda task: task.ai_channels.add_ai_accel_chan("Dev1/ai1", max_val=np.inf), "-5 to inf"),
        (lambda task: task.timing.cfg_samp_clk_timing(RATE, sample_mode=Edge.RISING), "CONTINUOUS"),
        (lambda task: task.timing.cfg_samp_clk_timing(np.nan), "samp_clk_rate is nan"),
        (lambda task: setattr(task.in_stream, "overwrite", Edge.RISING), "NOT_ALLOWED"),
        (lambda task: setattr(task.out_stream, "regen_mode", Edge.RISING), "ALLOWED"),
        (
            lambda task: task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0", trigger_level=np.nan),
            "lvl is nan",
        ),
        (lambda task: task.wait_until_done(np.nan), "timeout is nan"),
        (lambda task: task.read(10, timeout=np.nan), "timeout is nan"),
    ],
)
def test_error_of_invalid_value_names_valid_values(chassis, call, hint):
    with add_inputs(Task()) as task, raises_code(Code.INVALID_ATTRIBUTE_VALUE, hint):
        call(task)


def test_excessive_samples_are_rejected(chassis):
    with add_inputs(Task(), samps_per_chan=10**13) as task, raises_code(Code.INVALID_ATTRIBUTE_VALUE, "memory"):
        task.start()


@pytest.mark.parametrize("timeout", [-1.0, np.inf])
def test_infinite_timeout_waits_for_task(timeout):
    connect("bare-structure", "fast")
    with add_inputs(Task(), samps_per_chan=512) as task:
        task.start()
        task.wait_until_done(timeout)
        assert task.is_task_done()


@pytest.mark.parametrize("sensitivity", [0.0, -100.0, 1e-310, np.inf, np.nan])
def test_invalid_sensitivity_does_not_replace_valid_sensitivity(chassis, sensitivity):
    with Task() as task:
        with raises_code(Code.INVALID_ATTRIBUTE_VALUE, "sensitivity"):
            task.ai_channels.add_ai_accel_chan("Dev1/ai0", sensitivity=sensitivity)
        channel = task.ai_channels.add_ai_accel_chan("Dev1/ai0", sensitivity=100.0)
        with raises_code(Code.INVALID_ATTRIBUTE_VALUE):
            channel.ai_accel_sensitivity = sensitivity
        assert channel.ai_accel_sensitivity == 100.0
        task.timing.cfg_samp_clk_timing(RATE)
        task.start()
        pass_samples(chassis, 5)
        assert len(task.read(5)) == 5


def test_error_of_used_module_names_its_task(chassis):
    with Task("mine") as first, Task("yours") as second:
        add_inputs(first, "Dev1/ai0", sample_mode=AcquisitionType.CONTINUOUS)
        add_inputs(second, "Dev1/ai1", sample_mode=AcquisitionType.CONTINUOUS)
        first.start()
        with raises_code(Code.PAL_RESOURCE_RESERVED, "'mine'"):
            second.start()
        first.stop()
        second.start()


def test_invalid_calls_have_codes_of_driver(chassis):
    def code(call, *arguments):
        """Return the error code of a call that must fail."""
        with pytest.raises(DaqError) as caught:
            call(*arguments)
        return caught.value.error_code

    with Task() as without_channels, Task() as input_task, Task() as output_task:
        assert code(without_channels.start) == Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK
        assert code(without_channels.read) == Code.CAN_NOT_PERFORM_OP_WHEN_NO_CHANS_IN_TASK
        add_inputs(input_task, sample_mode=AcquisitionType.CONTINUOUS)
        input_task.in_stream.auto_start = False
        assert code(input_task.read, 10) == Code.CANNOT_READ_WHEN_AUTO_START_FALSE_AND_TASK_NOT_RUNNING_OR_COMMITTED
        assert code(lambda: input_task.in_stream.overloaded_chans) == Code.OVERLOADED_CHANS_EXIST_NOT_READ
        output_task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        output_task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=10)
        assert code(output_task.start) == Code.OUTPUT_BUFFER_EMPTY
        assert code(output_task.write, np.zeros((2, 10))) == Code.WRITE_NUM_CHANS_MISMATCH
        assert code(output_task.write, [0.0, 11.0]) == Code.INVALID_AO_DATA_WRITE
        assert code(output_task.write, [0.0, np.nan]) == Code.INVALID_AO_DATA_WRITE
        output_task.write(np.zeros(10))
        output_task.start()
        assert code(output_task.wait_until_done, 0.1) == Code.WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE
        assert (
            code(output_task.ai_channels.add_ai_voltage_chan, "Dev1/ai0") == Code.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING
        )
        pass_samples(chassis, 10)
    assert code(input_task.read, 1) == Code.INVALID_TASK


def test_offset_before_first_sample_is_rejected(chassis):
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        pass_samples(chassis, 100)
        task.read(20)
        task.in_stream.offset = -21
        with raises_code(Code.NEGATIVE_READ_SAMPLE_NUMBER, kind=DaqReadError):
            task.read(10)
        assert task.in_stream.curr_read_pos == 20


def test_unsupported_call_names_client_function(chassis):
    no_measurement, no_channel = Code.PHYS_CHAN_MEAS_TYPE, Code.PHYSICAL_CHAN_DOES_NOT_EXIST
    unsupported = Code.ATTRIBUTE_NOT_SUPPORTED_IN_TASK_CONTEXT
    with add_inputs(Task()) as task:
        for call, hint, code in (
            (lambda: task.ai_channels.add_ai_thrmcpl_chan("Dev1/ai1"), "add_ai_thrmcpl_chan", no_measurement),
            (lambda: task.ai_channels.add_ai_rtd_chan("Dev1/ai99"), "ai99", no_channel),
            (
                lambda: task.ai_channels.add_ai_bridge_chan("Dev1/ai1"),
                "does not support this measurement",
                no_measurement,
            ),
            (lambda: task.ai_channels.add_ai_pos_lvdt_chan("Dev1/ai1"), "does not support", no_measurement),
            (lambda: task.timing.ai_conv_rate, "ai_conv_rate", unsupported),
            (lambda: task.timing.cfg_handshaking_timing(), "cfg_handshaking_timing", unsupported),
            (lambda: task.ci_channels.add_ci_count_edges_chan("Dev1/ctr0"), "add_ci_count_edges_chan", no_channel),
            (lambda: task.di_channels.add_di_chan("Dev1/port0/line0"), "add_di_chan", no_channel),
            (lambda: task.di_channels.add_di_chan("nowhere/port0"), "nowhere", Code.INVALID_DEVICE_ID),
        ):
            with raises_code(code, hint):
                call()


def test_unsupported_channel_calls_exist_in_client():
    calls = [method.name for method in methods() if re.fullmatch(r"Create(TEDS)?[ACD][IO]\w*Chan\w*", method.name)]
    collections = importlib.import_module("nidaqmx.task.collections")
    client_functions = {
        name
        for kind in ("AI", "AO", "CI", "CO", "DI", "DO")
        for name in dir(getattr(collections, f"{kind}ChannelCollection"))
    }
    unsupported = {script_function(call) for call in calls if handler_of(call) is None}
    assert unsupported and unsupported <= client_functions


def test_timeout_has_text_of_driver(chassis):
    with add_inputs(Task("waiting")) as task:
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=100)
        task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI0")
        with pytest.raises(DaqReadError) as caught:
            task.read(100, timeout=0.01)
    # For this error alone, the client package contains the driver's text.
    assert str(caught.value).startswith(_ERROR_MESSAGES[Code.SAMPLES_NOT_YET_AVAILABLE])
    assert "Task Name: waiting" in str(caught.value)


def test_reserved_resource_names_terminal_and_task(chassis):
    with Task("first") as first, Task("second") as second:
        for task in (first, second):
            task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        first.control(TaskMode.TASK_RESERVE)
        with pytest.raises(DaqError) as caught:
            second.control(TaskMode.TASK_RESERVE)
    assert "Dev1/ao0 is in use by task 'first'" in str(caught.value)
    assert "Task Name: second" in str(caught.value)


def test_early_stop_returns_warning_code(chassis):
    with add_inputs(Task("early"), samps_per_chan=100) as task:
        task.start()
        assert chassis.tasks["early"].stop() == DAQmxWarnings.STOPPED_BEFORE_DONE


def test_closed_task_is_unusable(chassis):
    task = Task("used")
    same_task = nidaqmx.Task(task.name, grpc_options=options())
    task.close()
    with raises_code(Code.INVALID_TASK):
        same_task.start()
    with pytest.warns(DaqResourceWarning, match="already closed"):
        task.close()


def test_overload_flag_names_channel():
    scene = rig.load("bare-structure")
    chassis = connect(scene.replace(converter=scene.converter.replace(bits=24, range="0.2 V")), ManualClock())
    with Task() as input_task, Task() as output_task:
        input_task.ai_channels.add_ai_voltage_chan("Dev1/ai0:3", min_val=-0.1, max_val=0.1)
        input_task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        output_task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        output_task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=500)
        output_task.write(np.sin(np.arange(500) / 20))
        output_task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger", Edge.RISING)
        output_task.start()
        input_task.start()
        pass_samples(chassis, 50)
        assert input_task.in_stream.overloaded_chans_exist
        assert "Dev1/ai3" in input_task.in_stream.overloaded_chans
        assert not input_task.in_stream.overloaded_chans_exist
        assert np.abs(input_task.read(50)[3]).max() == pytest.approx(0.2, rel=1e-6)
        pass_samples(chassis, 450)
