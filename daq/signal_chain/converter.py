"""Converters: the input turns volts into counts; the outputs limit and quantize the drives of the shakers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from rig.arrays import Array
from rig.scene.measurement_chain import Converter as Settings
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene
from rig.scene.shaker import DRIVE_PER_VOLT, ElectrodynamicShaker, ForceShaker, at_shaker


def volts_per_count(settings: Settings) -> float | None:
    """Return the size of a count, V; None without bits and a range.

    >>> volts_per_count(Settings(bits=8, range="1 V"))
    0.0078125
    """
    if settings.bits is None or settings.range is None:
        return None
    return float(2.0 * settings.range / 2.0**settings.bits)


class Quantizer:
    """Quantizes and clips; the most positive code is a count less than the range, as in two's complement.

    >>> quantizer = Quantizer(Settings(bits=8, range="1 V"))
    >>> quantizer.convert(np.array([[0.5, -0.004, 1.5]]))
    (array([[ 64,  -1, 127]], dtype=int32), array([[False, False,  True]]))
    """

    def __init__(self, settings: Settings) -> None:
        settings = complete_from_preset(settings)
        self._bits, self._range = settings.bits, settings.range
        self._count = volts_per_count(settings)
        dropped = [(round(block.at * settings.sample_rate), block.samples) for block in settings.dropped_blocks]
        self.lost = _merge_blocks((first, first + samples - 1) for first, samples in sorted(dropped))

    def convert(self, volts: Array) -> tuple[Array | NDArray[np.int32], NDArray[np.bool_]]:
        """Return the volts, or counts where the converter has bits, and where the volts exceed the range."""
        if self._range is None:
            return volts, np.zeros(volts.shape, dtype=bool)
        if self._bits is None or self._count is None:
            samples = np.clip(volts, -self._range, self._range)
            return samples, samples != volts
        codes = volts / self._count
        np.rint(codes, out=codes)
        full_scale = 2.0 ** (self._bits - 1)
        clipped = np.minimum(np.maximum(codes, -full_scale), full_scale - 1.0)
        return clipped.astype(np.int32), clipped != codes


def _merge_blocks(blocks: Iterable[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """Join blocks that overlap or touch."""
    merged: list[tuple[int, int]] = []
    for first, last in blocks:
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = (merged[-1][0], max(merged[-1][1], last))
        else:
            merged.append((first, last))
    return tuple(merged)


class Outputs:
    """Clips and quantizes the drive at the range of each output; the hammer and unspecified outputs pass everything.

    >>> import rig
    >>> scene = rig.load("reference-A")
    >>> scene = scene.replace(shaker=scene.shaker.replace(output={"range": 1.0, "bits": 8}))
    >>> Outputs(scene, ["shaker"], ["N"]).put_out(np.array([[0.3, 5.0, -5.0]]))
    array([[ 0.296875 ,  0.9921875, -1.       ]])
    """

    def __init__(self, scene: Scene, inputs: Sequence[str], units: Sequence[str]) -> None:
        self._rows: list[tuple[int, float, float | None]] = []
        for number, shaker in enumerate(scene.shakers, 1):
            settings = complete_from_preset(shaker.output)
            if settings.range is None:
                continue
            row = inputs.index(at_shaker("shaker", number, len(scene.shakers)))
            full_scale = settings.range * DRIVE_PER_VOLT[units[row]]
            self._rows.append(
                (row, full_scale, None if settings.bits is None else 2.0 * full_scale / 2.0**settings.bits)
            )

    def put_out(self, drive: Array) -> Array:
        """Return the output for a drive, shape (inputs, samples)."""
        if not self._rows:
            return drive
        output = drive.copy()
        for row, full_scale, step in self._rows:
            if step is None:
                np.clip(output[row], -full_scale, full_scale, out=output[row])
            else:
                output[row] = np.clip(np.rint(output[row] / step), -full_scale / step, full_scale / step - 1.0) * step
        return output


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
    suffix = at_shaker("", number, len(scene.shakers))
    if isinstance(shaker, ElectrodynamicShaker):
        current = shaker.amplifier.mode == "current"
        prefix, unit = ("current through", "A") if current else ("voltage at", "V")
        return f"{prefix} the coil{suffix and f' of shaker{suffix}'}, {shaker.amplifier.gain:g} {unit}/V"
    return f"table{suffix} position, {1e3 * DRIVE_PER_VOLT['m']:g} mm/V"
