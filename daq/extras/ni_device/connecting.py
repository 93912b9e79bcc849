"""Connection of a chassis to the bench of a scene: its modules, its clock and its terminals."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import rig
from daq.extras.ni_device.chassis import Chassis
from daq.extras.ni_device.clock import Clock
from daq.extras.ni_device.clock import clock as make_clock
from daq.extras.ni_device.devices.modules import (
    CHASSIS_CATEGORY,
    COMPACT_DAQ_BUS,
    SOUND_AND_VIBRATION_CATEGORY,
    USB_BUS,
    Module,
)
from daq.extras.ni_device.terminals import Terminals
from daq.extras.ni_device.values import Coupling, TerminalConfiguration
from rig.core.data_sheets.modules import Inputs, Outputs
from rig.core.data_sheets.modules import Module as ModuleSheet
from rig.core.data_sheets.modules import module as module_sheet
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.shaker import Output


def connect_scene(scene: rig.Scene | str | Path | None = None, clock: str | Clock | None = None) -> Chassis:
    """Connect a chassis to the bench of a scene.

    `scene` is a scene, the name of a bundled scene, or the path of a scene file. The default is the environment
    variable SHOTRIG_SCENE, then `default_scene`. `clock` is 'real', 'fast', 'manual' or a clock of
    `daq.extras.ni_device.clock`. The default is the environment variable SHOTRIG_CLOCK, then 'real'. Raises
    `SceneError` if the scene cannot be used or there is no clock of that name.
    """
    if scene is None:
        scene = os.environ.get("SHOTRIG_SCENE") or default_scene()
    bench_clock = make_clock(clock if clock is not None else os.environ.get("SHOTRIG_CLOCK") or "real")
    loaded = scene if isinstance(scene, rig.Scene) else rig.load(scene)

    terminals = Terminals(loaded)
    if bench_clock.is_free_running:
        terminals.warm_up()
    return Chassis(_modules(loaded, terminals), terminals, bench_clock)


def _modules(scene: rig.Scene, terminals: Terminals) -> list[Module]:
    """Create the devices of a scene, given the terminals of its bench.

    The converter of the scene specifies the type of the input modules; each shaker specifies the type of its output
    module. The number of modules is the smallest that the channels require. C Series modules are in a chassis, others
    are separate devices. If no type is stated, an ideal module has all inputs, or all outputs. The last device has an
    empty name, see `DeviceList`.
    """
    modules = _input_modules(scene, terminals)
    outputs = [complete_from_preset(shaker.output) for shaker in scene.shakers]
    for index, output in enumerate(outputs):
        _add_output(modules, output, index)
    if not outputs:
        modules.append(_IDEAL_OUTPUTS)
    all_channels = replace(
        next((module for module in modules if module.bus == USB_BUS), modules[0]),
        name="",
        inputs=tuple(range(len(terminals.bench.channels))),
        outputs=tuple(range(len(terminals.drive_per_volt))),
        category=SOUND_AND_VIBRATION_CATEGORY,
        bus=USB_BUS,
        chassis="",
        slot=0,
    )
    return [*name_devices(modules, "cDAQ-9178"), all_channels]


def name_devices(modules: Sequence[Module], chassis_type: str) -> list[Module]:
    """Return modules with the names that NI's driver assigns, after the chassis of the C Series modules, if any."""
    separate, in_chassis = ([module for module in modules if module.bus == bus] for bus in (USB_BUS, COMPACT_DAQ_BUS))
    chassis = [Module("cDAQ1", chassis_type, category=CHASSIS_CATEGORY, bus=USB_BUS)] if in_chassis else []
    return [
        *chassis,
        *(
            replace(module, name=f"cDAQ1Mod{slot}", chassis="cDAQ1", slot=slot)
            for slot, module in enumerate(in_chassis, 1)
        ),
        *(replace(module, name=f"Dev{number}") for number, module in enumerate(separate, 1)),
    ]


