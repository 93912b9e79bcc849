"""Benches for tests: wires, sources, modules, transfers and faults, through NI's client."""

import queue
import threading
import time
from contextlib import nullcontext

import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import AcquisitionType, Coupling, RegenerationMode, TerminalConfiguration

import rig
from daq.extras.ni_device.errors import DaqError
from daq.extras.pytest_plugin import transfers
from daq.extras.pytest_plugin.bench import open_bench
from daq.extras.pytest_plugin.description import BenchError
from rig.core.base.errors import RecordingError, SceneError
from tests.daq.client import raises_code

RATE = 5120.0
TWO_MODULES = ("NI 9234", "NI 9263")


@pytest.fixture
def open_for_test():
    """Return a function that opens a bench until the end of the test."""
    opened = []

    def open_and_keep(*arguments, **settings):
        opened.append(open_bench(*arguments, **settings))
        return opened[-1]

    yield open_and_keep
    for bench in opened:
        bench.close()


def task_on(bench):
    return nidaqmx.Task(grpc_options=bench.grpc_options)


def read_finite(bench, channels, samples, rate=RATE, coupling=Coupling.DC):
    """Return samples of inputs, from the start of a finite task on, shape (channels, samples)."""
    with task_on(bench) as task:
        channel = task.ai_channels.add_ai_voltage_chan(channels, min_val=-5.0, max_val=5.0)
        channel.ai_coupling = coupling
        task.timing.cfg_samp_clk_timing(rate, samps_per_chan=samples)
        return np.atleast_2d(task.read(samples))


def continuous(bench, channels="cDAQ1Mod1/ai0", **timing):
    """Return a continuous input task."""
    task = task_on(bench)
    task.ai_channels.add_ai_voltage_chan(channels)
    task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS, **timing)
    return task


@pytest.fixture
def open_with_waits(open_for_test, monkeypatch):
    """Return a function that opens a bench on which time passes while the test waits, as the fixture of users does."""

    def open_and_replace(*arguments, **settings):
        bench = open_for_test(*arguments, **settings)
        for owner, name, value in bench.callback_waits.replacements():
            monkeypatch.setattr(owner, name, value)
        return bench

    return open_and_replace


