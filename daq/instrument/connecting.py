"""Putting a chassis in front of a scene: its modules, its clock, its bench."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import rig
from daq.instrument.bench_source import SceneSource
from daq.instrument.chassis import Chassis
from daq.instrument.clock import Clock
from daq.instrument.clock import clock as make_clock
from daq.instrument.modules import CHASSIS_CATEGORY, SOUND_AND_VIBRATION, USB_BUS, Module
from daq.instrument.values import Coupling, Wiring
from rig.scene.modules import Inputs, module
from rig.scene.presets import filled_in


def connect_scene(scene: rig.Scene | str | Path | None = None, clock: str | Clock | None = None) -> Chassis:
    """Put a chassis in front of a scene's bench.

    Parameters
    ----------
    scene : Scene or str or Path, optional
        Scene, name of a bundled one, or path of a scene file. Else the one named by the environment variable
        SHOTRIG_SCENE, else `default_scene`.
    clock : {'real', 'fast', 'manual'} or Clock, optional
        What lets time pass, see `daq.instrument.clock`. Else what the environment variable SHOTRIG_CLOCK says,
        else 'real': a live bench.

    Raises
    ------
    SceneError
        If the scene cannot be used or there is no such clock.
    """
    if scene is None:
        scene = os.environ.get("SHOTRIG_SCENE") or default_scene()
    chosen = make_clock(clock if clock is not None else os.environ.get("SHOTRIG_CLOCK") or "real")
    loaded = scene if isinstance(scene, rig.Scene) else rig.load(scene)

    def switch_on(rate: float | None) -> SceneSource:
        source = SceneSource(loaded, rate)
        if chosen.runs_free:
            source.warm_up()
        return source

    first = SceneSource(loaded, None)
    return Chassis(scene_modules(loaded, first), switch_on, chosen)


def scene_modules(scene: rig.Scene, source: SceneSource) -> list[Module]:
    """Give the chassis of a scene with its modules.

    Inputs fill as many modules of the kind the scene's converter names as are needed; the outputs are on the
    next one. Where no module is named, one takes all inputs, as ideal as the scene's converter is.

    Parameters
    ----------
    scene : Scene
        The scene.
    source : SceneSource
        Its bench.
    """
    converter, named = filled_in(scene.converter), scene.converter.preset
    inputs, outputs = range(len(source.channels)), range(len(source.drive_per_volt))
    order = (Coupling.AC, Coupling.DC) if converter.coupling == "AC" else (Coupling.DC, Coupling.AC)
    sheet = Module(
        name="",
        product_type="shotrig inputs",
        ranges=(float(converter.range),) if converter.range else (),
        bits=converter.bits,
        couplings=order,
        own_rate=source.rate,
        on_demand=converter.filter is None,
    )
    size = max(1, len(inputs))
    if named is not None:
        described = module(named)
        assert described.inputs is not None  # as the scene's converter is one
        sheet = _described(sheet, described.product_type, described.inputs)
        size = described.inputs.channels
    found = [Module("cDAQ1", "cDAQ-9178", category=CHASSIS_CATEGORY, bus=USB_BUS)]
    for first in range(0, max(1, len(inputs)), size):
        rows = tuple(inputs[first : first + size])
        found.append(replace(sheet, name=f"cDAQ1Mod{len(found)}", inputs=rows, slot=len(found)))
    found.append(replace(_OUTPUTS, name=f"cDAQ1Mod{len(found)}", slot=len(found), outputs=tuple(outputs)))
    everything = replace(
        sheet, inputs=tuple(inputs), outputs=tuple(outputs), category=SOUND_AND_VIBRATION, bus=USB_BUS
    )
    return [
        found[0],
        *(replace(each, chassis="cDAQ1", own_rate=source.rate) for each in found[1:]),
        everything,
    ]


_OUTPUTS = Module("", "shotrig outputs")
_WIRINGS = {
    "pseudo_differential": Wiring.PSEUDO_DIFFERENTIAL,
    "differential": Wiring.DIFFERENTIAL,
    "rse": Wiring.RSE,
}


def _described(sheet: Module, product_type: str, inputs: Inputs) -> Module:
    """Give inputs what their module's data sheet says; the coupling that the scene sets comes first."""
    return replace(
        sheet,
        product_type=product_type,
        ranges=inputs.ranges,
        rates=inputs.rates,
        couplings=tuple(each for each in sheet.couplings if each.name in inputs.couplings),
        wirings=tuple(_WIRINGS[each] for each in inputs.terminals),
        currents=inputs.supply,
        on_demand=inputs.on_demand,
        teds=inputs.teds,
    )


def default_scene() -> rig.Scene:
    """Give what is on the bench unless a scene is named: the paper's rig with three dampers.

    Its four accelerometers are wired to the inputs without the integrating amplifiers in between, and the
    inputs take ±10 V: that is what scripts written for a vibration module, or for a multifunction device,
    find elsewhere.

    Examples
    --------
    >>> scene = default_scene()
    >>> [channel.at for channel in scene.channels], scene.converter.range
    (['body 1', 'body 2', 'body 3', 'table'], 10.0)
    """
    scene = rig.load("fig8-three-dampers")
    channels = None
    if scene.channels is not None:
        channels = tuple(channel.replace(integrator=None) for channel in scene.channels)
    return scene.replace(channels=channels, converter=scene.converter.replace(range=10.0))
