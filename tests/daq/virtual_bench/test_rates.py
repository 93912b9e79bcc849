"""Several sample rates on a bench: the samples at a rate do not depend on the other rates.

The bench simulates at its tick rate, and derives from it the samples of each rate.
"""

import nidaqmx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from nidaqmx.constants import AcquisitionType

import daq
import rig
from daq.core.virtual_bench.bench import Bench
from daq.extras.ni_device.terminals import Terminals

SCENE = """
structure: {masses: [1 kg, 1 kg], springs: [40 kN/m, 40 kN/m], damping: {modal: 1 %}}
dampers: [{body: 2, mass_ratio: 10 %, clearance: 0.5 mm}]
shaker: {kind: force, body: 1}
channels:
  - {name: one, at: body 1, accelerometer: {noise: 20 ug/sqrt(Hz), resonance: 20 kHz, low_cutoff: 0.5 Hz}}
  - {name: two, at: body 2, integrator: {order: 2, corner: 1 Hz}}
  - {name: drive, at: drive}
converter: CONVERTER
"""
CONVERTERS = ["{rate: 5120 Hz}", "{preset: NI 9234, rate: 5120 Hz}", "{preset: USB-4431, rate: 44.1 kHz}"]
# These rates divide the tick rates of the first two converters, but not that of the third.
RATES = [51200.0, 12800.0, 51200.0 / 7, 2048.0]


def terminals_of(converter, scene=SCENE):
    """Return the terminals of the bench of the scene with this converter."""
    return Terminals(rig.loads(scene.replace("CONVERTER", converter)))


def drive(terminals, tick, ticks):
    """Return the volts at ticks; they cause impacts of the damper on floor and ceiling."""
    return 60.0 * np.sin(2 * np.pi * 25.0 * (tick + np.arange(ticks)) / terminals.bench.tick_rate)[None]


def acquire(terminals, blocks, rate):
    """Return the samples at a rate; a block is a number of ticks and the other rates that are sampled during it."""
    terminals.release_outputs()
    tick, samples = 0, []
    for ticks, other_rates in blocks:
        volts = drive(terminals, tick, ticks)
        samples.append(terminals.advance(volts, ticks, {rate, *other_rates})[rate].samples)
        tick += ticks
    return np.concatenate(samples, axis=1)


@pytest.mark.thorough
@settings(max_examples=8, deadline=None)
@given(
    converter=st.sampled_from(CONVERTERS),
    rate=st.sampled_from(RATES),
    blocks=st.lists(st.tuples(st.integers(1, 3000), st.sets(st.sampled_from(RATES))), min_size=1, max_size=8),
)
def test_other_rates_do_not_change_samples(converter, rate, blocks):
    alone = acquire(terminals_of(converter), [(sum(ticks for ticks, _ in blocks), ())], rate)
    assert np.array_equal(acquire(terminals_of(converter), blocks, rate), alone)


@pytest.mark.parametrize("converter", CONVERTERS)
@pytest.mark.parametrize("rate", [51200.0, 51200.0 / 7])
def test_samples_equal_those_of_slower_bench(converter, rate):
    # Noise is drawn for each interval, and with the USB-4431 the slower bench has fewer intervals.
    scene = SCENE.replace("noise: 20 ug/sqrt(Hz), ", "") if "USB" in converter else SCENE
    terminals = terminals_of(converter, scene)
    bench = terminals.bench
    ticks = round(0.2 * bench.tick_rate)
    result = acquire(terminals, [(ticks, ())], rate)
    slower_bench = Bench(bench.scene.replace(converter=bench.scene.converter.replace(rate=rate)))
    ticks_of_samples = np.arange(result.shape[1]) / rate * bench.tick_rate
    slower_drive = np.interp(ticks_of_samples, np.arange(ticks), drive(terminals, 0, ticks)[0])
    expected = slower_bench.acquire(slower_drive[None]).samples
    scale = np.abs(expected).max(axis=1, keepdims=True).astype(float)
    # Between samples, the drive of the slower bench differs by (pi f / rate)^2 / 2.
    np.testing.assert_allclose(result / scale, expected / scale, rtol=0, atol=3e-3 if rate < 1e4 else 3e-4)


def test_filters_of_later_rate_are_settled():
    terminals = terminals_of("{rate: 5120 Hz}")
    ticks = round(2.5 * terminals.bench.tick_rate)
    terminals.release_outputs()
    last_block = None
    for first in range(0, ticks + 8192, 8192):
        rates = {51200.0} if first >= ticks - 8192 else set()
        last_block = terminals.advance(drive(terminals, first, 8192), 8192, rates).get(51200.0)
    # Each sample is the average of the drive over the interval that ends there.
    volts = drive(terminals, last_block.first - 1, last_block.samples.shape[1] + 1)[0]
    np.testing.assert_allclose(last_block.samples[2], (volts[1:] + volts[:-1]) / 2, rtol=0, atol=1e-9)
    # At rest, the integrator would start with an offset much larger than the vibration.
    assert abs(last_block.samples[1].mean()) < 0.2 * np.ptp(last_block.samples[1])


def input_task(connection, device, rate):
    """Return a continuous task with two inputs."""
    task = nidaqmx.Task(grpc_options=connection)
    task.ai_channels.add_ai_voltage_chan(f"{device}/ai0:1", min_val=-500.0, max_val=500.0)
    task.timing.cfg_samp_clk_timing(rate, sample_mode=AcquisitionType.CONTINUOUS)
    return task


def test_parallel_tasks_keep_their_rates():
    with daq.connect("bare-structure", clock="fast") as single, input_task(single, "Dev1", 5120.0) as slow:
        expected = np.array(slow.read(300))
    with (
        daq.connect("bare-structure", clock="fast") as both,
        input_task(both, "Dev1", 5120.0) as slow,
        input_task(both, "Dev2", 51200.0) as fast,
    ):
        first = slow.read(100)
        fast.start()
        assert np.shape(fast.read(1000)) == (2, 1000)
        assert np.array_equal(np.concatenate([first, slow.read(200)], axis=1), expected)


@pytest.mark.parametrize("at", ["shaker", "drive"])
@pytest.mark.parametrize("ratio", [1.0, 10.0, 9.5])
def test_drive_at_slower_rate_has_stated_response(at, ratio):
    scene = rig.loads(
        "{structure: {masses: [1 kg], springs: [40 kN/m], damping: {modal: 1 %}}, shaker: {kind: force, body: 1}, "
        f"channels: [{{name: drive, at: {at}}}], converter: {{rate: 10240 Hz}}}}"
    )
    bench, rate, frequency = Bench(scene, ticks_per_sample=1), 10240.0 / ratio, 205.0
    time = np.arange(10240) / bench.tick_rate
    block = bench.advance(3.0 * np.cos(2 * np.pi * frequency * time)[None], [rate])[rate]
    instants = (block.first + np.arange(block.samples.shape[1])) / rate
    phasor = np.exp(2j * np.pi * frequency * instants)[200:]
    basis = np.column_stack([phasor.real, -phasor.imag, np.ones(phasor.size)])
    real, imaginary, _ = np.linalg.lstsq(basis, block.samples[0, 200:], rcond=None)[0]
    slower_bench = Bench(scene.replace(converter=scene.converter.replace(rate=rate)))
    stated = 3.0 * slower_bench.channels[0].response(frequency)
    # Linear interpolation between ticks attenuates the tone by (pi f / tick rate)^2 / 3 = 1.3e-3.
    assert complex(real, imaginary) == pytest.approx(complex(stated), rel=3e-3)
