"""The outputs in front of the shakers: a drive as their range and resolution let it through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rig.arrays import Array
from rig.scene.presets import filled_in
from rig.scene.scene import Scene
from rig.scene.shaker import DRIVE_PER_VOLT, ElectrodynamicShaker, ForceShaker, at_shaker


class Outputs:
    """Clips and quantises the drive at the range of each output; the hammer and unspecified outputs pass everything.

    >>> import rig
    >>> scene = rig.load("reference-A")
    >>> scene = scene.replace(shaker=scene.shaker.replace(output={"range": 1.0, "bits": 8}))
    >>> Outputs(scene, ["shaker"], ["N"]).put_out(np.array([[0.3, 5.0, -5.0]]))
    array([[ 0.296875 ,  0.9921875, -1.       ]])
    """

    def __init__(self, scene: Scene, inputs: Sequence[str], units: Sequence[str]) -> None:
        self._rows: list[tuple[int, float, float | None]] = []
        for number, shaker in enumerate(scene.shakers, 1):
            settings = filled_in(shaker.output)
            if settings.range is None:
                continue
            row = inputs.index(at_shaker("shaker", number, len(scene.shakers)))
            full = settings.range * DRIVE_PER_VOLT[units[row]]
            self._rows.append((row, full, None if settings.bits is None else 2.0 * full / 2.0**settings.bits))

    def put_out(self, drive: Array) -> Array:
        """Give what becomes of a drive, shape (inputs, samples)."""
        if not self._rows:
            return drive
        given = drive.copy()
        for row, full, step in self._rows:
            if step is None:
                np.clip(given[row], -full, full, out=given[row])
            else:
                given[row] = np.clip(np.rint(given[row] / step), -full / step, full / step - 1.0) * step
        return given


def volt_effect(scene: Scene, number: int) -> str:
    """Describe the effect of one volt of the output of a shaker, by the shaker's number from 1.

    >>> import rig
    >>> volt_effect(rig.load("bare-structure"), 1), volt_effect(rig.load("fig8-no-damper"), 1)
    ('table position, 1 mm/V', 'voltage at the coil, 1 V/V')
    """
    shaker = scene.shakers[number - 1]
    if isinstance(shaker, ForceShaker):
        bodies = " and ".join(f"body {body}" for body in shaker.bodies)
        return f"force on {bodies}, {DRIVE_PER_VOLT['N']:g} N/V"
    place = at_shaker("", number, len(scene.shakers))
    if isinstance(shaker, ElectrodynamicShaker):
        current = shaker.amplifier.mode == "current"
        what, unit = ("current through", "A") if current else ("voltage at", "V")
        return f"{what} the coil{place and f' of shaker{place}'}, {shaker.amplifier.gain:g} {unit}/V"
    return f"table{place} position, {1e3 * DRIVE_PER_VOLT['m']:g} mm/V"
