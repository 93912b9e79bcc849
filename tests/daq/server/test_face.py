import numpy as np
import pytest

import daq
import daq.nidaqmx as nidaqmx
from daq.instrument.clock import ManualClock
from daq.nidaqmx import constants
from daq.nidaqmx.constants import READ_ALL_AVAILABLE, AccelUnits, AcquisitionType
from daq.nidaqmx.errors import DaqError
from daq.nidaqmx.stream_readers import (
    AnalogMultiChannelReader,
    AnalogSingleChannelReader,
    AnalogUnscaledReader,
)
from daq.nidaqmx.stream_writers import AnalogMultiChannelWriter, AnalogSingleChannelWriter
from daq.nidaqmx.system import Device, System
from daq.nidaqmx.utils import flatten_channel_string, unflatten_channel_string

RATE = 5120.0


@pytest.fixture
def chassis():
    return daq.connect("bare-structure", clock="fast")


def inputs(task, channels="cDAQ1Mod1/ai0:3", **timing):
    task.ai_channels.add_ai_accel_chan(
        channels,
        min_val=-500.0,
        max_val=500.0,
        units=AccelUnits.METERS_PER_SECOND_SQUARED,
        sensitivity=9806.65,
    )
    task.timing.cfg_samp_clk_timing(RATE, **timing)
    return task


def test_given_arrays_when_the_readers_fill_them_then_they_hold_what_read_returns(chassis):
    with nidaqmx.Task() as task:
        inputs(task, samps_per_chan=100)
        task.start()
        reader, many, one = AnalogMultiChannelReader(task.in_stream), np.zeros((4, 60)), np.zeros(4)
        assert reader.read_many_sample(many, 60) == 60
        reader.read_one_sample(one)
        rest = np.zeros((4, 39))
        assert reader.read_many_sample(rest) == 39
        task.in_stream.relative_to = constants.ReadRelativeTo.FIRST_SAMPLE
        every = np.array(task.read(100))
    assert np.array_equal(np.hstack([many, one[:, None], rest]), every)


def test_given_one_channel_when_read_by_its_reader_then_the_array_is_flat(chassis):
    with nidaqmx.Task() as task:
        inputs(task, "cDAQ1Mod1/ai3", samps_per_chan=50)
        reader, data = AnalogSingleChannelReader(task.in_stream), np.zeros(49)
        task.start()
        assert isinstance(reader.read_one_sample(), float)
        assert reader.read_many_sample(data, 49) == 49
        assert np.ptp(data) > 0


def test_given_a_timeout_when_a_reader_fills_an_array_then_the_partial_samples_are_in_it():
    manual = ManualClock()
    chassis = daq.connect("bare-structure", clock=manual)
    with nidaqmx.Task() as task:
        inputs(task, sample_mode=AcquisitionType.CONTINUOUS)
        task.start()
        chassis.advance(30)
        data = np.full((4, 50), np.nan)
        with pytest.raises(nidaqmx.DaqReadError) as caught:
            AnalogMultiChannelReader(task.in_stream).read_many_sample(data, 50)
    assert caught.value.samps_per_chan_read == 30
    assert np.isfinite(data[:, :30]).all() and np.isnan(data[:, 30:]).all()


@pytest.mark.parametrize(
    "data, hint",
    [
        (np.zeros((3, 10)), r"\(4, 10\) is needed"),
        (np.zeros((4, 10), np.float32), "float64"),
        (np.zeros((10, 4)).T, "contiguous"),
    ],
)
def test_given_an_array_that_does_not_fit_when_reading_into_it_then_the_error_says_what_does(
    chassis, data, hint
):
    with nidaqmx.Task() as task:
        inputs(task, samps_per_chan=10)
        with pytest.raises(DaqError, match=hint):
            AnalogMultiChannelReader(task.in_stream).read_many_sample(data, 10)


def test_given_writers_when_they_write_then_the_output_plays_it(chassis):
    with nidaqmx.Task() as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=20)
        assert AnalogSingleChannelWriter(task.out_stream).write_many_sample(np.linspace(0.0, 0.5, 20)) == 20
        task.start()
        task.wait_until_done()
        assert chassis.held[0] == 0.5
        task.stop()
        writer = AnalogMultiChannelWriter(task.out_stream, auto_start=True)
        assert writer.write_many_sample(np.full((1, 20), 0.25)) == 20
        task.wait_until_done()
        assert chassis.held[0] == 0.25
        with pytest.raises(DaqError, match="dimension"):
            writer.write_many_sample(np.zeros(20))
    with nidaqmx.Task() as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        AnalogSingleChannelWriter(task.out_stream).write_one_sample(0.75)
    assert chassis.held[0] == 0.75


