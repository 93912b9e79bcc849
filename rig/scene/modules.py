"""Modules of data acquisition hardware as their data sheets describe them: what one can do, whatever is wired to it.

A scene names modules as `converter: {preset: NI 9234}` for its inputs and as `output: {preset: NI 9260}` of a shaker.
What that makes of the signal is in the settings themselves; what a client of the instrument can ask of the module, and
what it has to refuse, is here:

>>> sheet = module("NI 9234")
>>> sheet.product_type, sheet.inputs.channels, sheet.inputs.supply, sheet.inputs.on_demand
('NI 9234', 4, (0.002,), False)
>>> sheet.inputs.rates.at_least(8000.0)
8533.333333333334
>>> module("NI 9260").outputs.ranges
(4.24264068712,)

`module(scene.converter.preset)` is the module at the inputs, `module(shaker.output.preset)` that at a shaker's output;
a scene that names none has ideal ones. A coupling or supply that a client chooses for one channel becomes that
channel's own setting: `channel.replace(coupling="DC", excitation=0.0)`.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from math import prod
from typing import Any, Literal

from rig.errors import SceneError
from rig.scene.data_sheets import data_sheet
from rig.scene.quantities import CURRENT, FREQUENCY, VOLTAGE, parse

Terminal = Literal["pseudo_differential", "differential", "rse"]
Conversion = Literal["delta_sigma", "sar", "r_2r"]


@dataclass(frozen=True)
class Rates:
    """Sample rates that a module's clock can make.

    Attributes
    ----------
    slowest, fastest : float
        Hz.
    ladder : tuple of float
        All there are, rising, where the clock is divided by whole numbers; empty: any rate in between.
    """

    slowest: float
    fastest: float
    ladder: tuple[float, ...] = ()

    def at_least(self, rate: float) -> float:
        """Give the rate that the clock makes of a request: the next one not below it.

        Raises
        ------
        SceneError
            If the request is not positive or the clock is not that fast.
        """
        # A rate that was printed with a few digits still means the one it was rounded from.
        wanted = rate * (1.0 - 1e-4)
        if not 0.0 < wanted <= self.fastest:
            raise SceneError(f"got {rate:g} Hz; expected {self.slowest:g} to {self.fastest:g} Hz")
        if self.ladder:
            return self.ladder[bisect_left(self.ladder, wanted)]
        return min(max(rate, self.slowest), self.fastest)


@dataclass(frozen=True)
class Inputs:
    """The inputs of a module.

    Attributes
    ----------
    channels : int
        How many there are, sampled simultaneously.
    rates : Rates
        Of the sample clock.
    ranges : tuple of float
        Full scales, ± V, rising.
    couplings : tuple of {"AC", "DC"}
        The first is what it is set to by default where a sensor is fed.
    terminals : tuple of {"pseudo_differential", "differential", "rse"}
        Terminal configurations; the first is the default.
    supply : tuple of float
        Currents for IEPE sensors besides none, A.
    supply_coupling : {"AC", "any"}
        With which coupling the supply can be on.
    conversion : {"delta_sigma", "sar"}
        Kind of converter.
    teds : bool
        Whether it reads the electronic data sheets of sensors.
    """

    channels: int
    rates: Rates
    ranges: tuple[float, ...]
    couplings: tuple[Literal["AC", "DC"], ...]
    terminals: tuple[Terminal, ...]
    supply: tuple[float, ...]
    supply_coupling: Literal["AC", "any"]
    conversion: Conversion
    teds: bool

    @property
    def on_demand(self) -> bool:
        """Whether one sample can be read without a sample clock: not behind a decimation filter."""
        return self.conversion != "delta_sigma"


@dataclass(frozen=True)
class Outputs:
    """The outputs of a module.

    Attributes
    ----------
    channels : int
        How many there are, updated simultaneously.
    rates, ranges, terminals
        As in `Inputs`.
    conversion : {"delta_sigma", "r_2r"}
        Kind of converter.
    on_demand : bool
        Whether one value can be put out without a sample clock.
    """

    channels: int
    rates: Rates
    ranges: tuple[float, ...]
    terminals: tuple[Terminal, ...]
    conversion: Conversion
    on_demand: bool


@dataclass(frozen=True)
class Module:
    """A module, or a device of its own.

    Attributes
    ----------
    name : str
        What presets call it.
    product_type : str
        As its driver names it.
    family : {"c_series", "usb"}
        Whether it sits in the slot of a chassis, or is a device of its own.
    inputs : Inputs or None
    outputs : Outputs or None
    input_bits, output_bits : int or None
        Resolution of its converters.
    """

    name: str
    product_type: str
    family: Literal["c_series", "usb"]
    inputs: Inputs | None
    outputs: Outputs | None
    input_bits: int | None
    output_bits: int | None


@cache
def module(name: str) -> Module:
    """Find a module by the name that presets have; capitals, spaces and hyphens do not matter.

    Raises
    ------
    SceneError
        If there is none of that name.
    """
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


def _inputs(given: dict[str, Any]) -> Inputs:
    return Inputs(
        **{key: given[key] for key in ("channels", "supply_coupling", "conversion", "teds")},
        rates=_rates(given["rates"]),
        ranges=tuple(parse(value, VOLTAGE) for value in given["ranges"]),
        couplings=tuple(given["couplings"]),
        terminals=tuple(given["terminals"]),
        supply=tuple(parse(value, CURRENT) for value in given["supply"]),
    )


def _outputs(given: dict[str, Any]) -> Outputs:
    return Outputs(
        **{key: given[key] for key in ("channels", "conversion", "on_demand")},
        rates=_rates(given["rates"]),
        ranges=tuple(parse(value, VOLTAGE) for value in given["ranges"]),
        terminals=tuple(given["terminals"]),
    )


def _rates(given: dict[str, Any]) -> Rates:
    if "clock" not in given:
        return Rates(parse(given["slowest"], FREQUENCY), parse(given["fastest"], FREQUENCY))
    clock = parse(given["clock"], FREQUENCY)
    divisors = {prod(factors) for factors in product(*map(_factors, given["divided_by"]))}
    ladder = tuple(sorted(clock / divisor for divisor in divisors))
    return Rates(ladder[0], ladder[-1], ladder)


def _factors(given: int | list[int] | dict[str, int]) -> Sequence[int]:
    """Read what a clock can be divided by: a number, one of several, or one of a range."""
    if isinstance(given, dict):
        return range(given["from"], given["to"] + 1)
    return given if isinstance(given, list) else [given]
