"""Drive channels measure the output voltage that drives a shaker, as a T-piece in its cable allows."""

import numpy as np
import pytest

import rig
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.virtual_bench.bench import Bench

STRUCTURE = "structure: {masses: [1 kg, 2 kg], springs: [10 kN/m, 20 kN/m], damping: {modal: 1 %}}\n"
FORCE = "{kind: force, body: 1}"
TABLE = "{kind: table, body: 2, spring: 3 kN/m}"
COIL = "{kind: electrodynamic, body: 1, spring: 5 kN/m, amplifier: {gain: 2, limit: 1 V}}"
# N, m or V of the shaker's drive per volt of the output.
DRIVE_PER_VOLT = {FORCE: 1.0, TABLE: 1e-3, COIL: 1.0}


def read_channels(text: str, drive: np.ndarray) -> tuple[np.ndarray, tuple[ChannelInfo, ...]]:
    """Return the readings of a scene's channels in their units (channels, samples), and the channels."""
    bench = Bench(rig.loads(STRUCTURE + text))
    block = bench.acquire(drive)
    return bench.to_units(block.samples), bench.channels


def interval_averages(volts: np.ndarray) -> np.ndarray:
    """Return the samples of a converter without a filter, if the voltage is linear between the given values."""
    return 0.5 * (volts[1:] + volts[:-1])


@pytest.mark.parametrize("shaker", DRIVE_PER_VOLT)
def test_drive_channel_reads_output_volts(shaker: str) -> None:
    volts = np.random.default_rng(1).standard_normal(200)
    text = f"shaker: {shaker}\nchannels: [{{name: drive, at: drive}}]\n"
    result, channels = read_channels(text, volts[None] * DRIVE_PER_VOLT[shaker])
    assert (channels[0].quantity, channels[0].unit) == ("voltage", "V")
    assert result[0, 1:] == pytest.approx(interval_averages(volts), abs=1e-12)


def test_each_drive_channel_reads_its_output() -> None:
    volts = np.random.default_rng(2).standard_normal((3, 200))
    text = f"shaker: [{FORCE}, {TABLE}, {COIL}]\nchannels: [{{name: c, at: drive 3}}, {{name: b, at: drive 2}}]\n"
    result, _ = read_channels(text, volts * np.array([[1.0], [1e-3], [1.0]]))
    assert result[0, 1:] == pytest.approx(interval_averages(volts[2]), abs=1e-12)
    assert result[1, 1:] == pytest.approx(interval_averages(volts[1]), abs=1e-12)


def test_output_module_clips_and_quantizes() -> None:
    volts = np.array([[0.1001, 12.0, -12.0, 0.0]])
    text = "shaker: {kind: force, body: 1, output: {preset: NI 9263}}\nchannels: [{name: drive, at: drive}]\n"
    result, _ = read_channels(text, np.repeat(volts, 2, axis=1))
    step = 20.0 / 2**16  # the NI 9263 has 16 bits and the range ±10 V
    # Each voltage is held for two samples; the second sample is an average over a constant voltage.
    assert result[0, 1::2] == pytest.approx([round(0.1001 / step) * step, 10.0 - step, -10.0, 0.0], abs=1e-12)


def test_input_module_converts_the_drive() -> None:
    volts = np.full((1, 3000), 4.0)
    text = f"shaker: {FORCE}\nchannels: [{{name: drive, at: drive, coupling: DC}}]\nconverter: {{preset: NI 9234}}\n"
    result, channels = read_channels(text, volts)
    assert channels[0].volts_per_count == 10.0 / 2**24
    assert result[0, -1] == pytest.approx(4.0, abs=1e-4)
