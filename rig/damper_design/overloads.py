"""Accelerometers that landings overload, told before a check of a design is recorded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rig.damper_design.check import Expected
from rig.results import plainly
from rig.scene.presets import filled_in
from rig.scene.scene import STANDARD_GRAVITY, Scene
from rig.system.assembly import assemble
from rig.system.hybrid_system import HybridSystem

Array = NDArray[np.float64]

#: A sensor that follows without loss what steps up to a value swings to so many times that.
_SWING = 2.0


def overloads(scene: Scene, expected: Sequence[Expected]) -> list[str]:
    """Say which accelerometers cannot follow the landings at the peaks that a check is to measure, and what helps.

    Parameters
    ----------
    scene : Scene
        The check.
    expected : sequence of Expected
        What it is to measure at each level.

    Returns
    -------
    list of str
        Behind an empty line one for each sensor, then one that says what to do; nothing where all follow.
    """
    system = assemble(scene)
    lines: list[str] = []
    for channel in scene.channels or ():
        sensor = None if channel.accelerometer is None else filled_in(channel.accelerometer)
        if sensor is None or sensor.saturation is None:
            continue
        row = system.points.index(channel.at)
        shaken = [shaken_by(system, row, each.closing_speed, sensor.resonance) for each in expected]
        beyond = [k for k, size in enumerate(shaken) if size > sensor.saturation]
        if beyond:
            levels = ", ".join(plainly(expected[k].peak.level) for k in beyond)
            levels = ", ".join(plainly(expected[k].peak.level) for k in beyond)
            fastest = max(max(expected[k].closing_speed) for k in beyond)
            lines.append(
                f"{channel.name}: landings of up to {fastest:.2g} m/s shake its accelerometer with up to "
                f"{_acceleration(max(shaken))}, and it follows {_acceleration(sensor.saturation)}: points about the "
                f"peaks at {levels} N will be overloaded, and left out by the analysis"
            )
    return ["", *lines, _cure(system)] if lines else []


def shaken_by(
    system: HybridSystem, row: int, closing_speed: Sequence[float], resonance: float | None
) -> float:
    """How far landings drive an accelerometer, m/s^2: the largest of all dampers'.

    A landing at once makes its body's velocity jump, which shakes a sensor with that jump times 2 pi resonance, and one
    without a resonance without bound. One that lasts begins with a step of force, that of the wall's dashpot; where
    there is next to none, the force rises to that of its spring.

    Parameters
    ----------
    system : HybridSystem
        As it is assembled.
    row : int
        Coordinate of the point that carries the sensor.
    closing_speed : sequence of float, shape (dampers,)
        m/s.
    resonance : float or None
        Hz.

    Examples
    --------
    >>> import rig
    >>> jump = 0.1 * 0.71 / 0.781  # of a tenth of the body's mass at 1 m/s
    >>> system = assemble(rig.load("fig9", {"dampers": [{"body": 2, "mass_ratio": 0.1, "clearance": 1e-3}]}))
    >>> round(shaken_by(system, 1, [1.0], 1000.0) / (2 * np.pi * 1000.0 * jump), 9), shaken_by(system, 0, [1.0], None)
    (1.0, 0.0)
    """
    mobility = np.linalg.inv(system.mass)
    found = [0.0]
    for j, speed in enumerate(closing_speed):
        body = system.damper_coordinate[j]
        if system.lasting[j]:
            reduced, wall = system.reduced_mass[j], (system.wall_damping[j], system.wall_stiffness[j])
            force = speed * float(np.maximum(wall[0], np.sqrt(reduced * wall[1])).max())
            found.append((1.0 if resonance is None else _SWING) * abs(mobility[row, body]) * force)
            continue
        impulse = (1.0 + system.restitution[j]) * speed / (1.0 / system.damper_mass[j] + mobility[body, body])
        jump = abs(mobility[row, body]) * impulse
        rate = np.inf if resonance is None else 2.0 * np.pi * resonance
        found.append(float(jump * rate) if jump else 0.0)
    return float(max(found))


def _acceleration(size: float) -> str:
    if np.isinf(size):
        return "more than any sensor withstands"
    return f"{plainly(float(f'{size / STANDARD_GRAVITY:.2g}'))} g"


def _cure(system: HybridSystem) -> str:
    if system.lasting.all():
        return "what helps: sensors of a larger range, or lower levels"
    return (
        "what helps: contact: {duration: 2 ms} in the first damper of the scene that the design was for, and the "
        "design again: its landings last then, as those of shot do; or sensors of a larger range"
    )