# Module of the outputs whose shakers state no module.
_IDEAL_OUTPUTS = Module("", "shotrig outputs")


def _input_modules(scene: rig.Scene, terminals: Terminals) -> list[Module]:
    """Return the modules with the inputs of a scene, without names."""
    converter, preset = complete_from_preset(scene.converter), scene.converter.preset
    # The coupling in the scene is the default, so it is listed first; scripts may override it.
    couplings = (Coupling.AC, Coupling.DC) if converter.coupling == "AC" else (Coupling.DC, Coupling.AC)
    indices = tuple(range(len(terminals.bench.channels)))
    ideal = Module(
        name="",
        product_type="shotrig inputs",
        inputs=indices,
        ranges=(float(converter.range),) if converter.range else (),
        bits=converter.bits,
        couplings=couplings,
        scene_rate=terminals.bench.rate,
        on_demand=converter.filter is None,
    )
    if preset is None:
        return [ideal]
    sheet = module_sheet(preset)
    assert sheet.inputs is not None  # the scene accepts only modules with inputs
    template, n_inputs = with_inputs(ideal, sheet, sheet.inputs), sheet.inputs.channels
    first_indices = range(0, max(1, len(indices)), n_inputs)
    return [replace(template, inputs=indices[first : first + n_inputs]) for first in first_indices]


def with_inputs(template: Module, sheet: ModuleSheet, inputs: Inputs) -> Module:
    """Return a module with the input properties of a data sheet, and the couplings common to both."""
    return replace(
        _with_product_type(sheet, template),
        ranges=inputs.ranges,
        rates=inputs.rates,
        couplings=tuple(coupling for coupling in template.couplings if coupling.name in inputs.couplings),
        terminal_configurations=tuple(TerminalConfiguration[name.upper()] for name in inputs.terminals),
        currents=inputs.supply,
        supply_coupling=inputs.supply_coupling,
        on_demand=inputs.on_demand,
        teds=inputs.teds,
    )


def with_outputs(template: Module, sheet: ModuleSheet, outputs: Outputs) -> Module:
    """Return a module with the properties of the outputs of a data sheet."""
    return replace(
        _with_product_type(sheet, template),
        output_range=outputs.ranges[-1],  # the largest range: they ascend
        output_bits=sheet.output_bits,
        output_rates=outputs.rates,
        output_on_demand=outputs.on_demand,
    )


def _with_product_type(sheet: ModuleSheet, template: Module) -> Module:
    """Return a module with the product type of a data sheet, as a separate device if it is not a C Series module."""
    if sheet.family == "c_series":
        return replace(template, product_type=sheet.product_type)
    return replace(template, product_type=sheet.product_type, category=SOUND_AND_VIBRATION_CATEGORY, bus=USB_BUS)


def _add_output(modules: list[Module], output: Output, index: int) -> None:
    """Assign an output of the bench to the first module of its type with a free output, or to a new module."""
    sheet = None if output.preset is None else module_sheet(output.preset)
    outputs = None if sheet is None else sheet.outputs
    template = _IDEAL_OUTPUTS
    if sheet is not None and outputs is not None:
        template = with_outputs(template, sheet, outputs)
        template = replace(template, output_range=output.range or template.output_range, output_bits=output.bits)
    elif output.range is not None:
        template = replace(template, output_range=output.range, output_bits=output.bits)
    # A module without a stated type has any number of outputs.
    max_outputs = 1 << 30 if outputs is None else outputs.channels
    settings = ("output_range", "output_bits", "output_rates", "output_on_demand")
    for number, module in enumerate(modules):
        has_free_output = module.product_type == template.product_type and len(module.outputs) < max_outputs
        is_equal = not module.outputs or all(getattr(module, key) == getattr(template, key) for key in settings)
        if has_free_output and is_equal:
            modules[number] = replace(
                module, outputs=(*module.outputs, index), **{key: getattr(template, key) for key in settings}
            )
            return
    modules.append(replace(template, outputs=(index,)))


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
