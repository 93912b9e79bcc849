"""Converters: the inputs convert volts to counts; the outputs clip and quantize the drives of the shakers.

One count is the quantization step. A sample in counts is the integer code of the converter.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rig.core.base.arrays import Array
from rig.core.numerics.runs import merge_spans
from rig.core.scene.measurement_chain import Converter as Settings
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene
from rig.core.scene.shaker import DRIVE_PER_VOLT, at_shaker


def volts_per_count(settings: Settings) -> float | None:
    """Return the voltage of one count [V]; None if the converter has no bits or no range.

    >>> volts_per_count(Settings(bits=8, range="1 V"))
    0.0078125
    """
    if settings.bits is None or settings.range is None:
        return None
    return float(2.0 * settings.range / 2.0**settings.bits)


class Quantizer:
    """Quantizes and clips voltages; the largest code is one count less than the range, as in two's complement.

    >>> quantizer = Quantizer(Settings(bits=8, range="1 V"))
    >>> quantizer.convert(np.array([[0.5, -0.004, 1.5]]))
    (array([[ 64,  -1, 127]], dtype=int32), array([[False, False,  True]]))
    """

    def __init__(self, settings: Settings) -> None:
        settings = complete_from_preset(settings)
        self._bits, self._range = settings.bits, settings.range
        self._volts_per_count = volts_per_count(settings)
        dropped = [(round(block.at * settings.sample_rate), block.samples) for block in settings.dropped_blocks]
        spans = merge_spans((first, first + samples) for first, samples in dropped)
        # First and last sample of each range that is lost between converter and recording.
        self.lost = tuple((first, stop - 1) for first, stop in spans)

    def convert(self, volts: Array) -> tuple[Array | NDArray[np.int32], NDArray[np.bool_]]:
        """Return samples in counts (in volts without bits or range), and whether each was clipped; same shape."""
        if self._range is None:
            return volts, np.zeros(volts.shape, dtype=bool)
        if self._bits is None or self._volts_per_count is None:
            samples = np.clip(volts, -self._range, self._range)
            return samples, samples != volts
        codes = volts / self._volts_per_count
        np.rint(codes, out=codes)
        full_scale = 2.0 ** (self._bits - 1)
        clipped = np.minimum(np.maximum(codes, -full_scale), full_scale - 1.0)
        return clipped.astype(np.int32), clipped != codes


class Outputs:
    """Clips and quantizes the drives at the outputs; outputs without a range, and the hammer, are ideal.

    `inputs` are the names of the rig's inputs, `units` the units of their drives: "N", "m" or "V".

    >>> import rig
    >>> scene = rig.load("reference-A")
    >>> scene = scene.replace(shaker=scene.shaker.replace(output={"range": 1.0, "bits": 8}))
    >>> Outputs(scene, ["shaker"], ["N"]).convert(np.array([[0.3, 5.0, -5.0]]))
    array([[ 0.296875 ,  0.9921875, -1.       ]])
    """

    def __init__(self, scene: Scene, inputs: Sequence[str], units: Sequence[str]) -> None:
        # For each output with a range: index of the drive, full scale and step in the unit of the drive (None: not
        # quantized).
        self._limited: list[tuple[int, float, float | None]] = []
        for number, shaker in enumerate(scene.shakers, 1):
            settings = complete_from_preset(shaker.output)
            if settings.range is None:
                continue
            row = inputs.index(at_shaker("shaker", number, len(scene.shakers)))
            full_scale = settings.range * DRIVE_PER_VOLT[units[row]]
            step = None if settings.bits is None else 2.0 * full_scale / 2.0**settings.bits
            self._limited.append((row, full_scale, step))

    def limit(self, drive_limit: Array) -> Array:
        """Return the largest unclipped drive of each input, given the amplifiers' limits; both of shape (inputs,)."""
        limit = drive_limit.copy()
        for row, full_scale, _ in self._limited:
            limit[row] = min(limit[row], full_scale)
        return limit

    def convert(self, drive: Array) -> Array:
        """Return the drive after clipping and quantization, shape (inputs, samples)."""
        if not self._limited:
            return drive
        output = drive.copy()
        for row, full_scale, step in self._limited:
            if step is None:
                np.clip(output[row], -full_scale, full_scale, out=output[row])
            else:
                output[row] = np.clip(np.rint(output[row] / step), -full_scale / step, full_scale / step - 1.0) * step
        return output


def describe_clock(converter: Settings) -> str:
    """Describe the sample rate, and the rate that the scene requests if the module rounds it up."""
    rate = f"{converter.sample_rate:.6g} Hz"
    if converter.sample_rate == converter.rate:
        return rate
    return f"{rate}, the next rate of the {converter.preset} above {converter.rate:.6g} Hz"


def describe_output(scene: Scene, number: int) -> str:
    """Describe the quantity that the output of shaker `number` (from 1) drives, and its value per volt.

    >>> import rig
    >>> describe_output(rig.load("bare-structure"), 1), describe_output(rig.load("fig8-no-damper"), 1)
    ('table position, 1 mm/V', 'voltage at the coil, 1 V/V')
    >>> structure = {"masses": {"base": 2.0, "arm": 1.0}, "springs": [1e3, 1e3]}
    >>> describe_output(rig.Scene(structure=structure, shaker={"kind": "force", "body": "arm"}), 1)
    'force on arm, 1 N/V'
    """
    shaker = scene.shakers[number - 1]
    bodies = " and ".join(map(scene.structure.label, shaker.bodies))
    return shaker.output_text(at_shaker("", number, len(scene.shakers)), bodies)
