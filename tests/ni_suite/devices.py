"""The devices that NI's tests expect; every input reads a sine, as those of NI's simulated devices."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rig
from daq.core.signal_chain.channel import ChannelInfo
from daq.core.virtual_bench.bench import first_sample, samples_per_tick
from daq.extras.ni_device.devices.measurements import MEASUREMENTS
from daq.extras.ni_device.devices.modules import Module
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.settings.scales import LINEAR, MAP_RANGES, POLYNOMIAL, TABLE, Scale
from daq.extras.ni_device.settings.storage import Storage
from daq.extras.ni_device.task import Task
from daq.extras.ni_device.values import Coupling, SampleMode, TerminalConfiguration, TimingType
from rig.core.data_sheets.modules import Rates

# Codes of NI-DAQmx for product categories and bus types.
_X_SERIES, _SC_EXPRESS, _DSA, _CHASSIS, _MODULE = 15858, 15886, 14649, 14658, 14659
_TS_CHASSIS, _TS_MODULE = 16180, 16181
_PXIE_4331 = 0x74A9C4C4  # product number that NI's tests expect
_PCIE, _PXIE, _USB, _TCPIP, _CDAQ = 13612, 14706, 12586, 14828, 14637
# Number of channels of the bench that the devices share.
_N_CHANNELS = 32


def modules() -> list[Module]:
    """Return the devices of NI's `tests/max_config`; the first input of every device is the same channel."""
    indices = tuple(range(_N_CHANNELS))
    general = Module(
        name="",
        product_type="",
        category=_SC_EXPRESS,
        bus=_PXIE,
        ranges=(0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0),
        bits=16,
        output_bits=16,
        timebase=100e6,
        rates=Rates(0.01, 100e6),
        output_rates=Rates(0.01, 100e6),
        couplings=(Coupling.DC, Coupling.AC),
        terminal_configurations=(
            TerminalConfiguration.RSE,
            TerminalConfiguration.NRSE,
            TerminalConfiguration.DIFFERENTIAL,
        ),
        aggregate_rate=100e6,
    )
    x_series = replace(
        general, product_type="PCIe-6363", category=_X_SERIES, bus=_PCIE, inputs=indices, outputs=indices[:4]
    )
    sensor_module = replace(
        general,
        inputs=indices[:8],
        ranges=(10.0,),
        terminal_configurations=(TerminalConfiguration.DIFFERENTIAL, TerminalConfiguration.PSEUDO_DIFFERENTIAL),
    )

    def in_chassis(name: str, product: str, slot: int, **settings: Any) -> Module:
        """Return a module in a slot of a CompactDAQ or TestScale chassis."""
        chassis = "tsChassisTester" if product.startswith("TS") else "cdaqChassisTester"
        category = _TS_MODULE if product.startswith("TS") else _MODULE
        return replace(
            general,
            name=name,
            product_type=product,
            category=category,
            bus=_CDAQ,
            chassis=chassis,
            slot=slot,
            **settings,
        )

    return [
        replace(general, name="aoTester", product_type="PXIe-4322", outputs=indices[:8]),
        replace(
            sensor_module, name="bridgeTester", product_type="PXIe-4331", number=_PXIE_4331, rates=Rates(0.01, 102400.0)
        ),
        replace(sensor_module, name="chargeTester", product_type="PXIe-4480", category=_DSA),
        replace(general, name="dmmTester", product_type="NI myDAQ", bus=_USB, inputs=indices[:2], outputs=indices[:2]),
        replace(sensor_module, name="dsaTester", product_type="PXIe-4466", category=_DSA, ranges=(10.0, 42.4)),
        *(replace(x_series, name=f"nidaqmxMultithreadingTester{number}") for number in range(1, 5)),
        replace(sensor_module, name="positionTester", product_type="PXIe-4340"),
        Module("tsChassisTester", "TS-15000", category=_TS_CHASSIS, bus=_PXIE),
        in_chassis("tsPowerTester1", "TS-15200", 1),
        in_chassis("tsPowerTester2", "TS-15200", 2),
        in_chassis("tsVoltageTester1", "TS-15100", 3, inputs=indices[:4], outputs=indices[:2]),
        Module("cdaqChassisTester", "cDAQ-9189", category=_CHASSIS, bus=_TCPIP),
        in_chassis("cdaqTesterMod2", "NI 9215", 2, inputs=indices[:4]),
        in_chassis("cdaqTesterMod3", "NI 9775", 3, inputs=indices[:4]),
        in_chassis("cdaqTesterMod5", "NI 9263", 5, outputs=indices[:4]),
        in_chassis("cdaqTesterMod6", "NI 9205", 6, inputs=indices),
    ]


