"""Tasks of NI's client package nidaqmx on a virtual bench: inputs, outputs, timing, callbacks and polling.

The bench simulates the test rig of a scene at its own sample rate, here ten times the rate of the tasks. Its chassis
contains the simulated modules. With the fast clock, time passes as fast as the computer allows.
"""

import queue
import threading

import numpy as np
import pytest
from nidaqmx.constants import (
    READ_ALL_AVAILABLE,
    AccelUnits,
    AcquisitionType,
    AOIdleOutputBehavior,
    EveryNSamplesEventType,
    ReadRelativeTo,
    RegenerationMode,
    TaskMode,
)
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.errors import DaqError

import rig
from daq.core.virtual_bench.bench import Bench
from tests.daq.client import RATE, Task, add_inputs, add_output, connect, pass_samples, raises_code, reads_waveforms


@pytest.fixture
def chassis():
    return connect("bare-structure", "fast")


def sine_voltage(samples, frequency=20.0, amplitude=0.1):
    """Return the voltage samples of a sine, V; frequency in Hz, amplitude in V."""
    return amplitude * np.sin(2 * np.pi * frequency * np.arange(samples) / RATE)


def read_in_pieces(piece_length, total):
    """Drive the shaker and read the four inputs on the same clock; return voltages of shape (4, total).

    Each read has at most `piece_length` samples per channel.
    """
    connect("bare-structure", "fast")
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai0:3", sample_mode=AcquisitionType.CONTINUOUS)
        add_output(output_task, sine_voltage(512), sample_mode=AcquisitionType.CONTINUOUS)
        output_task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")
        output_task.start()
        input_task.start()
        lengths = [min(piece_length, total - position) for position in range(0, total, piece_length)]
        pieces = [np.array(input_task.read(length)) for length in lengths]
    return np.concatenate(pieces, axis=1)


@pytest.mark.thorough
@pytest.mark.parametrize(("piece_length", "total"), [(1, 80), (7, 200), (128, 512)])
def test_read_size_does_not_change_samples(piece_length, total):
    assert np.array_equal(read_in_pieces(piece_length, total), read_in_pieces(total, total))


def test_readings_are_response_to_drive():
    measured = read_in_pieces(512, 512)
    drive = 1e-3 * sine_voltage(512)  # The table moves 1 mm per V.
    expected = Bench(rig.load("bare-structure")).acquire(drive[None]).samples
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_requested_rate_is_coerced_to_next_higher(chassis):
    with add_inputs(Task(), "Dev1/ai0:3") as task:
        coerced = []
        for rate in (1000.0, 5000.0, 8000.0, 51200.0):
            task.timing.cfg_samp_clk_timing(rate)
            coerced.append(task.timing.samp_clk_rate)
    # The next higher rates among 51.2 kS/s divided by integers up to 31.
    assert coerced == pytest.approx([51200 / 31, 51200 / 10, 51200 / 6, 51200.0], rel=1e-15)


@reads_waveforms
def test_task_sets_sampling_rate(chassis):
    with add_inputs(Task(), "Dev1/ai3") as task:
        task.timing.cfg_samp_clk_timing(10000.0, samps_per_chan=50)
        waveform = task.read_waveform()
    assert waveform.timing.sample_interval.total_seconds() == pytest.approx(1 / 10240, rel=1e-9)


def test_excitation_of_scene_runs_at_low_rate():
    scene = rig.load("bare-structure").replace(
        test={"kind": "sine", "frequency": 2000.0, "drive": 1e-6}, converter={"rate": 10240.0}
    )
    # The rate of the task is too low for the tone of the test, 2 kHz.
    connect(scene, "fast")
    with add_inputs(Task(), "Dev1/ai0:3") as task:
        task.timing.cfg_samp_clk_timing(2048.0, samps_per_chan=50)
        assert np.any(task.read(50))


def test_unstarted_finite_task_reads_all(chassis):
    with add_inputs(Task(), "Dev1/ai0:3", samps_per_chan=64) as task:
        assert np.shape(task.read(READ_ALL_AVAILABLE)) == (4, 64)
        assert task.is_task_done()
        assert np.shape(task.read(READ_ALL_AVAILABLE)) == (4, 64)
    # The last of the 2 * 64 samples is at tick 1270 (ten ticks per sample); the position is one tick later.
    assert chassis.position == 127 * 10 + 1


