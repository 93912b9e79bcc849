import numpy as np
import pytest
from nidaqmx.constants import READ_ALL_AVAILABLE, AcquisitionType, Slope
from nidaqmx.errors import DaqError, DaqReadError

from daq.instrument import values
from daq.instrument.engines.triggers import CrossingFinder, SyncPulse, edge
from tests.daq.client import Task, connect, reads_waveforms

RATE = 5120.0


@pytest.fixture
def chassis():
    return connect("bare-structure", "fast")


def inputs(task, channels="Dev1/ai0:3", **timing):
    task.ai_channels.add_ai_voltage_chan(channels, min_val=-500.0, max_val=500.0)
    task.timing.cfg_samp_clk_timing(RATE, **timing)
    return task


def output(task, wave, **timing):
    task.ao_channels.add_ao_voltage_chan("Dev1/ao0")
    task.timing.cfg_samp_clk_timing(RATE, **timing)
    task.write(wave)
    return task


def start_s(waveform):
    """Time of a waveform's first sample on the bench, s."""
    start = waveform.timing.start_time
    return (start - type(start)(1970, 1, 1, tzinfo=start.tzinfo)).total_seconds()


def bump(at, length=4000):
    """A displacement of 1 mm for 10 ms."""
    wave = np.zeros(length)
    wave[at : at + 51] = np.hanning(51)
    return wave


@pytest.mark.parametrize("slope, expected", [(Slope.RISING, 4), (Slope.FALLING, 6)])
def test_first_sample_beyond_level_triggers(slope, expected):
    samples = np.array([2.0, 1.0, 0.0, 1.0, 1.5, 1.0, 0.5])
    assert CrossingFinder(edge(values.Slope(slope.value), 1.0)).find(samples) == (
        expected if slope is Slope.RISING else 2
    )


def test_hysteresis_ignores_grazing():
    samples = np.array([0.95, 1.2, 0.95, 1.2, 0.4, 1.2])
    assert CrossingFinder(edge(values.Slope.RISING, 1.0, 0.5)).find(samples) == 5


@pytest.mark.parametrize("size", [1, 2, 3, 7])
def test_block_size_does_not_move_edge(size):
    samples = np.random.default_rng(5).normal(size=200)
    whole = CrossingFinder(edge(values.Slope.RISING, 1.5, 1.0)).find(samples, 20)
    finder, tick = CrossingFinder(edge(values.Slope.RISING, 1.5, 1.0)), None
    for start in range(0, 200, size):
        part = samples[start : start + size]
        at = finder.find(part, min(max(0, 20 - start), part.size))
        if at is not None:
            tick = start + at
            break
    assert whole is not None and tick == whole


def test_sync_output_has_one_edge_per_second():
    rising, falling = SyncPulse(values.Slope.RISING), SyncPulse(values.Slope.FALLING)
    assert [rising.next_tick(tick, RATE) for tick in (0, 5119, 5120, 5121)] == [5120, 5120, 5120, 10240]
    assert falling.next_tick(0, RATE) == 7680


@pytest.mark.parametrize("before", [0, 1, 100, 399])
def test_reference_trigger_sits_after_pretrigger(chassis, before):
    with Task() as reading, Task() as driving:
        inputs(reading, samps_per_chan=400)
        reading.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai3", before, Slope.RISING, 0.5)
        output(driving, bump(1000), samps_per_chan=4000)
        driving.start()
        table = np.array(reading.read(READ_ALL_AVAILABLE))[3]
    assert len(table) == 400
    assert table[before] > 0.5
    if before:
        assert (table[:before] <= 0.5).all()


def test_edge_before_pretrigger_is_ignored(chassis):
    with Task() as reading, Task() as driving:
        inputs(reading, samps_per_chan=1000)
        reading.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai3", 500, Slope.RISING, 0.5)
        output(driving, bump(100) + bump(2000), samps_per_chan=4000)
        driving.start()
        table = np.array(reading.read(READ_ALL_AVAILABLE))[3]
        assert reading.in_stream.total_samp_per_chan_acquired > 2000
    assert table[500] > 0.5 >= table[499]


