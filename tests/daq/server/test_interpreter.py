"""The real package nidaqmx as a client of the rig."""

import enum
import sys

import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import (
    READ_ALL_AVAILABLE,
    AcquisitionType,
    Coupling,
    Edge,
    LoggingMode,
    LoggingOperation,
    RegenerationMode,
    Slope,
    TaskMode,
    VoltageUnits,
)
from nidaqmx.stream_readers import AnalogMultiChannelReader, AnalogUnscaledReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter

import daq
import daq.nidaqmx
from daq.face import constants as our_constants
from daq.face.interpreter import interpreter, plug_in
from daq.instrument import errors as our_errors
from daq.instrument.clock import ManualClock

RATE = 5120.0


@pytest.fixture(autouse=True)
def driver(monkeypatch):
    monkeypatch.setattr("nidaqmx.utils._select_interpreter", nidaqmx.utils._select_interpreter)
    plug_in()


@pytest.fixture
def chassis():
    return daq.connect("bare-structure", clock="fast")


def inputs(task, channels="Dev1/ai0:3", **timing):
    task.ai_channels.add_ai_accel_chan(channels, min_val=-50, max_val=50, sensitivity=100.0)
    task.timing.cfg_samp_clk_timing(RATE, **timing)
    return task


def test_given_the_packages_constants_when_compared_then_ours_have_the_same_names_and_values():
    for name, ours in vars(our_constants).items():
        theirs = getattr(nidaqmx.constants, name, None)
        if isinstance(ours, enum.EnumMeta) and ours.__module__ == our_constants.__name__:
            assert {each.name: each.value for each in ours}.items() <= {
                each.name: each.value for each in theirs
            }.items(), name
    for ours, theirs in (
        (our_errors.DAQmxErrors, nidaqmx.error_codes.DAQmxErrors),
        (our_errors.DAQmxWarnings, nidaqmx.error_codes.DAQmxWarnings),
    ):
        assert all(theirs[each.name] == each.value for each in ours)


def test_given_the_package_when_it_reads_then_it_gets_what_our_own_face_gets():
    read = []
    for package in (nidaqmx, daq.nidaqmx):
        daq.connect("bare-structure", clock="fast")
        with package.Task() as task:
            inputs(task, samps_per_chan=100)
            read.append(task.read(READ_ALL_AVAILABLE))
    assert np.shape(read[0]) == (4, 100)
    assert read[0] == read[1]


def test_given_the_package_when_it_drives_and_reads_then_the_plant_is_in_between(chassis):
    with nidaqmx.Task() as reading, nidaqmx.Task() as driving:
        inputs(reading, sample_mode=AcquisitionType.CONTINUOUS)
        driving.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        driving.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        driving.triggers.start_trigger.cfg_dig_edge_start_trig(reading.triggers.start_trigger.term)
        AnalogSingleChannelWriter(driving.out_stream).write_many_sample(
            0.1 * np.sin(np.arange(512) * np.pi / 128)
        )
        driving.start()
        reading.start()
        data = np.zeros((4, 512))
        assert AnalogMultiChannelReader(reading.in_stream).read_many_sample(data, 512) == 512
        assert driving.out_stream.total_samp_per_chan_generated == 512
        assert driving.out_stream.regen_mode == RegenerationMode.ALLOW_REGENERATION
        assert reading.timing.samp_clk_rate == RATE
        assert reading.in_stream.total_samp_per_chan_acquired == 512
    assert (np.ptp(data, axis=1) > 0).all()


def test_given_the_package_when_something_goes_wrong_then_its_own_errors_come():
    manual = ManualClock()
    chassis = daq.connect("bare-structure", clock=manual)
    with nidaqmx.Task() as task:
        inputs(task, sample_mode=AcquisitionType.CONTINUOUS)
        task.in_stream.input_buf_size = 100
        task.start()
        chassis.advance(30)
        data = np.zeros((4, 50))
        with pytest.raises(nidaqmx.DaqReadError) as caught:
            AnalogMultiChannelReader(task.in_stream).read_many_sample(data, 50)
        assert (caught.value.error_code, caught.value.samps_per_chan_read) == (-200284, 30)
        chassis.advance(200)
        with pytest.raises(nidaqmx.DaqReadError) as caught:
            task.read(10)
        assert caught.value.error_code == -200279
        assert len(task.read(100)[0]) == 100
        with pytest.raises(nidaqmx.DaqError) as caught:
            task.timing.cfg_samp_clk_timing(1000.0)
        assert (
            caught.value.error_type == nidaqmx.error_codes.DAQmxErrors.CAN_NOT_PERFORM_OP_WHILE_TASK_RUNNING
        )
    with nidaqmx.Task() as task:
        inputs(task, samps_per_chan=100)
        task.start()
        with pytest.warns(nidaqmx.DaqWarning) as warned:
            task.stop()
        assert warned[0].message.error_code == 200010


