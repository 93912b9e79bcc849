"""The server: its clients, sessions (tasks that clients share by name), limits, and modules that tasks share."""

import queue
import threading
import time

import grpc
import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import AccelSensitivityUnits, AccelUnits, AcquisitionType
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.errors import DaqError, RpcError
from nidaqmx.system import System

import daq
from daq.extras.ni_device.clock import ManualClock
from daq.extras.ni_server.client_defaults import open_channel
from daq.extras.ni_server.serve import serve
from daq.extras.ni_server.served_instrument import Limits
from rig import load
from rig.core.base.errors import SceneError
from tests.daq.client import RATE, raises_code


@pytest.fixture(scope="module")
def shared_rig():
    with daq.connect("bare-structure", clock=ManualClock()) as rig:
        yield rig


def connect_client(rig, name="", **options):
    """Return session options of a separate client."""
    return nidaqmx.GrpcSessionOptions(open_channel(rig.address), name, **options)


def input_task_of(options, channels="cDAQ1Mod1/ai0", name="", **timing):
    """Return a task with voltage inputs, with a sample clock if `timing` is given."""
    task = nidaqmx.Task(name, grpc_options=options)
    task.ai_channels.add_ai_voltage_chan(channels, min_val=-500.0, max_val=500.0)
    if timing:
        task.timing.cfg_samp_clk_timing(RATE, **timing)
    return task


def test_devices_are_enumerated(shared_rig):
    devices = System.remote(shared_rig).devices
    assert devices.device_names == ["cDAQ1", "cDAQ1Mod1", "cDAQ1Mod2"]
    assert [device.name for device in devices["cDAQ1"].chassis_module_devices] == ["cDAQ1Mod1", "cDAQ1Mod2"]
    assert devices["cDAQ1Mod1"].ai_physical_chans.channel_names[-1] == "cDAQ1Mod1/ai3"


def test_named_module_rejects_on_demand_reading():
    scene = load("bare-structure").replace(converter={"preset": "NI 9234", "rate": "5120 Hz"})
    with daq.connect(scene, clock="fast") as rig:
        module = System.remote(rig).devices["cDAQ1Mod1"]
        assert (module.product_type, module.ai_voltage_rngs) == ("NI 9234", [-5.0, 5.0])
        with nidaqmx.Task(grpc_options=rig) as task:
            task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0")
            with raises_code(Code.SAMP_CLK_RATE_MUST_BE_SPECD):
                task.read()
            task.timing.cfg_samp_clk_timing(8000.0)
            assert task.timing.samp_clk_rate == pytest.approx(51200 / 6)


@pytest.mark.parametrize("name", ["cDAQ9189-1D91958Mod1", "Dev12", "PXI1Slot4"])
def test_device_name_of_real_hardware_is_accepted(shared_rig, name):
    with input_task_of(shared_rig, f"{name}/ai0:3", samps_per_chan=10) as task:
        assert task.number_of_channels == 4
        assert task.devices[0].name == name


def test_defaults_are_those_of_driver(shared_rig):
    with input_task_of(shared_rig) as task:
        assert task.timing.samp_quant_samp_mode == AcquisitionType.CONTINUOUS
        assert task.triggers.reference_trigger.pretrig_samples == 2
        channel = task.ai_channels[0]
        del channel.ai_max
        with raises_code(Code.AI_MAX_NOT_SPECIFIED):
            task.ai_channels[0].ai_max  # noqa: B018
        channel.ai_max = 400.0
        assert task.ai_channels[0].ai_max == 400.0


def test_reset_units_are_those_of_driver(shared_rig):
    with nidaqmx.Task(grpc_options=shared_rig) as task:
        units = AccelSensitivityUnits.VOLTS_PER_G
        channel = task.ai_channels.add_ai_accel_chan(
            "cDAQ1Mod1/ai0", sensitivity=0.1, sensitivity_units=units, units=AccelUnits.METERS_PER_SECOND_SQUARED
        )
        del channel.ai_accel_sensitivity_units, channel.ai_accel_units
        assert channel.ai_accel_sensitivity_units is AccelSensitivityUnits.MILLIVOLTS_PER_G
        assert channel.ai_accel_units is AccelUnits.G


