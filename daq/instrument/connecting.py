"""Connects a chassis to the bench of a scene: creates its modules, its clock and its terminals."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import rig
from daq.instrument.chassis import Chassis
from daq.instrument.clock import Clock
from daq.instrument.clock import clock as make_clock
from daq.instrument.devices.modules import CHASSIS_CATEGORY, COMPACT_DAQ_BUS, SOUND_AND_VIBRATION, USB_BUS, Module
from daq.instrument.terminals import Terminals
from daq.instrument.values import Coupling, Wiring
from rig.scene.modules import Module as Sheet
from rig.scene.modules import module
from rig.scene.presets import complete_from_preset
from rig.scene.shaker import Output


def connect_scene(scene: rig.Scene | str | Path | None = None, clock: str | Clock | None = None) -> Chassis:
    """Connect a chassis to the bench of a scene.

    `scene` is a scene, the name of a bundled scene, or the path of a scene file. The default is the environment
    variable SHOTRIG_SCENE, then `default_scene`. `clock` is 'real', 'fast', 'manual' or a clock of
    `daq.instrument.clock`. The default is the environment variable SHOTRIG_CLOCK, then 'real'. Raises `SceneError` if
    the scene cannot be used or there is no clock of that name.
    """
    if scene is None:
        scene = os.environ.get("SHOTRIG_SCENE") or default_scene()
    bench_clock = make_clock(clock if clock is not None else os.environ.get("SHOTRIG_CLOCK") or "real")
    loaded = scene if isinstance(scene, rig.Scene) else rig.load(scene)

    terminals = Terminals(loaded)
    if bench_clock.runs_free:
        terminals.warm_up()
    return Chassis(_modules(loaded, terminals), terminals, bench_clock)


def _modules(scene: rig.Scene, terminals: Terminals) -> list[Module]:
    """Create the devices of a scene, given the terminals of its bench.

    The converter of the scene names the type of the input modules, the shakers name the output modules. There are as
    many modules as the channels require. C Series modules are in a chassis, others are separate devices. Without a
    named module, an ideal module has all inputs, or all outputs.
    """
    unnamed = _input_modules(scene, terminals)
    outputs = [complete_from_preset(shaker.output) for shaker in scene.shakers]
    for row, output in enumerate(outputs):
        _add_output(unnamed, output, row)
    if not outputs:
        unnamed.append(_IDEAL_OUTPUTS)
    usb, compact = ([module for module in unnamed if module.bus == bus] for bus in (USB_BUS, COMPACT_DAQ_BUS))
    modules = [replace(module, name=f"Dev{number}") for number, module in enumerate(usb, 1)]
    slots = [replace(module, name=f"cDAQ1Mod{slot}", chassis="cDAQ1", slot=slot) for slot, module in enumerate(compact, 1)]
    chassis = [Module("cDAQ1", "cDAQ-9178", category=CHASSIS_CATEGORY, bus=USB_BUS)] if slots else []
    all_channels = replace(
        (modules or slots)[0],
        name="",
        inputs=tuple(range(len(terminals.bench.channels))),
        outputs=tuple(range(len(terminals.drive_per_volt))),
        category=SOUND_AND_VIBRATION,
        bus=USB_BUS,
        chassis="",
        slot=0,
    )
    return [*chassis, *slots, *modules, all_channels]


# Module of the outputs whose shakers name no module.
_IDEAL_OUTPUTS = Module("", "shotrig outputs")


def _input_modules(scene: rig.Scene, terminals: Terminals) -> list[Module]:
    """Return the modules with the inputs of a scene, without names."""
    converter, preset = complete_from_preset(scene.converter), scene.converter.preset
    # The coupling of the scene is the default of an input; scripts may override it.
    couplings = (Coupling.AC, Coupling.DC) if converter.coupling == "AC" else (Coupling.DC, Coupling.AC)
    rows = tuple(range(len(terminals.bench.channels)))
    ideal = Module(
        name="",
        product_type="shotrig inputs",
        inputs=rows,
        ranges=(float(converter.range),) if converter.range else (),
        bits=converter.bits,
        couplings=couplings,
        own_rate=terminals.bench.rate,
        on_demand=converter.filter is None,
    )
    if preset is None:
        return [ideal]
    sheet = module(preset)
    assert sheet.inputs is not None  # the check of the scene ensures this
    inputs = sheet.inputs
    template = replace(
        _device(sheet, ideal),
        ranges=inputs.ranges,
        rates=inputs.rates,
        couplings=tuple(coupling for coupling in couplings if coupling.name in inputs.couplings),
        wirings=tuple(Wiring[name.upper()] for name in inputs.terminals),
        currents=inputs.supply,
        supply_coupling=inputs.supply_coupling,
        on_demand=inputs.on_demand,
        teds=inputs.teds,
    )
    first_rows = range(0, max(1, len(rows)), inputs.channels)
    return [replace(template, inputs=rows[first : first + inputs.channels]) for first in first_rows]


def _device(sheet: Sheet, template: Module) -> Module:
    """Return a copy of a module with the product type of a data sheet; only C Series modules are in a chassis."""
    if sheet.family == "c_series":
        return replace(template, product_type=sheet.product_type)
    return replace(template, product_type=sheet.product_type, category=SOUND_AND_VIBRATION, bus=USB_BUS)


def _add_output(modules: list[Module], output: Output, row: int) -> None:
    """Assign an output to the first module of its type with a free output, or to a new module."""
    sheet = None if output.preset is None else module(output.preset)
    outputs = None if sheet is None else sheet.outputs
    template = _IDEAL_OUTPUTS
    if sheet is not None and outputs is not None:
        template = replace(
            _device(sheet, template),
            output_range=output.range or outputs.ranges[-1],
            output_bits=output.bits,
            output_rates=outputs.rates,
            output_on_demand=outputs.on_demand,
        )
    elif output.range is not None:
        template = replace(template, output_range=output.range, output_bits=output.bits)
    # An output without a named module is ideal: its module has any number of outputs.
    max_outputs = 1 << 30 if outputs is None else outputs.channels
    settings = ("output_range", "output_bits", "output_rates", "output_on_demand")
    for number, each in enumerate(modules):
        has_free_output = each.product_type == template.product_type and len(each.outputs) < max_outputs
        is_equal = not each.outputs or all(getattr(each, key) == getattr(template, key) for key in settings)
        if has_free_output and is_equal:
            modules[number] = replace(
                each, outputs=(*each.outputs, row), **{key: getattr(template, key) for key in settings}
            )
            return
    modules.append(replace(template, outputs=(row,)))


def default_scene() -> rig.Scene:
    """Return the default scene: the paper's rig with three dampers.

    Its four accelerometers are connected directly to the inputs, without the integrating amplifiers, and the input
    range is ±10 V, as scripts for a vibration module or a multifunction device expect.

    >>> scene = default_scene()
    >>> [channel.at for channel in scene.channels], scene.converter.range
    (['body 1', 'body 2', 'body 3', 'table'], 10.0)
    """
    scene = rig.load("fig8-three-dampers")
    channels = None
    if scene.channels is not None:
        channels = tuple(channel.replace(integrator=None) for channel in scene.channels)
    return scene.replace(channels=channels, converter=scene.converter.replace(range=10.0))