@pytest.mark.thorough
@pytest.mark.parametrize("size", [1, 7, 128, 600])
def test_triggered_record_reads_in_pieces(size):
    connect("bare-structure", "fast")
    with Task() as reading, Task() as driving:
        inputs(reading, "Dev1/ai3", samps_per_chan=600)
        reading.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai3", 200, Slope.RISING, 0.5)
        output(driving, bump(1000), samps_per_chan=4000)
        driving.start()
        reading.start()
        pieces = [reading.read(min(size, 600 - start)) for start in range(0, 600, size)]
    table = np.concatenate(pieces)
    connect("bare-structure", "fast")
    with Task() as reading, Task() as driving:
        inputs(reading, "Dev1/ai3", samps_per_chan=3000)
        output(driving, bump(1000), samps_per_chan=4000)
        driving.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")
        driving.start()
        untriggered = np.array(reading.read(READ_ALL_AVAILABLE))
    at = int(np.argmax(untriggered > 0.5))
    assert np.array_equal(table, untriggered[at - 200 : at + 400])


def test_analog_start_begins_above_level(chassis):
    with Task() as reading, Task() as driving:
        inputs(reading, samps_per_chan=100)
        reading.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai3", Slope.RISING, 0.5)
        output(driving, bump(700), samps_per_chan=4000)
        driving.start()
        table = np.array(reading.read(READ_ALL_AVAILABLE))[3]
    assert table[0] > 0.5


def test_missing_trigger_times_out(chassis):
    with Task() as reading:
        inputs(reading, samps_per_chan=100)
        reading.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0", Slope.RISING, 400.0)
        with pytest.raises(DaqReadError, match="start trigger has not occurred") as caught:
            reading.read(100, timeout=0.5)
    assert (caught.value.error_code, caught.value.samps_per_chan_read) == (-200284, 0)
    assert chassis.elapsed == 0.5


@reads_waveforms
def test_digital_start_begins_at_pulse(chassis):
    with Task() as reading:
        inputs(reading, "Dev1/ai0", samps_per_chan=10)
        reading.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI0")
        waveform = reading.read_waveform()
    assert start_s(waveform) == 1.0


@reads_waveforms
def test_retriggerable_task_records_every_pulse(chassis):
    with Task() as reading:
        inputs(reading, "Dev1/ai0", samps_per_chan=100)
        reading.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/PFI0")
        reading.triggers.start_trigger.retriggerable = True
        reading.start()
        starts = [start_s(reading.read_waveform(100)) for _ in range(3)]
        assert reading.in_stream.total_samp_per_chan_acquired == 300
        reading.stop()
    assert starts == [1.0, 2.0, 3.0]


def test_output_follows_analog_start(chassis):
    with Task() as shaking:
        output(shaking, bump(500, 1000), samps_per_chan=1000)
        shaking.start()
        shaking.wait_until_done()
    with Task() as reading, Task() as driving:
        inputs(reading, "Dev1/ai0", samps_per_chan=200)
        reading.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0", Slope.RISING, 0.05)
        output(driving, np.ones(50), samps_per_chan=50)
        driving.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/ai/StartTrigger")
        driving.start()
        reading.read(READ_ALL_AVAILABLE)
        made, taken = (chassis.tasks[each.name].run.first_tick for each in (driving, reading))
        assert made == chassis.rate / RATE * taken + 1
        assert driving.is_task_done()


@pytest.mark.parametrize(
    "configure, code, hint",
    [
        (lambda task: task.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai9"), -200265, "Dev1/ai0"),
        (lambda task: task.triggers.start_trigger.cfg_dig_edge_start_trig("/Dev1/Nowhere"), -89136, "PFI0"),
        (lambda task: task.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai0", 100), -200213, "0 to 99"),
    ],
)
def test_impossible_trigger_is_explained(chassis, configure, code, hint):
    with Task() as reading:
        inputs(reading, samps_per_chan=100)
        with pytest.raises(DaqError, match=hint) as caught:
            configure(reading)
            reading.start()
    assert caught.value.error_code == code


def test_reference_trigger_needs_finite_task(chassis):
    with Task() as reading:
        inputs(reading, sample_mode=AcquisitionType.CONTINUOUS)
        reading.triggers.reference_trigger.cfg_anlg_edge_ref_trig("Dev1/ai0", 10)
        with pytest.raises(DaqError, match="FINITE") as caught:
            reading.start()
        assert caught.value.error_code == -200358
    with Task() as reading:
        reading.ai_channels.add_ai_voltage_chan("Dev1/ai0")
        reading.triggers.start_trigger.cfg_anlg_edge_start_trig("Dev1/ai0")
        with pytest.raises(DaqError, match="cfg_samp_clk_timing") as caught:
            reading.read()
        assert caught.value.error_code == -200262
