"""Terminals of a bench without mechanics: each input reads the voltage of a wired output, of a source, or 0 V.

A wire is ideal: an input reads the voltage of the output at the same instant. The inputs have the range, the resolution
and the coupling of their module, but no noise and no filter.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from daq.core.signal_chain.channel import ChannelInfo
from daq.core.virtual_bench.bench import first_sample, samples_per_tick
from daq.extras.ni_device.devices.modules import Module
from daq.extras.ni_device.errors import Code, DaqError
from daq.extras.ni_device.settings.channels import Channel
from daq.extras.ni_device.values import Coupling
from daq.extras.pytest_plugin.description import WiredBench

# Number of ticks in one step of the bench, to limit the memory.
_MAX_BLOCK_TICKS = 1 << 16
# Corner frequency of inputs with AC coupling [Hz], as that of an NI 9234.
_AC_CORNER_HZ = 0.5


@dataclass(frozen=True)
class Block:
    """Samples of all inputs, with the fields of `daq.core.virtual_bench.bench.Block` that the instrument uses."""

    first: int  # index of the first sample, from power-on
    samples: NDArray[np.int32]  # counts, shape (inputs, samples)
    overload: NDArray[np.bool_]  # whether each sample is clipped


class WiredTerminals:
    """Replaces `Terminals` and `Bench`, and has the methods of both."""

    dtype: type[np.generic] = np.int32
    # On this bench, no test drives the outputs, and no sample is lost.
    is_idle = True

    def __init__(self, wired: WiredBench) -> None:
        self.bench = self
        self._wires, self._sources, self._pulses = wired.wires, wired.sources, wired.pulses
        modules = [module for module in wired.modules if module.inputs or module.outputs]
        self.rate = self.tick_rate = _tick_rate(modules)
        self.channels: tuple[ChannelInfo, ...] = tuple(
            _input(module, number, self.rate) for module in modules for number in range(len(module.inputs))
        )
        self.drive_per_volt = np.ones(sum(len(module.outputs) for module in modules))
        self._bits = [module.bits or 32 for module in modules for _ in module.inputs]
        self._connected = {*self._wires, *self._sources}  # inputs
        self._ac_coupled: set[int] = set()  # inputs with AC coupling
        # State of the AC coupling of each input at each rate: number of the next sample, last voltage, last output [V].
        self._coupling_states: dict[tuple[int, float], tuple[int, float, float]] = {}
        self._position = 0  # ticks

    @property
    def scene(self) -> Any:
        """Raise an error: this bench has no scene. Only a recording needs a scene, because it stores it."""
        raise DaqError("a bench without a scene has no recordings (.mcap). Log to a .tdms file.", Code.UNKNOWN)

    def lost_at(self, rate: float) -> Sequence[tuple[int, int]]:
        """See `Bench.lost_at`: no samples are lost."""
        return ()

    def limit_ticks(self, ticks: int) -> int:
        """See `Terminals.limit_ticks`."""
        return min(ticks, _MAX_BLOCK_TICKS)

    def release_outputs(self) -> None:
        """See `Terminals.release_outputs`."""

    def advance(self, volts: NDArray[np.float64] | None, ticks: int, rates: Collection[float]) -> Mapping[float, Block]:
        """See `Terminals.advance`; the block at the rate of the bench is empty unless `rates` contain this rate."""
        if volts is None:
            volts = np.zeros((len(self.drive_per_volt), ticks))
        empty = Block(0, np.zeros((len(self.channels), 0), np.int32), np.zeros((len(self.channels), 0), bool))
        blocks = {self.rate: empty} | {rate: self._sample(volts, ticks, rate) for rate in rates}
        self._position += ticks
        return blocks

    def _sample(self, output_volts: NDArray[np.float64], ticks: int, rate: float) -> Block:
        """Sample the inputs at a rate during the next ticks, given the voltages of the outputs at each tick."""
        per_tick = samples_per_tick(rate, self.tick_rate)
        first, stop = (first_sample(per_tick, tick) for tick in (self._position, self._position + ticks))
        numbers = np.arange(first, stop)
        # An output keeps its voltage from a tick to the next.
        tick_indices = numbers * per_tick.denominator // per_tick.numerator - self._position
        volts = np.zeros((len(self.channels), stop - first))
        for index, output in self._wires.items():
            volts[index] = output_volts[output, tick_indices]
        for index, voltage in self._sources.items():
            try:
                volts[index] = voltage(numbers / rate)
                if np.isnan(volts[index]).any():
                    raise ValueError("the voltage is not a number (NaN)")
            except Exception as error:
                raise DaqError(
                    f"the source at {self.channels[index].name} has failed: {error!r}. A function must return the "
                    "voltages, V, at an array of times, s.",
                    Code.UNKNOWN,
                ) from error
        for index in self._ac_coupled & self._connected:
            volts[index] = self._remove_offset(index, rate, first, volts[index])
        full_scale = np.array([[2.0 ** (bits - 1)] for bits in self._bits])
        counts = np.rint(volts / np.array([[channel.volts_per_count] for channel in self.channels]))
        limited = np.clip(counts, -full_scale, full_scale - 1)
        return Block(first, limited.astype(np.int32), limited != counts)

    def _remove_offset(self, index: int, rate: float, first: int, volts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the first-order high-pass filter of AC coupling to samples from number `first` on.

        If the previous sample is unknown, the input is assumed to have settled at the first voltage.
        """
        if not volts.size:
            return volts
        from scipy.signal import lfilter

        number, last, last_output = self._coupling_states.get((index, rate), (-1, 0.0, 0.0))
        if number != first:
            last, last_output = float(volts[0]), 0.0
        factor = math.exp(-2.0 * math.pi * _AC_CORNER_HZ / rate)
        output, _ = lfilter([factor], [1.0, -factor], np.diff(volts, prepend=last), zi=[factor * last_output])
        self._coupling_states[index, rate] = first + volts.size, float(volts[-1]), float(output[-1])
        return np.asarray(output, dtype=np.float64)

    def set_conditioning(self, channels: Sequence[Channel], in_use: Collection[int]) -> None:
        """Set the couplings and ranges of a task's inputs; `in_use` are the inputs that other tasks are reading."""
        infos = list(self.channels)
        for channel in channels:
            index, is_ac = channel.bench_index, channel.settings["ai_coupling"] == Coupling.AC
            if index in in_use and (is_ac, channel.range) != (index in self._ac_coupled, infos[index].range):
                raise DaqError(
                    f"{channel.port.name} is in use with a different coupling or range. Stop the task that uses it, or "
                    "choose the same settings.",
                    Code.PAL_RESOURCE_RESERVED,
                )
            (self._ac_coupled.add if is_ac else self._ac_coupled.discard)(index)
            infos[index] = _with_range(infos[index], channel.range, self._bits[index])
        self.channels = tuple(infos)

    def supply(self, bench_index: int) -> float | None:
        """See `Terminals.supply`: the inputs have no sensors."""
        return None

    def teds(self, bench_index: int) -> bytes | None:
        """See `Terminals.teds`: the inputs have no sensors."""
        return None

    def pulse_frequency(self, owner: str, terminal: str) -> float:
        """See `Terminals.pulse_frequency`."""
        return self._pulses.get(f"{owner}/{terminal}", self._pulses.get(terminal, 0.0))

    def filter_properties(self, bench_index: int, rate: float | None) -> dict[str, Any]:
        """See `Terminals.filter_properties`: the inputs have no filter."""
        return {"ai_filter_delay": 0.0, "ai_remove_filter_delay": True}


def _input(module: Module, number: int, rate: float) -> ChannelInfo:
    """Return the description of an input with its largest range."""
    info = ChannelInfo(f"{module.name}/ai{number}", "drive", "voltage", sensitivity=1.0, rate=rate)
    return _with_range(info, module.ranges[-1], module.bits or 32)


def _with_range(info: ChannelInfo, limit: float, bits: int) -> ChannelInfo:
    return replace(info, range=limit, volts_per_count=limit / 2.0 ** (bits - 1))


def _tick_rate(modules: Sequence[Module]) -> float:
    """Return ticks per second: the lowest multiple of a module's clock that is at least the fastest rate.

    Samples of modules that divide one clock then coincide with ticks.
    """
    rates = [module.rates for module in modules if module.inputs]
    rates += [module.output_rates for module in modules if module.outputs]
    fastest = max(rate.fastest for rate in rates)
    clock = max((rate.fastest for rate in rates if rate.available), default=fastest)
    # A ratio that exceeds a whole number by a rounding error is this number.
    return clock * math.ceil(fastest / clock - 1e-9)
