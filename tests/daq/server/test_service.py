import queue
import threading
import time

import grpc
import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType
from nidaqmx.errors import DaqError, RpcError
from nidaqmx.system import System

import daq
from daq.instrument.clock import ManualClock
from daq.server.grpc_channel import open_channel
from daq.server.serve import serve
from daq.server.served_instrument import Limits
from rig.errors import SceneError

RATE = 5120.0


@pytest.fixture(scope="module")
def shared():
    with daq.connect("bare-structure", clock=ManualClock()) as rig:
        yield rig


def client(rig, name="", **options):
    """Give session options of a client of its own."""
    return nidaqmx.GrpcSessionOptions(open_channel(rig.address), name, **options)


def inputs(options, channels="cDAQ1Mod1/ai0", name="", **timing):
    task = nidaqmx.Task(name, grpc_options=options)
    task.ai_channels.add_ai_voltage_chan(channels, min_val=-500.0, max_val=500.0)
    if timing:
        task.timing.cfg_samp_clk_timing(RATE, **timing)
    return task


def test_given_a_rig_when_asked_what_there_is_then_the_devices_tell(shared):
    devices = System.remote(shared).devices
    assert devices.device_names == ["cDAQ1", "cDAQ1Mod1", "cDAQ1Mod2"]
    assert [each.name for each in devices["cDAQ1"].chassis_module_devices] == ["cDAQ1Mod1", "cDAQ1Mod2"]
    assert devices["cDAQ1Mod1"].ai_physical_chans.channel_names[-1] == "cDAQ1Mod1/ai3"


def test_given_a_named_module_when_asked_then_it_is_that_module_and_cannot_be_read_on_demand():
    import rig as package

    scene = package.load("bare-structure")
    scene = scene.replace(converter={"preset": "NI 9234", "rate": "5120 Hz"})
    with daq.connect(scene, clock="fast") as rig:
        module = System.remote(rig).devices["cDAQ1Mod1"]
        assert (module.product_type, module.ai_voltage_rngs) == ("NI 9234", [-5.0, 5.0])
        with nidaqmx.Task(grpc_options=rig) as task:
            task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0")
            with pytest.raises(DaqError) as caught:
                task.read()
            assert caught.value.error_code == -201087
            task.timing.cfg_samp_clk_timing(8000.0)
            assert task.timing.samp_clk_rate == pytest.approx(51200 / 6)


@pytest.mark.parametrize("name", ["cDAQ9189-1D91958Mod1", "Dev12", "PXI1Slot4"])
def test_given_a_name_the_driver_gives_when_used_then_it_stands_for_all_inputs(shared, name):
    with inputs(shared, f"{name}/ai0:3", samps_per_chan=10) as task:
        assert task.number_of_channels == 4
        assert task.devices[0].name == name


@pytest.mark.parametrize(
    "name, expected",
    [("acc", ["acc0", "acc1", "acc2"]), ("acc09", ["acc09", "acc10", "acc11"])],
)
def test_given_a_name_for_several_channels_when_added_then_it_is_counted_on(shared, name, expected):
    with nidaqmx.Task(grpc_options=shared) as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:2", name)
        assert task.channel_names == expected


def test_given_nothing_said_when_asked_then_the_defaults_are_the_drivers(shared):
    with inputs(shared) as task:
        assert task.timing.samp_quant_samp_mode == AcquisitionType.CONTINUOUS
        assert task.triggers.reference_trigger.pretrig_samples == 2
        channel = task.ai_channels[0]
        del channel.ai_max
        with pytest.raises(DaqError) as caught:
            task.ai_channels[0].ai_max  # noqa: B018
        assert caught.value.error_code == -200695
        channel.ai_max = 400.0
        assert task.ai_channels[0].ai_max == 400.0


def test_given_a_terminal_twice_when_added_then_both_channels_read_it():
    with (
        daq.connect("bare-structure", clock="fast") as rig,
        inputs(rig, "cDAQ1Mod1/ai3,cDAQ1Mod1/ai3", samps_per_chan=50) as task,
    ):
        first, second = task.read(50)
    assert first == second


def test_given_inputs_and_an_output_of_different_rates_when_run_then_each_keeps_its_own():
    with (
        daq.connect("bare-structure", clock="fast") as rig,
        inputs(rig, "cDAQ1Mod1/ai3") as reading,
        nidaqmx.Task(grpc_options=rig) as driving,
    ):
        reading.timing.cfg_samp_clk_timing(51200.0, samps_per_chan=1000)
        driving.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        driving.timing.cfg_samp_clk_timing(10240.0, samps_per_chan=200)
        driving.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        driving.write(np.arange(200) / 100)
        driving.start()
        reading.start()
        reading.wait_until_done()
        driving.wait_until_done()
        assert driving.out_stream.total_samp_per_chan_generated == 200
        assert rig.chassis.rate == 51200.0
        assert rig.chassis.held[0] == 1.99


def test_given_two_modules_at_two_rates_when_read_then_the_slow_one_averages_what_the_fast_one_sees():
    with (
        daq.connect("bare-structure", clock="fast") as rig,
        inputs(rig, "Dev1/ai3") as fast,
        inputs(rig, "Dev2/ai3") as slow,
    ):
        fast.timing.cfg_samp_clk_timing(51200.0, samps_per_chan=401)
        slow.timing.cfg_samp_clk_timing(12800.0, samps_per_chan=101)
        fast.start()
        slow.start()
        every, fourth = np.array(fast.read(401)), np.array(slow.read(101))
    np.testing.assert_allclose(fourth[1:], every[1:].reshape(100, 4).mean(axis=1), rtol=1e-12, atol=1e-15)