def test_terminal_may_be_used_twice():
    with (
        daq.connect("bare-structure", clock="fast") as rig,
        input_task_of(rig, "cDAQ1Mod1/ai3,cDAQ1Mod1/ai3", samps_per_chan=50) as task,
    ):
        first, second = task.read(50)
    assert first == second


def test_inputs_and_output_have_separate_rates():
    with (
        daq.connect("bare-structure", clock="fast") as rig,
        input_task_of(rig, "cDAQ1Mod1/ai3") as input_task,
        nidaqmx.Task(grpc_options=rig) as output_task,
    ):
        input_task.timing.cfg_samp_clk_timing(51200.0, samps_per_chan=1000)
        output_task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output_task.timing.cfg_samp_clk_timing(10240.0, samps_per_chan=200)
        output_task.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        output_task.write(np.arange(200) / 100)
        output_task.start()
        input_task.start()
        input_task.wait_until_done()
        output_task.wait_until_done()
        assert output_task.out_stream.total_samp_per_chan_generated == 200
        assert rig.chassis.rate == 51200.0
        assert rig.chassis.last_volts[0] == 199 / 100  # the last written sample


def test_slow_module_averages_samples_of_fast_module():
    with (
        daq.connect("bare-structure", clock="fast") as rig,
        input_task_of(rig, "Dev1/ai3") as fast_task,
        input_task_of(rig, "Dev2/ai3") as slow_task,
    ):
        fast_task.timing.cfg_samp_clk_timing(51200.0, samps_per_chan=401)
        slow_task.timing.cfg_samp_clk_timing(12800.0, samps_per_chan=101)
        fast_task.start()
        slow_task.start()
        fast_samples, slow_samples = np.array(fast_task.read(401)), np.array(slow_task.read(101))
    np.testing.assert_allclose(slow_samples[1:], fast_samples[1:].reshape(100, 4).mean(axis=1), rtol=1e-12, atol=1e-15)


def test_on_demand_samples_are_generated_in_order():
    with daq.connect("bare-structure", clock="fast") as rig, nidaqmx.Task(grpc_options=rig) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        assert task.write([0.1, 0.2, 0.3], auto_start=True) == 3
        task.wait_until_done()
        assert rig.chassis.last_volts[0] == 0.3


def test_attached_client_cannot_end_session(shared_rig):
    with input_task_of(connect_client(shared_rig), name="common", samps_per_chan=10) as task:
        attached_task = nidaqmx.Task("common", grpc_options=connect_client(shared_rig))
        assert attached_task.timing.samp_quant_samp_per_chan == 10
        attached_task.close()
        assert task.timing.samp_quant_samp_per_chan == 10
    attach = nidaqmx.SessionInitializationBehavior.ATTACH_TO_SERVER_SESSION
    with pytest.raises(DaqError):
        nidaqmx.Task("common", grpc_options=connect_client(shared_rig, initialization_behavior=attach))


def test_existing_session_is_rejected(shared_rig):
    initialize = nidaqmx.SessionInitializationBehavior.INITIALIZE_SERVER_SESSION
    with input_task_of(connect_client(shared_rig), name="mine"), pytest.raises(RpcError) as caught:
        nidaqmx.Task("mine", grpc_options=connect_client(shared_rig, initialization_behavior=initialize))
    assert caught.value.rpc_code == grpc.StatusCode.ALREADY_EXISTS


