"""IEPE sensors require a supply current, and their bias is removed by AC coupling; otherwise readings are wrong."""

import numpy as np
import pytest

import rig
from daq.core.virtual_bench.bench import Bench

IEPE = "accelerometer: {sensitivity: 100 mV/g, iepe: true, bias: 9 V, noise: 1 ug/sqrt(Hz)}"


def record_volts(channel: str, converter: str) -> np.ndarray:
    """Return the samples in V of an accelerometer on a body that is driven at 40 Hz."""
    scene = rig.loads(
        "structure: {masses: [1 kg], springs: [40 kN/m], damping: {modal: 1 %}}\n"
        "shaker: {kind: force, body: 1}\n"
        f"channels: [{{name: c, at: body 1, {channel}}}]\nconverter: {converter}\n"
    )
    bench = Bench(scene)
    drive = 10.0 * np.sin(2 * np.pi * 40.0 * np.arange(10240) / bench.rate)
    return bench.acquire(drive[None]).samples[0].astype(float)


@pytest.mark.parametrize(
    ("channel", "converter", "has_signal"),
    [
        (IEPE, "{}", True),
        (IEPE, "{excitation: 4 mA}", True),
        (IEPE, "{excitation: 0 mA}", False),
        (IEPE + ", excitation: 0 mA", "{excitation: 4 mA}", False),
        (IEPE + ", excitation: 4 mA", "{excitation: 0 mA}", True),
        ("accelerometer: {sensitivity: 100 mV/g}", "{excitation: 0 mA}", True),
        ("accelerometer: {preset: PCB 352C33}", "{preset: NI 9234}", True),
        ("accelerometer: {preset: PCB 352C33}, excitation: 0 mA", "{preset: NI 9234, noise: 0}", False),
        # The NI 9234 supplies sensors only at AC coupled inputs, the USB-4431 at all inputs.
        ("accelerometer: {preset: PCB 352C33}, coupling: DC", "{preset: NI 9234, noise: 0}", False),
        ("accelerometer: {preset: PCB 352C33}, coupling: DC", "{preset: USB-4431, noise: 0}", True),
    ],
)
def test_iepe_sensor_requires_supply(channel: str, converter: str, has_signal: bool) -> None:
    # A sensor without supply reads exactly zero if the converter has no noise.
    assert record_volts(channel, converter)[200:].any() == has_signal


def test_ac_coupling_removes_the_supply_bias() -> None:
    dc_coupled = record_volts(IEPE + ", coupling: DC", "{coupling: AC}")
    ac_coupled = record_volts(IEPE, "{coupling: AC, ac_corner: 5 Hz}")
    assert dc_coupled.mean() == pytest.approx(9.0, abs=0.05)
    assert abs(ac_coupled[-2048:].mean()) < 0.01