def test_given_several_samples_when_written_on_demand_then_they_are_played_one_after_the_other():
    with daq.connect("bare-structure", clock="fast") as rig, nidaqmx.Task(grpc_options=rig) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        assert task.write([0.1, 0.2, 0.3], auto_start=True) == 3
        task.wait_until_done()
        assert rig.chassis.held[0] == 0.3


def test_given_a_session_when_another_client_attaches_then_it_may_use_but_not_end_it(shared):
    with inputs(client(shared), name="common", samps_per_chan=10) as task:
        other = nidaqmx.Task("common", grpc_options=client(shared))
        assert other.timing.samp_quant_samp_per_chan == 10
        other.close()
        assert task.timing.samp_quant_samp_per_chan == 10
    attach = nidaqmx.SessionInitializationBehavior.ATTACH_TO_SERVER_SESSION
    with pytest.raises(DaqError):
        nidaqmx.Task("common", grpc_options=client(shared, initialization_behavior=attach))


def test_given_a_session_of_that_name_when_a_new_one_is_wanted_then_it_is_refused(shared):
    new = nidaqmx.SessionInitializationBehavior.INITIALIZE_SERVER_SESSION
    with inputs(client(shared), name="mine"), pytest.raises(RpcError) as caught:
        nidaqmx.Task("mine", grpc_options=client(shared, initialization_behavior=new))
    assert caught.value.rpc_code == grpc.StatusCode.ALREADY_EXISTS


def test_given_a_device_in_use_by_others_when_a_client_resets_it_then_nothing_happens_to_them(shared):
    with inputs(client(shared), sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        with pytest.raises(DaqError) as caught:
            System.remote(client(shared)).devices["cDAQ1Mod1"].reset_device()
        assert caught.value.error_code == -50103
        assert not task.is_task_done()


def test_given_a_client_that_goes_without_goodbye_when_its_time_is_over_then_its_modules_are_free():
    limits = Limits(patience=0.2)
    with daq.connect("bare-structure", clock=ManualClock(), limits=limits) as rig:
        lost = client(rig)
        task = inputs(lost, sample_mode=AcquisitionType.CONTINUOUS)
        task.start()
        lost.grpc_channel.close()
        until = time.monotonic() + 60
        while rig.chassis.tasks and time.monotonic() < until:
            threading.Event().wait(0.05)
        with inputs(rig, sample_mode=AcquisitionType.CONTINUOUS) as other:
            other.start()


def test_given_more_than_a_client_may_have_when_asked_for_then_it_alone_is_refused():
    limits = Limits(tasks=3, message=1 << 20)
    with daq.connect("bare-structure", clock="fast", limits=limits) as rig:
        mine = client(rig)
        tasks = [inputs(mine) for _ in range(3)]
        with pytest.raises(DaqError, match="as many as it may"):
            inputs(mine)
        with (
            inputs(client(rig), samps_per_chan=1 << 18) as task,
            pytest.raises(DaqError, match="less at once"),
        ):
            task.read(1 << 18)
        for task in tasks:
            task.close()


def test_given_buffers_larger_than_a_client_may_have_when_they_are_filled_then_it_alone_is_refused():
    with daq.connect("bare-structure", clock="fast", limits=Limits(memory=1 << 20)) as rig:
        greedy, modest = client(rig), client(rig)
        with nidaqmx.Task(grpc_options=greedy) as task, inputs(modest, samps_per_chan=100) as other:
            task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
            task.timing.cfg_samp_clk_timing(51200.0)
            for _ in range(2):
                task.write(np.zeros(60_000), auto_start=False)
            with pytest.raises(DaqError, match="take smaller"):
                task.write(np.zeros(60_000), auto_start=False)
            assert len(other.read(100)) == 100
            assert task.write(np.zeros(1000), auto_start=False) == 1000
        with inputs(greedy, samps_per_chan=1_000_000) as task, pytest.raises(DaqError, match="take smaller"):
            task.start()


def test_given_nonsense_when_it_is_sent_then_the_caller_alone_hears_of_it(shared):
    channel = open_channel(shared.address)
    for method in ("ReadAnalogF64", "CreateAIVoltageChan", "WriteRaw", "GetChanAttributeInt32"):
        with pytest.raises(grpc.RpcError):
            channel.unary_unary(f"/nidaqmx_grpc.NiDAQmx/{method}")(b"\xff\xff\xff\xff", timeout=30)
        with pytest.raises(grpc.RpcError):
            channel.unary_unary(f"/nidaqmx_grpc.NiDAQmx/{method}")(b"", timeout=30)
    assert System.remote(shared).devices.device_names


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.20", "rig.example.org", "::"])
def test_given_an_address_others_can_reach_when_served_without_certificates_then_it_is_refused(host):
    with pytest.raises(SceneError, match="--certificate"):
        serve("bare-structure", "fast", host, 0)


def test_given_a_callback_that_fails_when_events_go_on_then_so_does_the_task(caplog):
    with daq.connect("bare-structure", clock="fast") as rig, inputs(rig, samps_per_chan=300) as task:
        done, calls = threading.Event(), queue.Queue()

        def fail(handle, kind, samples, data):
            calls.put(samples)
            raise RuntimeError("on purpose")

        task.register_every_n_samples_acquired_into_buffer_event(100, fail)
        task.register_done_event(lambda *given: done.set())
        task.start()
        task.wait_until_done()
        assert done.wait(60)
        assert [calls.get(timeout=60.0) for _ in range(3)] == [100] * 3
        task.stop()