def test_shape_follows_from_number_of_samples(chassis):
    with Task() as one_channel, Task() as four_channels:
        add_inputs(one_channel, "Dev1/ai0")
        add_inputs(four_channels, "Dev2/ai0:3")
        assert isinstance(one_channel.read(), float)
        assert len(one_channel.read(1)) == 1
        assert np.shape(four_channels.read()) == (4,)
        assert np.shape(four_channels.read(3)) == (4, 3)


def test_read_all_gives_available_samples(chassis):
    with add_inputs(Task(), "Dev1/ai0", sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        pass_samples(chassis, 300)
        assert len(task.read(READ_ALL_AVAILABLE)) == 300
        # All samples have been read, but the query lets the fast clock advance a little, so that polling loops end.
        assert 0 < len(task.read(READ_ALL_AVAILABLE)) < 100


def test_read_longer_than_buffer_is_complete(chassis):
    with add_inputs(Task(), "Dev1/ai0", sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.in_stream.input_buf_size = 100
        assert len(task.read(1000)) == 1000
        assert task.in_stream.curr_read_pos == 1000


def test_sensitivity_converts_volts(chassis):
    with Task() as volt_task, Task() as g_task, Task() as metric_task:
        add_inputs(volt_task, "Dev1/ai3", samps_per_chan=500)
        for task, device, units in ((g_task, 2, AccelUnits.G), (metric_task, 3, AccelUnits.METERS_PER_SECOND_SQUARED)):
            task.ai_channels.add_ai_accel_chan(
                f"Dev{device}/ai3",
                min_val=-50.0,
                max_val=50.0,
                units=units,
                sensitivity=250.0,  # mV/g
            )
            task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=500)
        for task in (g_task, metric_task, volt_task):
            task.start()
        in_volts, in_g, in_meters_per_s2 = (np.array(task.read(500)) for task in (volt_task, g_task, metric_task))
    assert np.ptp(in_volts) > 0
    volts_per_g = 0.25
    np.testing.assert_allclose(in_g, in_volts / volts_per_g, rtol=1e-14)
    np.testing.assert_allclose(in_meters_per_s2, in_volts / volts_per_g * 9.80665, rtol=1e-14)


def test_relative_positions_read_again(chassis):
    with add_inputs(Task(), "Dev1/ai3", samps_per_chan=200) as task:
        task.start()
        samples = task.read(200)
        task.in_stream.relative_to, task.in_stream.offset = ReadRelativeTo.FIRST_SAMPLE, 50
        assert task.read(10) == samples[50:60]
        task.in_stream.relative_to, task.in_stream.offset = ReadRelativeTo.MOST_RECENT_SAMPLE, -10
        assert task.read(10) == samples[-10:]


def test_channel_subset_is_read(chassis):
    with add_inputs(Task(), "Dev1/ai0:3", samps_per_chan=20) as task:
        task.start()
        all_channels = np.array(task.read(10))
        task.in_stream.channels_to_read = task.ai_channels["Dev1/ai1,Dev1/ai3"]
        task.in_stream.relative_to = ReadRelativeTo.FIRST_SAMPLE
        assert np.array_equal(np.array(task.read(10)), all_channels[[1, 3]])


def test_regeneration_repeats_buffer(chassis):
    with add_output(Task(), np.arange(10.0) / 10, sample_mode=AcquisitionType.CONTINUOUS) as output_task:
        output_task.start()
        pass_samples(chassis, 25)
        assert output_task.out_stream.total_samp_per_chan_generated == 25
        # Sample 24 repeats sample 4 of the buffer.
        assert chassis.last_volts[0] == 0.4
        output_task.write(np.full(10, 0.9))
        pass_samples(chassis, 1)
        assert chassis.last_volts[0] == 0.9
        output_task.stop()
        pass_samples(chassis, 10)
    assert chassis.last_volts[0] == 0.9


def test_short_buffer_repeats_until_number_is_generated(chassis):
    with add_output(Task(), [0.1, 0.2, 0.3], samps_per_chan=7) as output_task:
        output_task.start()
        output_task.wait_until_done()
        assert output_task.out_stream.total_samp_per_chan_generated == 7
        assert chassis.last_volts[0] == 0.1


def test_samples_without_regeneration_are_generated_once(chassis):
    with Task() as output_task:
        output_task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        output_task.timing.cfg_samp_clk_timing(RATE, sample_mode=AcquisitionType.CONTINUOUS)
        output_task.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        output_task.write(np.zeros(100))
        output_task.start()
        for _ in range(5):
            assert output_task.write(np.linspace(0.0, 1.0, 100)) == 100
        assert output_task.out_stream.curr_write_pos == 600
        assert output_task.out_stream.total_samp_per_chan_generated == 500


def test_last_output_value_is_held(chassis):
    with Task() as output_task, Task() as input_task:
        output = output_task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
        assert output.ao_idle_output_behavior == AOIdleOutputBehavior.MAINTAIN_EXISTING_VALUE
        assert output_task.write(1.1) == 1
        add_inputs(input_task, "Dev1/ai3", samps_per_chan=400)
        assert np.ptp(input_task.read(READ_ALL_AVAILABLE)) > 1.0
    assert chassis.last_volts[0] == 1.1


def test_output_on_input_clock_waits_for_inputs(chassis):
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai0", samps_per_chan=10)
        add_output(output_task, np.ones(5), source="/Dev1/ai/SampleClock", samps_per_chan=5)
        output_task.start()
        pass_samples(chassis, 20)
        assert output_task.out_stream.total_samp_per_chan_generated == 0
        input_task.read(READ_ALL_AVAILABLE)
        assert output_task.out_stream.total_samp_per_chan_generated == 5


def test_callback_runs_every_100_samples(chassis):
    calls = queue.Queue()
    with Task() as task:
        add_inputs(task, "Dev1/ai0", sample_mode=AcquisitionType.CONTINUOUS)

        def on_samples(handle, kind, samples, data):
            calls.put((kind, samples, len(task.read(samples))))
            return 0

        task.register_every_n_samples_acquired_into_buffer_event(100, on_samples)
        task.start()
        chassis.pass_time(0.1)
        events = [calls.get(timeout=60.0) for _ in range(5)]
        task.stop()
    assert events == [(EveryNSamplesEventType.ACQUIRED_INTO_BUFFER.value, 100, 100)] * 5
    assert calls.empty()


def test_output_callbacks_run(chassis):
    # Each kind of event has its own thread, so the order is not fixed.
    calls, completed = queue.Queue(), queue.Queue()
    with add_output(Task(), np.zeros(50), samps_per_chan=250) as output_task:
        output_task.register_every_n_samples_transferred_from_buffer_event(100, lambda *event: calls.put(event[2]))
        output_task.register_done_event(lambda handle, status, data: completed.put(status))
        output_task.start()
        output_task.wait_until_done()
        events = [event_queue.get(timeout=60.0) for event_queue in (calls, calls, completed)]
    assert events == [100, 100, 0]
    assert calls.empty() and completed.empty()


def test_callbacks_run_on_another_thread(monkeypatch):
    # On a busy machine, the delay of the bench must not stop the task.
    monkeypatch.setattr("daq.extras.ni_device.chassis._MAX_DELAY_S", float("inf"))
    connect("bare-structure", "real")
    three_calls, threads = threading.Event(), []
    with Task("live") as task:
        add_inputs(task, "Dev1/ai0", sample_mode=AcquisitionType.CONTINUOUS)

        def on_samples(handle, kind, samples, data):
            task.read(samples)
            threads.append(threading.current_thread())
            if len(threads) == 3:
                three_calls.set()
            return 0

        task.register_every_n_samples_acquired_into_buffer_event(50, on_samples)
        task.start()
        assert three_calls.wait(60.0)
        task.stop()
    assert threading.main_thread() not in threads


def test_committed_task_reserves_its_modules(chassis):
    with Task() as first, Task() as second:
        add_inputs(first, "Dev1/ai0:3", samps_per_chan=10)
        add_inputs(second, "Dev1/ai0:3", samps_per_chan=10)
        first.control(TaskMode.TASK_COMMIT)
        first.read(READ_ALL_AVAILABLE)
        with raises_code(Code.PAL_RESOURCE_RESERVED):
            second.start()
        first.control(TaskMode.TASK_UNRESERVE)
        assert np.shape(second.read(READ_ALL_AVAILABLE)) == (4, 10)


def test_excitation_of_scene_runs_without_output():
    connect("fig10b-no-damper", "fast")
    with Task() as task:
        task.ai_channels.add_ai_force_iepe_chan("Dev1/ai3")
        task.timing.cfg_samp_clk_timing(RATE, samps_per_chan=5120)
        force = np.array(task.read(READ_ALL_AVAILABLE))
    # The hammer of the test hits with a peak of 200 N.
    assert 150.0 < force.max() < 250.0


def test_compensated_filter_delay_keeps_sample_times():
    scene = rig.load("bare-structure")
    without_delay = scene.replace(converter=scene.converter.replace(filter="delta_sigma", remove_delay=True))
    # The output is a pulse after 1000 samples.
    pulse = np.concatenate([np.zeros(1000), np.hanning(400)])
    responses = []
    for variant in (scene, without_delay):
        connect(variant, "fast")
        with Task() as input_task, Task() as output_task:
            add_inputs(input_task, "Dev1/ai3", samps_per_chan=2000)
            add_output(output_task, pulse, samps_per_chan=1400)
            output_task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")
            output_task.start()
            responses.append(np.array(input_task.read(READ_ALL_AVAILABLE)))
    reference, filtered = responses
    correlation = np.correlate(filtered - filtered.mean(), reference - reference.mean(), "full")
    delay_samples = np.argmax(correlation) - (len(reference) - 1)
    assert abs(delay_samples) <= 1


def count_queries(condition, task):
    """Poll until the condition is true, as a script does; return the number of queries, or fail after 1000."""
    for queries in range(1000):
        if condition(task):
            return queries
    raise AssertionError("the polling loop made no progress")


@pytest.mark.parametrize(
    "condition",
    [
        lambda task: task.in_stream.avail_samp_per_chan >= 600,
        lambda task: task.in_stream.total_samp_per_chan_acquired >= 600,
        lambda task: task.is_task_done(),
    ],
)
def test_polling_advances_fast_clock(chassis, condition):
    with add_inputs(Task(), "Dev1/ai0:3", sample_mode=AcquisitionType.FINITE, samps_per_chan=1000) as task:
        task.start()
        assert count_queries(condition, task) > 1
        assert np.array(task.read(READ_ALL_AVAILABLE)).shape == (4, 1000)


def test_polling_output_advances_fast_clock(chassis):
    with add_output(Task(), sine_voltage(1000), sample_mode=AcquisitionType.FINITE, samps_per_chan=1000) as task:
        task.start()
        count_queries(lambda task: task.out_stream.total_samp_per_chan_generated == 1000, task)


def test_repeated_reads_without_timeout_succeed(chassis):
    with add_inputs(Task(), "Dev1/ai0:3", sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()

        def condition(task):
            try:
                return len(task.read(10, timeout=0.0)[0]) == 10
            except DaqError as no_samples:
                assert no_samples.error_code == Code.SAMPLES_NOT_YET_AVAILABLE
                return False

        count_queries(condition, task)


def test_single_queries_do_not_advance_clock(chassis):
    with add_inputs(Task(), "Dev1/ai0:3", sample_mode=AcquisitionType.CONTINUOUS) as task:
        task.start()
        task.read(100)
        stream = task.in_stream
        assert (stream.total_samp_per_chan_acquired, stream.avail_samp_per_chan) == (100, 0)
        assert not task.is_task_done()
        # The last of the 100 samples is at tick 990; the position is one tick later.
        assert chassis.position == 99 * 10 + 1


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("", ["Dev1/ai0", "Dev1/ai1", "Dev1/ai2"]),
        ("body", ["body0", "body1", "body2"]),
        ("low, middle, high", ["low", "middle", "high"]),
        ("low, middle", ["low", "middle", "Dev1/ai2"]),
    ],
)
def test_every_channel_gets_its_name(chassis, name, expected):
    with Task() as task:
        task.ai_channels.add_ai_accel_chan("Dev1/ai0:2", name)
        assert task.channel_names == expected


@pytest.mark.parametrize(("channels", "names"), [("Dev1/ai0", "a, b"), ("", "a")])
def test_more_names_than_channels_are_rejected(chassis, channels, names):
    with Task() as task, pytest.raises(DaqError):
        task.ai_channels.add_ai_accel_chan(channels, names)