class SimulatedSignals:
    """Stub of `Terminals` and `Bench`, whose methods it has: every input is a sine within the limits of its channel."""

    rate, tick_rate = 1000.0, 10_000.0  # Hz

    def __init__(self) -> None:
        self.bench = self
        self.scene = rig.load("bare-structure")
        self.dtype: type[np.generic] = np.float64
        self.channels: Sequence[ChannelInfo] = [
            ChannelInfo(f"ai{number}", "body 1", "acceleration", 1.0, self.rate) for number in range(_N_CHANNELS)
        ]
        self.drive_per_volt = np.ones(_N_CHANNELS)
        self._low_volts, self._high_volts = np.full((_N_CHANNELS, 1), -5.0), np.full((_N_CHANNELS, 1), 5.0)
        self._position = 0

    def lost_at(self, rate: float) -> Sequence[tuple[int, int]]:
        """See `Bench.lost_at`."""
        return ()

    def limit_ticks(self, ticks: int) -> int:
        """See `Terminals.limit_ticks`."""
        return ticks

    def advance(self, volts: NDArray[np.float64] | None, ticks: int, rates: Collection[float]) -> Mapping[float, Any]:
        """See `Terminals.advance`."""
        start_tick, self._position = self._position, self._position + ticks
        return {rate: self._block(start_tick, self._position, rate) for rate in {self.rate, *rates}}

    def _block(self, start_tick: int, stop_tick: int, rate: float) -> _Block:
        """Return the samples at a rate between two ticks."""
        per_tick = samples_per_tick(rate, self.tick_rate)
        first, stop = (first_sample(per_tick, tick) for tick in (start_tick, stop_tick))
        sine = 0.4 * np.sin(2 * np.pi * np.arange(first, stop) / 50)
        values = (self._high_volts + self._low_volts) / 2 + (self._high_volts - self._low_volts) / 2 * sine
        return _Block(first, values, np.zeros(values.shape, bool))

    def release_outputs(self) -> None:
        """See `Terminals.release_outputs`."""

    @property
    def is_idle(self) -> bool:
        """See `Terminals.is_idle`."""
        return True

    def supply(self, bench_index: int) -> float | None:
        """See `Terminals.supply`."""
        return None

    def teds(self, bench_index: int) -> bytes | None:
        """See `Terminals.teds`."""
        return None

    def set_conditioning(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """See `Terminals.set_conditioning`."""
        for channel in channels:
            self._low_volts[channel.bench_index] = channel.settings["ai_min"] * channel.volts_per_unit
            self._high_volts[channel.bench_index] = channel.settings["ai_max"] * channel.volts_per_unit

    def filter_properties(self, bench_index: int, rate: float | None) -> dict[str, Any]:
        """See `Terminals.filter_properties`."""
        return {"ai_filter_delay": 0.0, "ai_remove_filter_delay": True}


@dataclass(frozen=True)
class _Block:
    first: int
    samples: NDArray[np.float64]
    overload: NDArray[np.bool_]


def save_inputs(storage: Storage, task: Task) -> None:
    """Save the input task, the channels and the scales of NI's `tests/max_config`."""
    scales = {
        "double_gain_scale": Scale(
            LINEAR, {"lin_slope": 2.0, "lin_y_intercept": 0.0, "descr": "Twice the gain", "scaled_units": "Double Gain"}
        ),
        "no_scaling_scale": Scale(
            MAP_RANGES,
            {"map_pre_scaled_min": -10.0, "map_pre_scaled_max": 10.0, "map_scaled_min": -10.0, "map_scaled_max": 10.0},
        ),
        "polynomial_scale": Scale(POLYNOMIAL, {"poly_forward_coeff": [0.0, 1.0], "poly_reverse_coeff": [0.0, 1.0]}),
        "degrees_scale": Scale(TABLE, {"table_pre_scaled_vals": [0.0, 1.0, 2.0], "table_scaled_vals": [0.0, 1.0, 2.0]}),
    }
    storage.scales.update(scales)
    storage.authors.update(dict.fromkeys(scales, "Test Author"))
    volts = MEASUREMENTS["Voltage"]
    task.settings.add("tsVoltageTester1/ai0", "Voltage_0", volts, {"ai_min": -10.0, "ai_max": 10.0})
    timing = {"samp_clk_rate": 1000.0, "samp_quant_samp_mode": SampleMode.FINITE}
    timing |= {"samp_quant_samp_per_chan": 100, "samp_timing_type": TimingType.SAMPLE_CLOCK}
    for key, value in timing.items():
        task.settings.groups["timing"][key] = value
    storage.save_task(task.settings, "VoltageTesterTask", "Test Author")
    for number, name in enumerate(("VoltageTesterChannel", "VoltageTesterChannel2")):
        storage.save_channel(task.settings.add(f"tsVoltageTester1/ai{number}", name, volts, {})[0], name, "Test Author")


def save_outputs(storage: Storage, task: Task) -> None:
    """Save the output task of NI's `tests/max_config`."""
    task.settings.add("aoTester/ao0:2", "VoltageOut_0", None, {})
    storage.save_task(task.settings, "AOTesterTask", "Test Author")