def compute_for(seconds):
    """Use the processor for a wall-clock time [s]."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        pass


@pytest.mark.parametrize("compute_s", [0.0, 0.3])
def test_callback_arrives_while_program_waits(open_with_waits, compute_s):
    counts, has_three, elapsed = [], threading.Event(), []
    bench = open_with_waits(TWO_MODULES)
    with continuous(bench, samps_per_chan=10_000) as task:

        def read_block(_task, _event, n_samples, _data):
            counts.append(len(task.read(n_samples)))
            elapsed.append(bench.elapsed)
            compute_for(compute_s)
            elapsed.append(bench.elapsed)
            if len(counts) == 3:
                has_three.set()
            return 0

        task.register_every_n_samples_acquired_into_buffer_event(500, read_block)
        task.start()
        assert has_three.wait(30.0)
        assert bench.elapsed == elapsed[-1] < 0.32
    assert counts == [500, 500, 500]
    assert elapsed[::2] == elapsed[1::2]


def test_queue_receives_blocks_of_callbacks(open_with_waits):
    blocks, bench = queue.Queue(), open_with_waits(TWO_MODULES)
    with continuous(bench, samps_per_chan=10_000) as task:
        task.register_every_n_samples_acquired_into_buffer_event(
            500, lambda _task, _event, n_samples, _data: blocks.put(task.read(n_samples)) or 0
        )
        task.start()
        assert [len(blocks.get(timeout=1.0)) for _ in range(3)] == [500, 500, 500]
        assert bench.elapsed < 0.32
    with pytest.raises(queue.Empty):
        blocks.get(timeout=0.01)


def test_computing_program_gets_no_bench_time(open_with_waits):
    bench = open_with_waits(TWO_MODULES)
    with continuous(bench) as task:
        task.register_every_n_samples_acquired_into_buffer_event(500, lambda *_: 0)
        task.start()
        begin = bench.elapsed
        compute_for(0.2)
        assert bench.elapsed == begin


def test_callback_may_wait_for_the_program(open_with_waits, monkeypatch):
    monkeypatch.setattr("daq.extras.pytest_plugin.callback_waits._MAX_CALLBACK_S", 0.05)
    resume, bench = threading.Event(), open_with_waits(TWO_MODULES)
    with continuous(bench, samps_per_chan=100_000) as task:
        task.register_every_n_samples_acquired_into_buffer_event(500, lambda *_: resume.wait() - 1)
        task.start()
        begin = bench.elapsed
        bench.sleep(1.0)
        passed = bench.elapsed - begin
        resume.set()
    assert passed == pytest.approx(1.0, abs=1e-4)


def test_timeout_of_wait_is_bench_time(open_with_waits):
    bench, never = open_with_waits(TWO_MODULES), threading.Event()
    with continuous(bench, samps_per_chan=100_000) as task:
        task.register_every_n_samples_acquired_into_buffer_event(50_000, lambda *_: 0)
        task.start()
        begin = bench.elapsed
        assert not never.wait(2.0123)
        assert bench.elapsed - begin == pytest.approx(2.0123, abs=1e-4)


@pytest.mark.parametrize("pause_s", [0.0, 0.05])
def test_reading_thread_keeps_pace_with_sleep(open_with_waits, pause_s):
    bench, counts, has_ended = open_with_waits(TWO_MODULES), [], threading.Event()
    with continuous(bench, samps_per_chan=10_000) as task:

        def read_blocks():
            while not has_ended.is_set():
                counts.append(len(task.read(512)))
                bench.sleep(pause_s)

        thread = threading.Thread(target=read_blocks)
        task.start()
        thread.start()
        for _ in range(5):
            bench.sleep(0.4)
        has_ended.set()
        thread.join()
    # 20 blocks in 2 s; the thread may finish some more before it is stopped.
    assert 19 <= len(counts) < 40


def test_writing_thread_keeps_pace_with_reads(open_with_waits):
    bench, errors, has_ended = open_with_waits(TWO_MODULES), [], threading.Event()
    with continuous(bench) as inputs, task_on(bench) as outputs:
        outputs.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        outputs.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        outputs.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        outputs.out_stream.output_buf_size = 1536
        outputs.write(np.zeros(1024))

        def write_blocks():
            try:
                while not has_ended.is_set():
                    outputs.write(np.zeros(512))
            except nidaqmx.DaqError as error:
                errors.append(error)

        thread = threading.Thread(target=write_blocks)
        outputs.start()
        thread.start()
        for _ in range(20):
            inputs.read(512)
        has_ended.set()
        thread.join()
    assert not errors


def test_late_thread_does_not_stop_time(open_with_waits):
    bench, resume = open_with_waits(TWO_MODULES), threading.Event()

    def sleep_and_compute():
        bench.sleep(0.1)
        resume.wait()

    with continuous(bench) as task:
        task.start()
        thread = threading.Thread(target=sleep_and_compute)
        thread.start()
        bench.sleep(1.0)
        assert bench.elapsed == pytest.approx(1.0, abs=1e-4)
        resume.set()
        thread.join()


def test_error_of_bench_reaches_waiting_test(open_with_waits):
    def fail_later(times):
        if times[0] > 0.1:
            raise ArithmeticError("no voltage")
        return 0.0 * times

    bench = open_with_waits(TWO_MODULES, sources={"ai0": fail_later})
    with continuous(bench) as task:
        task.register_every_n_samples_acquired_into_buffer_event(500, lambda *_: 0)
        task.start()
        with pytest.raises(DaqError, match="no voltage"):
            threading.Event().wait(5.0)


@pytest.mark.parametrize("rate", [5120.0, 51200.0, 51200.0 / 7])
def test_wire_carries_output_to_input(open_for_test, rate):
    bench = open_for_test(TWO_MODULES, wires=["ao1 -> ai2"])
    volts = np.random.default_rng(1).uniform(-4.0, 4.0, 500)
    with task_on(bench) as inputs, task_on(bench) as outputs:
        inputs.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai1:2").ai_coupling = Coupling.DC
        outputs.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao1")
        for task in (inputs, outputs):
            task.timing.cfg_samp_clk_timing(rate, samps_per_chan=500)
        outputs.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        outputs.write(volts)
        outputs.start()
        unconnected, wired = np.array(inputs.read(500))
    assert not unconnected.any()
    # The resolution of 24 bits at ±5 V is 0.6 µV.
    assert wired == pytest.approx(volts, abs=1e-6)
    bench.assert_written("ao1", volts, tolerance=0.0)
    assert bench.read("ai2") == pytest.approx(wired, abs=0.0)


def test_sources_give_their_voltages(open_for_test):
    sources = {"ai0": "0.5 V", "ai1": {"offset": 1, "amplitude": "2 V", "frequency": "50 Hz"}, "ai2": np.cos}
    bench = open_for_test(["NI 9234"], sources=sources)
    time = np.arange(512) / RATE
    expected = [np.full(512, 0.5), 1.0 + 2.0 * np.sin(100.0 * np.pi * time), np.cos(time)]
    assert read_finite(bench, "cDAQ1Mod1/ai0:2", 512) == pytest.approx(np.array(expected), abs=1e-6)


def test_ac_coupling_removes_constant_voltage(open_for_test):
    sources = {"ai0": lambda time: 1.0 + (time >= 1.0)}
    volts = read_finite(open_for_test(["NI 9234"], sources=sources), "cDAQ1Mod1/ai0", 10240, coupling=Coupling.AC)[0]
    assert not volts[:5120].any()
    # The step decays with the time constant of the corner at 0.5 Hz.
    assert volts[5120:] == pytest.approx(np.exp(-2.0 * np.pi * 0.5 * np.arange(1, 5121) / RATE), abs=1e-6)


def test_voltage_beyond_range_is_clipped_and_flagged(open_for_test):
    bench = open_for_test(["NI 9234"], sources={"ai1": "6 V"})
    with continuous(bench, "cDAQ1Mod1/ai0:1") as task:
        task.ai_channels[1].ai_coupling = Coupling.DC
        assert np.max(task.read(100)) == pytest.approx(5.0, abs=1e-5)
        assert task.in_stream.overloaded_chans_exist
        assert task.in_stream.overloaded_chans == ["cDAQ1Mod1/ai1"]


def test_limits_choose_range_and_resolution(open_for_test):
    bench = open_for_test(["USB-6211"], sources={"ai0": "0.123456 V"})
    readings = []
    for limit in (0.2, 10.0):
        with task_on(bench) as task:
            task.ai_channels.add_ai_voltage_chan("Dev1/ai0", min_val=-limit, max_val=limit)
            readings.append(task.read())
    # 16 bits of ±0.2 V, and of ±10 V.
    assert readings == pytest.approx([round(0.123456 / 0.4 * 2**16) * 0.4 / 2**16, 405 * 20.0 / 2**16], abs=1e-12)


def test_names_are_those_of_description(open_for_test):
    bench = open_for_test(
        {
            "chassis": "cdaq 9174",
            "modules": {
                "myMod2": "ni9234",
                "myMod1": "NI 9263",
                "Dev7": {"product_type": "USB-6218", "inputs": 32, "ranges": ["5 V", "10 V"]},
            },
            "wires": ["ao0 -> myMod2/ai0"],
        }
    )
    system = nidaqmx.system.System.remote(bench.grpc_options)
    types = {device.name: device.product_type for device in system.devices}
    assert types == {"my": "cDAQ-9174", "myMod2": "NI 9234", "myMod1": "NI 9263", "Dev7": "USB-6218"}
    assert [module.name for module in system.devices["my"].chassis_module_devices] == ["myMod1", "myMod2"]
    assert system.devices["Dev7"].ai_voltage_rngs == [-5.0, 5.0, -10.0, 10.0]
    with raises_code(-200220), task_on(bench) as task:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0")


@pytest.mark.parametrize(
    ("bench", "settings", "message"),
    [
        (["NI 9235"], {}, r"modules\[1\].product_type: no data sheet for 'NI 9235'.*\{product_type: USB-6211, inputs"),
        ([], {}, "modules: got .*a list of length 1 or more"),
        (TWO_MODULES, {"wires": ["ao0 ai0"]}, "'ao0 ai0' is not a wire. Write it as ao0 -> ai0"),
        (TWO_MODULES, {"wires": ["ao4 -> ai0"]}, "no output 'ao4'. Its outputs are cDAQ1Mod2/ao0, .*ao3"),
        (["NI 9234", "NI 9234"], {"sources": {"ai1": 1}}, "ambiguous. Choose cDAQ1Mod1/ai1 or cDAQ1Mod2/ai1"),
        (TWO_MODULES, {"wires": ["ao0 -> ai0"], "sources": {"ai0": "1 V"}}, "ai0 is connected twice"),
        (TWO_MODULES, {"sources": {"ai0": "1 kg"}}, 'sources.ai0.offset: got "1 kg"; expected a voltage'),
        ([{"product_type": "X", "inputs": 1, "terminals": []}], {}, "terminals: got .*a list of length 1 or more"),
        ([{"product_type": "X", "inputs": 1, "aggregate": 3e5}], {}, "aggregate: 300000 Hz exceeds fastest, 250000 Hz"),
        ([{"product_type": "X", "inputs": 1, "timebase": 1e3}], {}, "timebase: 1000 Hz is below the fastest rate"),
        ({"modules": {"cDAQ1Mod0": "NI 9234"}}, {}, "its name 'cDAQ1Mod0' does not state"),
        (TWO_MODULES, {"pulses": {"ai0": "1 Hz"}}, "pulses: 'ai0' is not a trigger terminal. Give a name such as PFI0"),
        (TWO_MODULES, {"pulses": {"Dev1/PFI0": "1 Hz"}}, "pulses: 'Dev1/PFI0' is not a trigger terminal"),
        ({"modules": {"Dev1": 7}}, {}, r"modules\[1\].product_type: got 7"),
        ({"modules": {"Dev1": "USB-6001", "dev1": "USB-6002"}}, {}, "'Dev1' is the name of two devices"),
        ({"modules": {"mine": "NI 9234"}}, {}, "NI 9234 is in a chassis, which its name 'mine' does not state"),
        ({"module": ["NI 9234"]}, {}, "unknown key 'module'|module: .*modules"),
        (["NI 9234"], {"sources": {"ai0": {"amplitude": "1 V"}}}, "sources.ai0.frequency: missing"),
        ({"chassis": "cDAQ-9999", "modules": ["NI 9234"]}, {}, "chassis: no chassis 'cDAQ-9999' is known"),
        ({"chassis": "cDAQ-9174", "modules": 5 * ["NI 9234"]}, {}, "cDAQ1Mod5 is in no slot: cDAQ-9174 has 4 slots"),
        ("bare-structure", {"wires": ["ao0 -> ai0"]}, "cannot be combined with a scene"),
        ("missing.yaml", {}, "missing.yaml: the file does not exist"),
        (42, {}, "expected a name, a path, a mapping or a rig.Scene"),
    ],
)
def test_invalid_bench_is_reported(bench, settings, message):
    with pytest.raises(SceneError, match=message) as caught:
        open_bench(bench, **settings)
    assert isinstance(caught.value, BenchError) or bench in ("missing.yaml", 42)


def test_mistyped_key_in_file_is_named(tmp_path):
    (tmp_path / "bench.yaml").write_text("module: [NI 9234]")
    with pytest.raises(BenchError, match=r"bench.yaml: module: unknown key"):
        open_bench(tmp_path / "bench.yaml")


@pytest.mark.parametrize("device", ["USB-6211", "USB-6001"])
def test_device_without_analog_trigger_rejects_it(open_for_test, device):
    bench = open_for_test([device])
    assert not nidaqmx.system.System.remote(bench.grpc_options).devices["Dev1"].anlg_trig_supported
    with task_on(bench) as task:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
        task.timing.cfg_samp_clk_timing(1000.0, samps_per_chan=10)
        task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0")
        with raises_code(-200077, f"{device} has no analog trigger"):
            task.start()


def test_limits_have_no_rounding_errors(open_for_test):
    with task_on(open_for_test()) as task:
        channel = task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0")
        assert (channel.ai_min, channel.ai_max) == (-5.0, 5.0)


def test_failing_source_is_reported(open_for_test):
    bench = open_for_test(["NI 9234"], sources={"ai0": lambda time: [1.0, 2.0, 3.0]})
    with raises_code(-1, "the source at cDAQ1Mod1/ai0 has failed"):
        read_finite(bench, "cDAQ1Mod1/ai0", 100)


def test_source_without_number_is_reported(open_for_test):
    bench = open_for_test(["NI 9234"], sources={"ai0": lambda time: time * np.nan})
    with raises_code(-1, "the voltage is not a number"):
        read_finite(bench, "cDAQ1Mod1/ai0", 100)


def test_terminals_of_task_are_those_of_chassis(open_for_test):
    bench = open_for_test(["NI 9234"])
    with continuous(bench) as task:
        terminals = nidaqmx.system.System.remote(bench.grpc_options).devices["cDAQ1"].terminals
        assert {task.triggers.start_trigger.term, task.timing.samp_clk_term} <= set(terminals)


def test_saved_task_is_loaded(open_for_test):
    tasks = {
        "finite": {"channels": "cDAQ1Mod1/ai0:1", "rate": "5120 Hz", "samples": 100},
        "drive": {"channels": "cDAQ1Mod2/ao0"},
    }
    bench = open_for_test({"modules": list(TWO_MODULES), "tasks": tasks})
    saved = nidaqmx.system.System.remote(bench.grpc_options).tasks
    assert sorted(saved.task_names) == ["drive", "finite"]
    with saved["finite"].load() as task:
        assert np.shape(task.read(nidaqmx.constants.READ_ALL_AVAILABLE)) == (2, 100)
    with pytest.raises(BenchError, match=r"tasks\.wrong: there is no device 'Dev1'"):
        open_bench({"modules": ["NI 9234"], "tasks": {"wrong": {"channels": "Dev1/ai0"}}})


def test_separate_device_is_not_a_module(open_for_test):
    system = nidaqmx.system.System.remote(open_for_test(["USB-6001", "NI 9215"]).grpc_options)
    categories = {device.name: device.product_category for device in system.devices}
    assert categories["Dev1"] == nidaqmx.constants.ProductCategory.USBDAQ
    assert categories["cDAQ1Mod1"] == nidaqmx.constants.ProductCategory.C_SERIES_MODULE


@pytest.mark.parametrize(
    ("device", "request_hz", "timebase_hz", "divisor"),
    [
        ("NI 9215", 44100.0, 80e6, 1814),
        ("USB-6211", 44100.0, 20e6, 453),
        ("PCIe-6361", 33333.3, 100e6, 3000),
        ("USB-6001", 7000.0, 80e6, 11428),
    ],
)
def test_rate_divides_timebase(open_for_test, device, request_hz, timebase_hz, divisor):
    with task_on(open_for_test({"modules": {"cDAQ1Mod1": device}})) as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0")
        task.timing.cfg_samp_clk_timing(request_hz, samps_per_chan=10)
        assert task.timing.samp_clk_rate == timebase_hz / divisor
        assert (task.timing.samp_clk_timebase_rate, task.timing.samp_clk_timebase_div) == (timebase_hz, divisor)
        task.timing.samp_clk_rate = task.timing.samp_clk_rate
        assert task.timing.samp_clk_rate == timebase_hz / divisor
        assert len(task.read(10)) == 10


def test_output_follows_clock_of_inputs(open_for_test):
    bench = open_for_test(["NI 9215", "NI 9263"], wires=["ao0 -> ai0"])
    with task_on(bench) as inputs, task_on(bench) as outputs:
        inputs.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0")
        outputs.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        inputs.timing.cfg_samp_clk_timing(44100.0, samps_per_chan=20_000)  # coerced to 80 MHz / 1814
        outputs.timing.cfg_samp_clk_timing(44100.0, "/cDAQ1/ai/SampleClock", samps_per_chan=20_000)
        volts = np.arange(20_000) * 1e-4
        outputs.write(volts)
        outputs.start()
        assert np.array(inputs.read(20_000)) == pytest.approx(volts, abs=4e-4)  # 16 bits of ±10 V


def test_terminals_belong_to_their_device(open_for_test):
    bench = open_for_test(["USB-6211", "USB-6211"], wires=["Dev1/ao0 -> Dev1/ai0"])
    with task_on(bench) as first, task_on(bench) as second, task_on(bench) as outputs, task_on(bench) as waiting:
        first.ai_channels.add_ai_voltage_chan("Dev1/ai0")
        second.ai_channels.add_ai_voltage_chan("Dev2/ai0")
        outputs.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        waiting.ao_channels.add_ao_voltage_chan("Dev1/ao1")
        first.timing.cfg_samp_clk_timing(1000.0, samps_per_chan=100)
        second.timing.cfg_samp_clk_timing(5000.0, samps_per_chan=100)
        outputs.timing.cfg_samp_clk_timing(5000.0, "/Dev1/ai/SampleClock", samps_per_chan=100)
        waiting.timing.cfg_samp_clk_timing(5000.0, samps_per_chan=100)
        waiting.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev2/ai/StartTrigger")
        outputs.write(np.arange(100) * 0.01)
        outputs.start()
        waiting.write(np.zeros(100))
        waiting.start()
        assert np.array(first.read(100)) == pytest.approx(np.arange(100) * 0.01, abs=4e-4)  # 16 bits of ±10 V
        assert waiting.out_stream.total_samp_per_chan_generated == 0
        second.read(100)
        waiting.wait_until_done()


@pytest.mark.parametrize(
    ("pulses", "elapsed"),
    [({"PFI0": "4 Hz"}, 0.25), ({"cDAQ1Mod2/PFI0": 2}, 0.5), ({"PFI1": "1 Hz"}, None), ({}, None)],
)
def test_input_trigger_requires_pulses(open_for_test, pulses, elapsed):
    bench = open_for_test(pulses=pulses)
    missing = raises_code(-200284, "start trigger has not occurred: the bench has no pulses at /cDAQ1/PFI0")
    with continuous(bench) as task, nullcontext() if elapsed else missing:
        task.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/PFI0")
        task.read(1, timeout=2.0)
        assert elapsed <= bench.elapsed < elapsed + 0.02


def test_output_trigger_requires_pulses(open_for_test):
    with task_on(open_for_test()) as output:
        output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output.timing.cfg_samp_clk_timing(1000.0, samps_per_chan=10)
        output.triggers.start_trigger.cfg_dig_edge_start_trig("PFI0")
        output.write(np.zeros(10))
        output.start()
        with raises_code(-200560, "no pulses at PFI0"):
            output.wait_until_done(2.0)


@pytest.mark.parametrize(
    ("device", "interval", "fits"), [("PCIe-6361", 300, False), ("USB-6211", 300, True), ("PCIe-6361", 250, True)]
)
def test_event_interval_divides_buffer_for_dma(open_for_test, device, interval, fits):
    with task_on(open_for_test([device])) as task:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
        task.timing.cfg_samp_clk_timing(1000.0, sample_mode=AcquisitionType.CONTINUOUS)
        task.in_stream.input_buf_size = 500
        task.register_every_n_samples_acquired_into_buffer_event(interval, lambda *_: 0)
        with nullcontext() if fits else raises_code(-200877, "500 samples is not a multiple of the 300"):
            task.start()


@pytest.mark.parametrize("follower", ["NI 9215", "NI 9205"])
@pytest.mark.parametrize("order", [1, -1])
def test_delta_sigma_module_determines_common_rate(open_for_test, follower, order):
    bench = open_for_test(["NI 9234", follower], sources={"cDAQ1Mod1/ai0": "1 V", "cDAQ1Mod2/ai0": "2 V"})
    with task_on(bench) as task:
        for name in ("cDAQ1Mod1/ai0", "cDAQ1Mod2/ai0")[::order]:
            task.ai_channels.add_ai_voltage_chan(name, min_val=-5.0, max_val=5.0).ai_coupling = Coupling.DC
        task.timing.cfg_samp_clk_timing(10_000.0, samps_per_chan=10)
        assert task.timing.samp_clk_rate == 10240.0
        assert (task.timing.samp_clk_timebase_rate, task.timing.samp_clk_timebase_div) == (13.1072e6, 1280)
        assert np.mean(task.read(10), axis=1) == pytest.approx([1.0, 2.0][::order], abs=1e-3)


@pytest.mark.parametrize("modules", [["NI 9215", "NI 9263"], ["NI 9215", "NI 9264"], ["NI 9215", "NI 9263", "NI 9234"]])
def test_modules_of_chassis_stay_synchronous(open_for_test, modules):
    bench = open_for_test(modules, wires=["ao0 -> cDAQ1Mod1/ai0"])
    with task_on(bench) as inputs, task_on(bench) as outputs:
        inputs.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0")
        outputs.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        for task in (inputs, outputs):
            task.timing.cfg_samp_clk_timing(24_100.0, samps_per_chan=30_000)
        assert inputs.timing.samp_clk_rate == outputs.timing.samp_clk_rate
        outputs.triggers.start_trigger.cfg_dig_edge_start_trig("/cDAQ1/ai/StartTrigger")
        volts = np.arange(30_000) * 3e-4
        outputs.write(volts)
        outputs.start()
        assert np.array(inputs.read(30_000)) == pytest.approx(volts, abs=4e-4)  # 16 bits of ±10 V


def test_output_rate_divides_timebase_of_chassis(open_for_test):
    with task_on(open_for_test(["NI 9263"])) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod1/ao0")
        task.timing.cfg_samp_clk_timing(44_100.0, samps_per_chan=10)
        assert (task.timing.samp_clk_timebase_rate, task.timing.samp_clk_timebase_div) == (80e6, 1814)
        assert task.timing.samp_clk_rate == 80e6 / 1814


def test_output_rate_is_at_most_fastest(open_for_test):
    with task_on(open_for_test(["PCIe-6361"])) as task:
        task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        task.timing.cfg_samp_clk_timing(2.86e6, samps_per_chan=10)
        assert task.timing.samp_clk_rate == task.timing.samp_clk_max_rate == 100e6 / 35


def test_slowest_output_module_limits_rate(open_for_test):
    with task_on(open_for_test(["NI 9263", "NI 9264"])) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod1/ao0, cDAQ1Mod2/ao0")
        assert task.timing.samp_clk_max_rate == 25e3
        with raises_code(-200077, "NI 9264: got 50000 Hz"):
            task.timing.cfg_samp_clk_timing(50e3, samps_per_chan=10)


def test_divisor_of_exact_output_rate_returns_rate(open_for_test):
    with task_on(open_for_test(["NI 9234", "NI 9263"])) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        task.timing.cfg_samp_clk_timing(10e3, samps_per_chan=10)
        assert (task.timing.samp_clk_timebase_rate, task.timing.samp_clk_timebase_div) == (80e6, 8000)
        task.timing.samp_clk_timebase_div = 8000
        assert task.timing.samp_clk_rate == 10e3


def test_highest_rate_of_shared_converter_is_accepted(open_for_test):
    device = {"product_type": "X", "inputs": 4, "fastest": "30 kHz", "aggregate": "30 kHz"}
    with task_on(open_for_test([device])) as task:
        task.ai_channels.add_ai_voltage_chan("Dev1/ai0:1")
        task.timing.cfg_samp_clk_timing(task.timing.samp_clk_max_rate, samps_per_chan=10)
        assert len(task.read(10)[0]) == 10


@pytest.mark.parametrize("device", ["USB-6211", "NI 9205"])
def test_shared_converter_limits_rate(open_for_test, device):
    bench = open_for_test({"modules": {"cDAQ1Mod1": device}})
    properties = nidaqmx.system.System.remote(bench.grpc_options).devices["cDAQ1Mod1"]
    assert (properties.ai_max_multi_chan_rate, properties.ai_simultaneous_sampling_supported) == (250e3, False)
    for rate, fits in ((15625.0, True), (16000.0, False)):
        with task_on(bench) as task:
            task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0:15", terminal_config=TerminalConfiguration.RSE)
            task.timing.cfg_samp_clk_timing(rate, samps_per_chan=10)
            assert task.timing.samp_clk_max_rate == 15625.0
            with nullcontext() if fits else raises_code(-200081, "15625 S/s at most with 16 channels"):
                task.start()


def test_limiting_converter_is_named(open_for_test):
    with task_on(open_for_test(["NI 9215", "NI 9205"])) as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0, cDAQ1Mod2/ai0:7")
        task.timing.cfg_samp_clk_timing(50e3, samps_per_chan=10)
        with raises_code(-200081, "cDAQ1Mod2 converts one channel after the other, at 31250 S/s at most with 8"):
            task.start()


@pytest.mark.parametrize(
    ("device", "channel", "supported", "default"),
    [
        ("NI 9215", "ai0", {"DIFF"}, "DIFF"),
        ("NI 9201", "ai0", {"RSE"}, "RSE"),
        ("USB-6211", "ai7", {"RSE", "NRSE", "DIFF"}, "DIFF"),
        ("USB-6211", "ai8", {"RSE", "NRSE"}, "NRSE"),
        ("NI 9205", "ai16", {"RSE", "NRSE", "DIFF"}, "DIFF"),
        ("USB-6001", "ai4", {"RSE"}, "RSE"),
        ({"product_type": "X", "inputs": 16, "terminals": ["nrse", "differential"]}, "ai8", {"NRSE"}, "NRSE"),
    ],
)
def test_terminal_configurations_are_those_of_input(open_for_test, device, channel, supported, default):
    bench, name = open_for_test({"modules": {"cDAQ1Mod1": device}}), f"cDAQ1Mod1/{channel}"
    for configuration in TerminalConfiguration:
        is_supported = configuration.name in {*supported, "DEFAULT"}
        with task_on(bench) as task, nullcontext() if is_supported else raises_code(-200077, configuration.name[:5]):
            added = task.ai_channels.add_ai_voltage_chan(name, terminal_config=configuration)
            if configuration == TerminalConfiguration.DEFAULT:
                assert added.ai_term_cfg.name == default


@pytest.mark.parametrize("device", ["NI 9215", "USB-6211"])
def test_device_without_supply_rejects_excitation(open_for_test, device):
    bench = open_for_test({"modules": {"cDAQ1Mod1": device}})
    with task_on(bench) as task, raises_code(-200077, "does not support excitation INTERNAL. Choose EXTERNAL, NONE"):
        task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0")


def test_supply_current_is_coerced(open_for_test):
    with task_on(open_for_test(["NI 9234"])) as task:
        channel = task.ai_channels.add_ai_accel_chan("cDAQ1Mod1/ai0")  # NI's default of 4 mA
        assert (channel.ai_excit_val, channel.ai_excit_actual_val) == (0.002, 0.002)


def test_output_module_has_no_measurement(open_for_test):
    with task_on(open_for_test()) as task, raises_code(-200431, "outputs only; choose Voltage"):
        task.ao_channels.add_ao_current_chan("cDAQ1Mod2/ao0")


def test_sleep_passes_bench_time_during_use(open_for_test):
    bench = open_for_test()
    bench.sleep(0.001)
    assert bench.elapsed == 0.0
    with continuous(bench) as task:
        task.start()
        bench.sleep(1.0)
        assert bench.elapsed == pytest.approx(1.0, abs=1e-4)


def test_different_output_is_described(open_for_test):
    bench = open_for_test()
    with task_on(bench) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        for volts in (1.0, 2.0, 3.5):
            task.write(volts)
    bench.assert_written("ao0", [1.0, 2.0, 3.5])
    with pytest.raises(AssertionError, match=r"ao0: 1 of 3 .* by up to 0.5 V. Sample 2 is 3.5 V; expected 3 V"):
        bench.assert_written("ao0", [1.0, 2.0, 3.0])
    with pytest.raises(AssertionError, match="3 samples were written; expected 2"):
        bench.assert_written("cDAQ1Mod2/ao0", [1.0, 2.0])
    with pytest.raises(AssertionError, match="expected nan V"):
        bench.assert_written("ao0", [1.0, 2.0, np.nan])


def test_discarded_samples_are_reported(open_for_test, monkeypatch):
    monkeypatch.setattr(transfers, "_MAX_BYTES", 1000)
    bench = open_for_test()
    with continuous(bench) as task:
        task.read(100)
        assert bench.read("ai0").size == 100
        task.read(100)
    assert len(bench.transfers.latest) == 1
    with pytest.raises(RecordingError, match="1 reads and writes were discarded"):
        bench.read("ai0")


# Faults


def test_call_fails_once_after_successful_calls(open_for_test):
    bench = open_for_test()
    bench.faults.fail("read", -200284, after=2)
    with continuous(bench) as task:
        task.read(10)
        task.read(10)
        with raises_code(-200284, kind=nidaqmx.errors.DaqReadError, samples=0):
            task.read(10)
        task.read(10)
        assert task.in_stream.total_samp_per_chan_acquired == 30
    with pytest.raises(BenchError, match="there is no call 'reads'"):
        bench.faults.fail("reads", -200284)


def test_failed_write_transfers_nothing(open_for_test):
    bench = open_for_test()
    bench.faults.fail("write", -200292)
    with task_on(bench) as task:
        task.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        with raises_code(-200292, kind=nidaqmx.errors.DaqWriteError, samples=0):
            task.write(1.0)
        task.write(2.0)
    assert bench.written("ao0").tolist() == [2.0]


def test_overwritten_samples_are_missing_afterwards(open_for_test):
    bench = open_for_test(["NI 9234"], sources={"ai0": lambda time: time})
    bench.faults.fail("read", -200279, after=1)
    with continuous(bench, samps_per_chan=1000) as task:
        task.ai_channels[0].ai_coupling = Coupling.DC
        task.read(1000)
        with raises_code(-200279):
            task.read(1000)
        samples = np.array(task.read(1000))
        # The buffer has 10 000 samples at this rate: after the overflow by one, the oldest sample has number 1001.
        assert samples[0] == pytest.approx(1001 / RATE, abs=1e-6)


def test_full_buffer_overflows_until_restart(open_for_test):
    bench = open_for_test()
    bench.faults.fail("read", -200279)
    with continuous(bench) as task:
        task.start()
        for _ in range(2):
            with raises_code(-200279):
                task.read(10)
            bench.sleep(10 / RATE)
        task.stop()
        assert len(task.read(10)) == 10


def test_lost_samples_end_acquisition_until_restart(open_for_test):
    bench = open_for_test()
    bench.faults.fail("read", -200361, after=1)
    with continuous(bench) as task:
        task.read(10)
        for _ in range(2):
            with raises_code(-200361):
                task.read(10)
        task.stop()
        assert len(task.read(10)) == 10


def test_overload_ends_after_its_time(open_for_test):
    bench = open_for_test(TWO_MODULES)
    with continuous(bench, "cDAQ1Mod1/ai0:1") as task:
        task.read(100)
        bench.faults.overload("ai1", seconds=100 / RATE)
        data = np.array(task.read(200))
        assert task.in_stream.overloaded_chans_exist
        assert task.in_stream.overloaded_chans == ["cDAQ1Mod1/ai1"]
        assert (not data[0].any(), np.count_nonzero(data[1])) == (True, 100)
        assert data[1].max() == pytest.approx(5.0, abs=1e-6)


def test_scene_can_be_overloaded(open_for_test):
    bench = open_for_test(rig.load("bare-structure", {"converter.bits": 16, "converter.range": "10 V"}))
    bench.faults.overload("ai1", seconds=1.0)
    with continuous(bench) as task:
        task.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai1", min_val=-10.0, max_val=10.0)
        assert min(task.read(100)[1]) == pytest.approx(10.0, abs=1e-3)


def test_reserved_device_is_released(open_for_test):
    bench = open_for_test()
    bench.faults.reserve("cDAQ1Mod1")
    with continuous(bench) as task:
        with raises_code(-50103, "another client"):
            task.start()
        bench.faults.release("cDAQ1Mod1")
        task.start()
        with pytest.raises(BenchError, match="there is no device 'cDAQ2Mod1'"):
            bench.faults.reserve("cDAQ2Mod1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("read", 200279), "no error 200279. Give -200279"),
        (("read", -12345), "no error -12345. Choose a code"),
        (("read", -200279, -1), "after is -1"),
    ],
)
def test_impossible_fault_is_rejected(open_for_test, arguments, message):
    with pytest.raises(BenchError, match=message):
        open_for_test().faults.fail(*arguments)


def test_reset_ends_tasks_and_faults(open_for_test):
    bench = open_for_test()
    kept, open_task = continuous(bench), continuous(bench)
    open_task.start()
    bench.faults.fail("read", -200279)
    bench.faults.reserve("cDAQ1Mod2")
    bench.faults.unplug("cDAQ1Mod2")
    bench.faults.overload("ai0", seconds=10.0)
    with pytest.warns(UserWarning, match=r"faults.fail\('read', -200279\) has had no effect"):
        bench.reset(keep=[kept.name])
    assert bench.open_tasks == [kept.name]
    assert not np.any(kept.read(10))
    with task_on(bench) as output:
        output.ao_channels.add_ao_voltage_chan("cDAQ1Mod2/ao0")
        output.write(1.0)


def test_unused_fault_leaves_nothing_open():
    bench = open_bench()
    for end in (bench.reset, bench.close):
        continuous(bench)
        bench.faults.fail("read", -200279)
        with pytest.raises(UserWarning, match="has had no effect"):
            end()
        assert bench.open_tasks == []
    with pytest.raises(ValueError, match="closed channel"):
        task_on(bench)


def test_one_device_is_plugged_in(open_for_test):
    bench = open_for_test()
    for device in ("cDAQ1Mod1", "cDAQ1Mod2"):
        bench.faults.unplug(device)
    bench.faults.plug_in("cDAQ1Mod1")
    assert nidaqmx.system.System.remote(bench.grpc_options).devices.device_names == ["cDAQ1", "cDAQ1Mod1"]
    with pytest.raises(BenchError, match=r"Mod1 is not unplugged. Give one of cDAQ1Mod2"):
        bench.faults.plug_in("cDAQ1Mod1")


def test_plugging_in_module_connects_its_chassis(open_for_test):
    bench = open_for_test()
    bench.faults.unplug("cDAQ1")
    bench.faults.plug_in("cDAQ1Mod1")
    names = nidaqmx.system.System.remote(bench.grpc_options).devices.device_names
    assert sorted(names) == ["cDAQ1", "cDAQ1Mod1"]


@pytest.mark.parametrize("device", ["cDAQ1Mod1", "cDAQ1"])
def test_unplugged_device_fails_until_plugged_in(open_for_test, device):
    bench = open_for_test()
    system = nidaqmx.system.System.remote(bench.grpc_options)
    with continuous(bench) as task:
        task.read(10)
        bench.faults.unplug(device)
        assert device not in system.devices.device_names
        with raises_code(-201003, "cDAQ1Mod1" if device.endswith("Mod1") else ""):
            task.read(10)
        with raises_code(-200220), task_on(bench) as other:
            other.ai_channels.add_ai_voltage_chan("cDAQ1Mod1/ai0")
        bench.faults.plug_in()
        assert sorted(system.devices.device_names) == ["cDAQ1", "cDAQ1Mod1", "cDAQ1Mod2"]
        with raises_code(-201003):
            task.stop()
        assert len(task.read(10)) == 10


def test_waiting_read_ends_when_device_is_unplugged(open_for_test):
    bench = open_for_test(clock="real")
    with continuous(bench) as task:
        task.triggers.start_trigger.cfg_anlg_edge_start_trig("cDAQ1Mod1/ai0", trigger_level=1.0)
        task.start()
        bench.faults.unplug("cDAQ1Mod1")
        with raises_code(-201003):
            task.read(10, timeout=60.0)