def test_given_a_converter_with_bits_when_read_unscaled_then_the_counts_are_the_volts():
    chassis = daq.connect("fig8-three-dampers", clock="fast")
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:1")
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=200)
        task.start()
        counts = np.zeros((2, 200), np.int32)
        AnalogUnscaledReader(task.in_stream).read_int32(counts, 200)
        task.in_stream.relative_to = constants.ReadRelativeTo.FIRST_SAMPLE
        volts = np.array(task.read(200))
        interleaved = task.in_stream.read(200)
    assert np.array_equal(counts * chassis.inputs[0].volts_per_count, volts)
    assert np.array_equal(interleaved, counts.T.ravel())


def test_given_an_ideal_converter_when_read_unscaled_then_it_says_what_the_scene_lacks(chassis):
    with nidaqmx.Task() as task:
        inputs(task, samps_per_chan=10)
        with pytest.raises(DaqError, match="bits"):
            task.in_stream.read(10)


def test_given_the_system_when_listed_then_the_chassis_and_its_modules_are_there(chassis):
    devices = System.local().devices
    assert [each.name for each in devices] == ["cDAQ1", "cDAQ1Mod1", "cDAQ1Mod2"]
    assert [each.name for each in devices["cDAQ1Mod1"].ai_physical_chans] == [
        f"cDAQ1Mod1/ai{n}" for n in range(4)
    ]
    assert [each.name for each in devices["cDAQ1Mod2"].ao_physical_chans] == ["cDAQ1Mod2/ao0"]
    assert all(each.is_simulated for each in devices)
    assert Device("Dev1").ai_max_single_chan_rate == 51200.0
    assert devices["cDAQ1Mod1"].ai_physical_chans["cDAQ1Mod1/ai3"].sensor.at == "table"
    assert System.local().tasks == System.local().global_channels == System.local().scales == []
    with pytest.raises(DaqError) as caught:
        Device("Nothing")
    assert caught.value.error_code == -200220


def test_given_a_channel_when_its_properties_are_read_then_they_are_what_was_asked_for(chassis):
    with nidaqmx.Task("named") as task:
        channels = task.ai_channels.add_ai_accel_chan("Dev1/ai0:1", "acc", sensitivity=100.0)
        assert task.channel_names == channels.channel_names == ["acc0", "acc1"]
        assert channels.ai_accel_sensitivity == 100.0
        assert channels.ai_accel_units is AccelUnits.G
        assert channels.ai_coupling is constants.Coupling.AC
        assert (channels.ai_excit_src, channels.ai_excit_val) == (constants.ExcitationSource.INTERNAL, 0.004)
        assert task.ai_channels["acc1"].physical_channel.name == "Dev1/ai1"
        channels.ai_coupling = constants.Coupling.DC
        assert task.ai_channels[1].ai_coupling is constants.Coupling.DC
        assert task.ai_channels[0].ai_filter_delay == pytest.approx(0.5 / RATE)
        assert [each.name for each in task.devices] == ["Dev1"]
        assert task.number_of_channels == len(task.ai_channels) == 2


def test_given_a_driver_script_when_only_its_import_is_changed_then_it_runs(monkeypatch, tmp_path):
    monkeypatch.setenv("SHOTRIG_SCENE", "bare-structure")
    monkeypatch.setenv("SHOTRIG_CLOCK", "fast")
    monkeypatch.setattr("daq.instrument.connection._connected", [])
    with nidaqmx.Task() as task:
        task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0", sensitivity=1000.0)
        task.timing.cfg_samp_clk_timing(1652.0, sample_mode=AcquisitionType.FINITE, samps_per_chan=20)
        data = task.read(READ_ALL_AVAILABLE)
        assert task.timing.samp_clk_rate == pytest.approx(51200 / 30)
    assert len(data) == 20
    assert task.chassis.scene.name == "bare structure, ideal sensors"


@pytest.mark.parametrize(
    "names", [["Dev1/ai0", "Dev1/ai1", "Dev1/ai2"], ["a"], ["a1", "a3", "b"], ["x09", "x10"]]
)
def test_given_names_when_flattened_then_unflattening_gives_them_back(names):
    assert unflatten_channel_string(flatten_channel_string(names)) == names


def test_given_no_scene_when_a_script_asks_for_ten_volts_then_the_default_bench_has_them(monkeypatch):
    monkeypatch.delenv("SHOTRIG_SCENE", raising=False)
    chassis = daq.connect(clock="fast")
    with nidaqmx.Task() as task:
        channels = task.ai_channels.add_ai_voltage_chan("Dev1/ai0:3", min_val=-10.0, max_val=10.0)
        assert (channels.ai_min, channels.ai_max) == (-10.0, 10.0)
    assert [each.quantity for each in chassis.inputs] == ["acceleration"] * 4
    assert chassis.outputs == 1


def test_given_a_constant_of_other_instruments_when_asked_for_then_the_error_names_it():
    with pytest.raises(nidaqmx.DaqError, match="ThermocoupleType is not supported") as raised:
        from daq.nidaqmx.constants import ThermocoupleType  # noqa: F401
    assert raised.value.error_code == -200452
    assert not hasattr(constants, "no_such_name")
