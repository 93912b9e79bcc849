"""Start and reference triggers of a task, on signals of the bench.

The table moves a single pulse of 1 mm. Its channel ai3 reads at least 1 V; triggers on it have a level of 0.5 V. The
record of a task is the sequence of samples that its trigger selects.
"""

import numpy as np
import pytest
from nidaqmx.constants import READ_ALL_AVAILABLE, AcquisitionType, Slope
from nidaqmx.error_codes import DAQmxErrors as Code
from nidaqmx.errors import DaqReadError

from tests.daq.client import RATE, Task, add_inputs, add_output, connect, raises_code, reads_waveforms


@pytest.fixture
def chassis():
    return connect("bare-structure", "fast")


def start_seconds(waveform):
    """Return the time of a waveform's first sample since the start of the bench, s."""
    start = waveform.timing.start_time
    return (start - type(start)(1970, 1, 1, tzinfo=start.tzinfo)).total_seconds()


def pulse(first, length=4000):
    """Return output voltages, V, that move the table by 1 mm for 10 ms, from the sample `first` on."""
    volts = np.zeros(length)
    volts[first : first + 51] = np.hanning(51)
    return volts


@pytest.mark.parametrize("pretrigger", [0, 1, 100, 399])
def test_reference_trigger_follows_pretrigger_samples(chassis, pretrigger):
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai0:3", samps_per_chan=400)
        input_task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai3", pretrigger, Slope.RISING, 0.5)
        add_output(output_task, pulse(1000), samps_per_chan=4000)
        output_task.start()
        table = np.array(input_task.read(READ_ALL_AVAILABLE))[3]
    assert len(table) == 400
    assert table[pretrigger] > 0.5
    if pretrigger:
        assert (table[:pretrigger] <= 0.5).all()


def test_edge_before_pretrigger_is_ignored(chassis):
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai0:3", samps_per_chan=1000)
        input_task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai3", 500, Slope.RISING, 0.5)
        add_output(output_task, pulse(100) + pulse(2000), samps_per_chan=4000)
        output_task.start()
        table = np.array(input_task.read(READ_ALL_AVAILABLE))[3]
        assert input_task.in_stream.total_samp_per_chan_acquired > 2000
    assert table[500] > 0.5 >= table[499]


@pytest.mark.thorough
@pytest.mark.parametrize(("read_size", "samples"), [(1, 100), (7, 100), (128, 600), (600, 600)])
def test_triggered_record_does_not_depend_on_reads(read_size, samples):
    pretrigger = samples // 3
    connect("bare-structure", "fast")
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai3", samps_per_chan=samples)
        input_task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai3", pretrigger, Slope.RISING, 0.5)
        add_output(output_task, pulse(1000), samps_per_chan=4000)
        output_task.start()
        input_task.start()
        pieces = [input_task.read(min(read_size, samples - start)) for start in range(0, samples, read_size)]
    table = np.concatenate(pieces)
    connect("bare-structure", "fast")
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai3", samps_per_chan=3000)
        add_output(output_task, pulse(1000), samps_per_chan=4000)
        output_task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")
        output_task.start()
        untriggered = np.array(input_task.read(READ_ALL_AVAILABLE))
    trigger = int(np.argmax(untriggered > 0.5))
    assert np.array_equal(table, untriggered[trigger - pretrigger : trigger - pretrigger + samples])


def test_analog_start_begins_above_level(chassis):
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai0:3", samps_per_chan=100)
        input_task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai3", Slope.RISING, 0.5)
        add_output(output_task, pulse(700), samps_per_chan=4000)
        output_task.start()
        table = np.array(input_task.read(READ_ALL_AVAILABLE))[3]
    assert table[0] > 0.5


def test_missing_trigger_times_out(chassis):
    with add_inputs(Task(), "Dev1/ai0:3", samps_per_chan=100) as input_task:
        input_task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0", Slope.RISING, 400.0)
        with raises_code(Code.SAMPLES_NOT_YET_AVAILABLE, "start trigger has not occurred", DaqReadError, 0):
            input_task.read(100, timeout=0.5)
    assert chassis.elapsed == 0.5  # the timeout, in bench time


@reads_waveforms
def test_digital_start_begins_at_pulse(chassis):
    with add_inputs(Task(), "Dev1/ai0", samps_per_chan=10) as input_task:
        input_task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI0")
        waveform = input_task.read_waveform()
    assert start_seconds(waveform) == 1.0  # the first pulse


@reads_waveforms
def test_retriggerable_task_records_every_pulse(chassis):
    with add_inputs(Task(), "Dev1/ai0", samps_per_chan=100) as input_task:
        input_task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI0")
        input_task.triggers.start_trigger.retriggerable = True
        input_task.start()
        starts = [start_seconds(input_task.read_waveform(100)) for _ in range(3)]
        assert input_task.in_stream.total_samp_per_chan_acquired == 300
        input_task.stop()
    assert starts == [1.0, 2.0, 3.0]


def test_output_starts_one_tick_after_triggered_input(chassis):
    # The decaying response to a pulse triggers the input, and the input starts another output.
    with add_output(Task(), pulse(500, 1000), samps_per_chan=1000) as pulse_output:
        pulse_output.start()
        pulse_output.wait_until_done()
    with Task() as input_task, Task() as output_task:
        add_inputs(input_task, "Dev1/ai0", samps_per_chan=200)
        input_task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0", Slope.RISING, 0.05)
        add_output(output_task, np.ones(50), samps_per_chan=50)
        output_task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")
        output_task.start()
        input_task.read(READ_ALL_AVAILABLE)
        output_tick = chassis.tasks[output_task.name].run.first_tick
        input_sample = chassis.tasks[input_task.name].run.first_instant
        assert output_tick == chassis.rate / RATE * input_sample + 1
        assert output_task.is_task_done()


@pytest.mark.parametrize(
    "configure, code, hint",
    [
        (
            lambda task: task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai9"),
            Code.INVALID_ANALOG_TRIG_SRC,
            "Dev1/ai0",
        ),
        *(
            (
                lambda task, terminal=terminal: task.triggers.start_trigger.cfg_dig_edge_start_trig(terminal),
                Code.ROUTE_NOT_SUPPORTED_BY_HW_ROUTING,
                "PFI0",
            )
            for terminal in ("/Dev1/Nowhere", "ai/SampleClock", "PFI0x", "/Dev1/ci/StartTrigger", "ao/ReferenceTrigger")
        ),
        (
            lambda task: task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai0", 100),
            Code.TOO_MANY_PRETRIG_PLUS_MIN_POST_TRIG_SAMPS,
            "0 to 99",
        ),
    ],
)
def test_error_of_impossible_trigger_names_remedy(chassis, configure, code, hint):
    with add_inputs(Task(), "Dev1/ai0:3", samps_per_chan=100) as input_task, raises_code(code, hint):
        configure(input_task)
        input_task.start()


def test_reference_trigger_needs_finite_task(chassis):
    with add_inputs(Task(), sample_mode=AcquisitionType.CONTINUOUS) as input_task:
        input_task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai0", 10)
        with raises_code(Code.REF_TRIG_WHEN_CONTINUOUS, "FINITE"):
            input_task.start()
    with Task() as input_task:
        input_task.ai_channels.add_ai_voltage_chan("Dev1/ai0")
        input_task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0")
        with raises_code(Code.TRIG_WHEN_ON_DEMAND_SAMP_TIMING, "cfg_samp_clk_timing"):
            input_task.read()
