"""Capabilities of data acquisition modules according to their data sheets, independent of the wiring.

A scene names modules as `converter: {preset: NI 9234}` for its inputs and as `output: {preset: NI 9260}` of a shaker.
Their effect on the signal is part of the settings. This module describes which requests of a client program (channels,
rates, ranges) the hardware accepts:

>>> sheet = module("NI 9234")
>>> sheet.product_type, sheet.inputs.channels, sheet.inputs.supply, sheet.inputs.on_demand
('NI 9234', 4, (0.002,), False)
>>> sheet.inputs.rates.at_least(8000.0)
8533.333333333334
>>> module("NI 9260").outputs.ranges
(4.24264068712,)

`module(scene.converter.preset)` is the module at the inputs, `module(shaker.output.preset)` the module at a shaker's
output; without a preset, inputs and outputs are ideal. A client's choice of coupling or supply for one channel
becomes a setting of that channel: `channel.replace(coupling="DC", excitation=0.0)`.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from math import ceil, floor, prod
from typing import Any, Literal

from rig.core.base.errors import SceneError
from rig.core.data_sheets.data_sheets import data_sheet
from rig.core.settings.quantities import CURRENT, FREQUENCY, VOLTAGE, parse

Terminal = Literal["pseudo_differential", "differential", "rse"]
Conversion = Literal["delta_sigma", "sar", "r_2r"]


@dataclass(frozen=True)
class Rates:
    """Sample rates that a module's clock can generate.

    >>> Rates(0.1, 250e3, timebase=20e6).at_least(44100.0)  # 20 MHz / 453
    44150.11037527594
    """

    slowest: float  # Hz
    fastest: float  # Hz
    # all rates, ascending, if they are the clock divided by whole numbers; empty: any rate between
    available: tuple[float, ...] = ()
    # frequency of the clock that any whole number divides, such as 20 MHz [Hz]; None: the rates are exact
    timebase: float | None = None

    def at_least(self, rate: float) -> float:
        """Return the lowest available rate that is not below a request; raise `SceneError` if there is none."""
        # Tolerate a request that was rounded to a few digits.
        min_rate = rate * (1.0 - 1e-4)
        if not 0.0 < min_rate <= self.fastest:
            raise SceneError(f"got {rate:g} Hz; expected {self.slowest:g} to {self.fastest:g} Hz")
        if self.available:
            return self.available[bisect_left(self.available, min_rate)]
        limited = min(max(rate, self.slowest), self.fastest)
        if self.timebase is None:
            return limited
        # A quotient that is below a whole number by a rounding error is this number.
        return self.timebase / max(floor(self.timebase / limited + 1e-6), ceil(self.timebase / self.fastest - 1e-6))


@dataclass(frozen=True)
class Inputs:
    """The inputs of a module."""

    channels: int  # number of channels, sampled simultaneously
    rates: Rates  # rates of the sample clock
    ranges: tuple[float, ...]  # full-scale ranges, ± V, in ascending order
    couplings: tuple[Literal["AC", "DC"], ...]  # the first is the default for a sensor with supply
    terminals: tuple[Terminal, ...]  # terminal configurations; the first is the default
    supply: tuple[float, ...]  # supply currents for IEPE sensors other than zero [A]
    supply_coupling: Literal["AC", "any"]  # coupling that the supply requires
    conversion: Conversion
    teds: bool  # whether the module reads the electronic data sheets (TEDS) of sensors

    @property
    def on_demand(self) -> bool:
        """Return whether single samples can be read without a sample clock, which a decimation filter prevents."""
        return self.conversion != "delta_sigma"


@dataclass(frozen=True)
class Outputs:
    """The outputs of a module; fields as in `Inputs`."""

    channels: int  # number of channels, updated simultaneously
    rates: Rates
    ranges: tuple[float, ...]
    terminals: tuple[Terminal, ...]
    conversion: Conversion
    on_demand: bool  # whether single values can be written without a sample clock


@dataclass(frozen=True)
class Module:
    """A module of a chassis, or a stand-alone device."""

    name: str  # name in presets
    product_type: str  # name in the driver
    family: Literal["c_series", "usb"]  # module in the slot of a chassis, or stand-alone device
    inputs: Inputs | None
    outputs: Outputs | None
    input_bits: int | None  # resolution of the converters of its inputs
    output_bits: int | None


@cache
def module(name: str) -> Module:
    """Return a module by its preset name, except for case, spaces and hyphens; raise `SceneError` if unknown."""
    sheet = data_sheet(name, "module")
    facts, settings = sheet.facts, sheet.settings
    return Module(
        name=sheet.name,
        **facts["module"],
        inputs=_inputs(facts["inputs"]) if "inputs" in facts else None,
        outputs=_outputs(facts["outputs"]) if "outputs" in facts else None,
        input_bits=settings.get("converter", {}).get("bits"),
        output_bits=settings.get("output", {}).get("bits"),
    )


def _inputs(facts: dict[str, Any]) -> Inputs:
    return Inputs(
        **{key: facts[key] for key in ("channels", "supply_coupling", "conversion", "teds")},
        rates=_rates(facts["rates"]),
        ranges=tuple(parse(value, VOLTAGE) for value in facts["ranges"]),
        couplings=tuple(facts["couplings"]),
        terminals=tuple(facts["terminals"]),
        supply=tuple(parse(value, CURRENT) for value in facts["supply"]),
    )


def _outputs(facts: dict[str, Any]) -> Outputs:
    return Outputs(
        **{key: facts[key] for key in ("channels", "conversion", "on_demand")},
        rates=_rates(facts["rates"]),
        ranges=tuple(parse(value, VOLTAGE) for value in facts["ranges"]),
        terminals=tuple(facts["terminals"]),
    )


def _rates(facts: dict[str, Any]) -> Rates:
    if "clock" not in facts:
        return Rates(parse(facts["slowest"], FREQUENCY), parse(facts["fastest"], FREQUENCY))
    clock = parse(facts["clock"], FREQUENCY)
    divisors = {prod(factors) for factors in product(*map(_factors, facts["divided_by"]))}
    available = tuple(sorted(clock / divisor for divisor in divisors))
    return Rates(available[0], available[-1], available)


def _factors(divisors: int | list[int] | dict[str, int]) -> Sequence[int]:
    """Return the possible divisors of a clock: a number, a list or a range."""
    if isinstance(divisors, dict):
        return range(divisors["from"], divisors["to"] + 1)
    return divisors if isinstance(divisors, list) else [divisors]
