"""Connecting a chassis: what is on the bench that scripts and tasks find."""

from __future__ import annotations

import os
from pathlib import Path

import rig
from daq.instrument.chassis import Chassis
from daq.instrument.clock import Clock
from daq.instrument.clock import clock as make_clock

_connected: list[Chassis] = []


def connect(scene: rig.Scene | str | Path | None = None, clock: str | Clock | None = None) -> Chassis:
    """Put a chassis in front of a scene's bench; tasks made from now on are on it.

    Parameters
    ----------
    scene : Scene or str or Path, optional
        Scene, name of a bundled one, or path of a scene file. Else the one named by the environment variable
        SHOTRIG_SCENE, else `default_scene`.
    clock : {'real', 'fast', 'manual'} or Clock, optional
        What lets time pass, see `daq.instrument.clock`. Else what the environment variable SHOTRIG_CLOCK says, else
        'real': a live bench.

    Returns
    -------
    Chassis

    Raises
    ------
    SceneError
        If the scene cannot be used or there is no such clock.
    """
    if scene is None:
        scene = os.environ.get("SHOTRIG_SCENE") or default_scene()
    if clock is None:
        clock = os.environ.get("SHOTRIG_CLOCK") or "real"
    chassis = Chassis(scene if isinstance(scene, rig.Scene) else rig.load(scene), make_clock(clock))
    _connected[:] = [chassis]
    return chassis


def connected() -> Chassis:
    """Give the chassis that new tasks are on; connects the default scene if nothing has been connected."""
    return _connected[0] if _connected else connect()


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