def test_device_used_by_others_is_not_reset(shared_rig):
    with input_task_of(connect_client(shared_rig), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        with raises_code(Code.PAL_RESOURCE_RESERVED):
            System.remote(connect_client(shared_rig)).devices["cDAQ1Mod1"].reset_device()
        assert not task.is_task_done()


def test_modules_of_disconnected_client_are_released():
    limits = Limits(disconnect_timeout=0.2)  # s
    with daq.connect("bare-structure", clock=ManualClock(), limits=limits) as rig:
        disconnected_client = connect_client(rig)
        task = input_task_of(disconnected_client, sample_mode=AcquisitionType.CONTINUOUS)
        task.start()
        disconnected_client.grpc_channel.close()
        deadline = time.monotonic() + 60
        while rig.chassis.tasks and time.monotonic() < deadline:
            threading.Event().wait(0.05)
        with input_task_of(rig, sample_mode=AcquisitionType.CONTINUOUS) as next_task:
            next_task.start()


def test_excessive_requests_are_rejected():
    limits = Limits(max_tasks_per_client=3, max_message_bytes=1 << 20)
    with daq.connect("bare-structure", clock="fast", limits=limits) as rig:
        first_client = connect_client(rig)
        tasks = [input_task_of(first_client) for _ in range(3)]
        with pytest.raises(DaqError, match="3 open tasks"):
            input_task_of(first_client)
        with (
            input_task_of(connect_client(rig), samps_per_chan=1 << 18) as task,
            pytest.raises(DaqError, match="fewer samples at a time"),
        ):
            task.read(1 << 18)
        for task in tasks:
            task.close()


def test_excessive_buffers_are_rejected():
    with daq.connect("bare-structure", clock="fast", limits=Limits(max_buffer_bytes=1 << 20)) as rig:
        large_client, small_client = connect_client(rig), connect_client(rig)
        with (
            nidaqmx.Task(grpc_options=large_client) as task,
            input_task_of(small_client, samps_per_chan=100) as small_task,
        ):
            task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
            task.timing.cfg_samp_clk_timing(51200.0)
            for _ in range(2):
                task.write(np.zeros(60_000), auto_start=False)
            with pytest.raises(DaqError, match="smaller buffers"):
                task.write(np.zeros(60_000), auto_start=False)
            assert len(small_task.read(100)) == 100
            assert task.write(np.zeros(1000), auto_start=False) == 1000
        with (
            input_task_of(large_client, samps_per_chan=1_000_000) as task,
            pytest.raises(DaqError, match="smaller buffers"),
        ):
            task.start()


def test_invalid_requests_do_not_stop_server(shared_rig):
    channel = open_channel(shared_rig.address)
    for method in ("ReadAnalogF64", "CreateAIVoltageChan", "WriteRaw", "GetChanAttributeInt32"):
        with pytest.raises(grpc.RpcError):
            channel.unary_unary(f"/nidaqmx_grpc.NiDAQmx/{method}")(b"\xff\xff\xff\xff", timeout=30)
        with pytest.raises(grpc.RpcError):
            channel.unary_unary(f"/nidaqmx_grpc.NiDAQmx/{method}")(b"", timeout=30)
    assert System.remote(shared_rig).devices.device_names


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.20", "rig.example.org", "::"])
def test_public_address_needs_certificates(host):
    with pytest.raises(SceneError, match="certificates"):
        serve("bare-structure", "fast", host, 0)


def test_failing_callback_does_not_stop_task(caplog):
    with daq.connect("bare-structure", clock="fast") as rig, input_task_of(rig, samps_per_chan=300) as task:
        completed, calls = threading.Event(), queue.Queue()

        def raise_error(handle, kind, samples, data):
            calls.put(samples)
            raise RuntimeError("on purpose")

        task.register_every_n_samples_acquired_into_buffer_event(100, raise_error)
        task.register_done_event(lambda *event: completed.set())
        task.start()
        task.wait_until_done()
        assert completed.wait(60)
        assert [calls.get(timeout=60.0) for _ in range(3)] == [100] * 3
        task.stop()