def test_given_a_value_that_cannot_be_when_the_package_passes_it_then_its_own_error_comes(chassis):
    with nidaqmx.Task() as task:
        for call in (
            lambda: task.ai_channels.add_ai_accel_chan("Dev1/ai0", sensitivity=0.0),
            lambda: task.ai_channels.add_ai_accel_chan("Dev1/ai0", units=VoltageUnits.VOLTS),
            lambda: task.timing.cfg_samp_clk_timing(RATE, sample_mode=Edge.RISING),
            lambda: task.wait_until_done(float("nan")),
        ):
            with pytest.raises(nidaqmx.DaqError) as caught:
                call()
            assert caught.value.error_code == -200077
        inputs(task, samps_per_chan=10**13)
        with pytest.raises(nidaqmx.DaqError, match="memory"):
            task.start()


def test_given_a_reference_trigger_when_the_package_reads_then_the_edge_sits_at_pretrigger():
    daq.connect("fig10b-no-damper", clock="fast")
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_force_iepe_chan("Dev1/ai3")
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=300)
        task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai3", 60, Slope.RISING, 10.0)
        assert task.triggers.reference_trigger.pretrig_samples == 60
        assert task.triggers.reference_trigger.anlg_edge_lvl == 10.0
        force = np.array(task.read(READ_ALL_AVAILABLE, timeout=20.0))
    assert int(np.argmax(force > 10.0)) == 60


def test_given_a_callback_when_the_package_registers_it_then_it_is_called(chassis):
    counts, done = [], []
    with nidaqmx.Task() as task:
        inputs(task, "Dev1/ai0", samps_per_chan=300)

        def look(handle, event, samples, data):
            counts.append(len(task.read(samples)))
            return 0

        task.register_every_n_samples_acquired_into_buffer_event(100, look)
        task.register_done_event(lambda handle, status, data: done.append(status))
        task.start()
        task.wait_until_done()
        task.stop()
        task.register_every_n_samples_acquired_into_buffer_event(100, None)
        task.register_done_event(None)
    assert (counts, done) == ([100] * 3, [0])


def test_given_logging_when_the_package_reads_then_the_recording_is_there(tmp_path):
    daq.connect("fig8-three-dampers", clock="fast")
    path = tmp_path / "task.mcap"
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0", "first")
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=100)
        task.in_stream.configure_logging(
            path, LoggingMode.LOG_AND_READ, operation=LoggingOperation.CREATE_OR_REPLACE
        )
        assert task.in_stream.logging_mode == LoggingMode.LOG_AND_READ
        read = task.read(READ_ALL_AVAILABLE)
    with daq.open(path) as recording:
        volts = recording.read("first") * recording.channels["first"].sensitivity
    np.testing.assert_allclose(volts, read, rtol=1e-12)


def test_given_waveforms_when_the_package_reads_them_then_they_know_time_and_unit(chassis):
    with nidaqmx.Task() as task:
        inputs(task, "Dev1/ai0:1", samps_per_chan=50)
        first, second = task.read_waveform()
    assert first.sample_count == 50
    assert (first.channel_name, first.units) == ("Dev1/ai0", "g")
    assert second.timing.sample_interval.total_seconds() == pytest.approx(1 / RATE)


def test_given_counts_when_the_package_reads_raw_then_they_come_interleaved():
    daq.connect("fig8-three-dampers", clock="fast")
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0:1")
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=100)
        task.start()
        raw = task.in_stream.read(50)
        counts = np.zeros((2, 50), np.int32)
        AnalogUnscaledReader(task.in_stream).read_int32(counts, 50)
    assert (raw.dtype, raw.size) == (np.int32, 100)
    assert np.abs(counts).max() > 0


def test_given_the_system_when_the_package_lists_it_then_devices_and_channels_are_there(chassis):
    devices = nidaqmx.system.System.local().devices
    assert [each.name for each in devices] == ["cDAQ1", "cDAQ1Mod1", "cDAQ1Mod2"]
    module = devices["cDAQ1Mod1"]
    assert [each.name for each in module.ai_physical_chans] == [f"cDAQ1Mod1/ai{n}" for n in range(4)]
    assert len(module.ao_physical_chans) == 0
    assert module.is_simulated and module.product_category.name == "C_SERIES_MODULE"
    assert nidaqmx.system.System.local().driver_version.major_version >= 24


def test_given_settings_when_the_package_changes_them_then_they_are_kept(chassis):
    with nidaqmx.Task("settings") as task:
        channel = task.ai_channels.add_ai_accel_chan("Dev1/ai0", sensitivity=100.0)
        channel.ai_accel_sensitivity = 101.0
        assert task.ai_channels["Dev1/ai0"].ai_accel_sensitivity == 101.0
        task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        task.timing.samp_clk_rate = 10000.0
        assert task.timing.samp_clk_rate == 10240.0
        assert task.in_stream.input_buf_size == 100000
        task.in_stream.offset = 5
        del task.in_stream.offset
        assert task.in_stream.offset == 0
        task.control(TaskMode.TASK_COMMIT)
        assert task.name == "settings" and task.channel_names == ["Dev1/ai0"]
        assert [each.name for each in task.devices] == ["Dev1"]


def test_given_a_property_with_a_small_number_when_the_package_sets_it_then_it_is_kept(chassis):
    with nidaqmx.Task() as task:
        channel = task.ai_channels.add_ai_accel_chan("Dev1/ai0", sensitivity=100.0)
        assert channel.ai_coupling is Coupling.AC
        channel.ai_coupling = Coupling.DC
        assert channel.ai_coupling is Coupling.DC


def test_given_nothing_to_list_when_the_package_asks_for_a_list_then_it_is_empty(chassis):
    system = nidaqmx.system.System.local()
    module = system.devices["cDAQ1Mod1"]
    with nidaqmx.Task() as task:
        inputs(task, "Dev1/ai0", samps_per_chan=100)
        task.read(READ_ALL_AVAILABLE)
        assert not task.in_stream.overloaded_chans_exist
        assert task.in_stream.overloaded_chans == []
    assert module.chassis_module_devices == []
    assert module.ai_voltage_rngs == []
    assert [list(each) for each in (system.tasks, system.global_channels, system.scales)] == [[]] * 3
    assert [list(each) for each in (module.ci_physical_chans, module.do_lines)] == [[]] * 2


@pytest.mark.parametrize(
    "call, name",
    [
        (lambda task: task.ai_channels.add_ai_voltage_chan("Dev1/ai0").ai_dither_enable, "ai_dither_enable"),
        (lambda task: task.ai_channels.add_ai_thrmcpl_chan("Dev1/ai0"), "create_ai_thrmcpl_chan"),
        (lambda task: task.ci_channels.add_ci_count_edges_chan("Dev1/ctr0"), "create_ci_count_edges_chan"),
        (lambda task: task.triggers.pause_trigger.anlg_lvl_lvl, "property anlg_lvl_lvl"),
        (lambda task: nidaqmx.scale.Scale.create_lin_scale("scale", 2.0), "create_lin_scale"),
        (lambda task: task.timing.ai_conv_rate, "timing.ai_conv_rate"),
    ],
)
def test_given_what_the_instrument_lacks_when_the_package_calls_it_then_the_error_names_the_call(
    chassis, call, name
):
    with nidaqmx.Task() as task, pytest.raises(nidaqmx.DaqError, match=name):
        call(task)


def test_given_another_version_when_plugging_in_then_it_is_refused(monkeypatch):
    monkeypatch.setattr(nidaqmx, "__version__", "9.9.9")
    with pytest.raises(daq.DaqError, match=r"9\.9\.9"):
        plug_in()


def test_given_the_interpreter_when_made_then_it_answers_every_call_of_the_seam():
    made = interpreter()
    assert not getattr(type(made), "__abstractmethods__", ())
    assert "nidaqmx" in sys.modules
