"""Chooses the oversampling: the number of intervals per sample in which motion and voltages are computed.

`DriveInterpolator` interpolates the drive from the sample rate to the oversampled rate.
"""

import math

import numpy as np

from daq.core.signal_chain.decimation_filter import PASSBAND_EDGE, STOPBAND_EDGE
from rig.core.base.arrays import Array
from rig.core.scene.measurement_chain import Converter
from rig.core.scene.presets import complete_from_preset
from rig.core.scene.scene import Scene
from rig.core.system.assembly import assemble
from rig.core.system.spheres import contact_time, spheres_of

# With a decimation filter, the motion is resolved at least up to this frequency [Hz].
MIN_BAND_HZ = 1000.0
# Cubic interpolation (`daq.core.dsp.interpolation`) is accurate to 0.0001 dB up to this ratio of frequency to
# oversampled rate.
MAX_RESOLVED_RATIO = 0.1
# Largest oversampled rate [Hz]. Faster oscillations are aliased, as in the modulator of a real converter.
MAX_RATE = 1.024e6


def choose_oversampling(scene: Scene, converter: Converter | None = None) -> int:
    """Return the number of intervals per sample, at least 1, for a scene's converter or another converter.

    Without a decimation filter, motion between samples matters only if a sensor or amplifier can saturate or a contact
    has a finite duration. With a filter, oscillations above half the sample rate must be resolved, so the filter
    can remove them.

    >>> import rig
    >>> scene = rig.loads("structure: {masses: [1 kg], springs: [10 MN/m]}")
    >>> for rate in (1e3, 5e3, 51.2e3):
    ...     filtered = scene.replace(converter={"rate": rate, "filter": "delta_sigma"})
    ...     choose_oversampling(filtered)
    5
    2
    1
    """
    system, rate = assemble(scene), (converter or scene.converter).true_rate
    has_filter = complete_from_preset(scene.converter).filter is not None
    # The limits of sensor and amplifier act on the signal before the filter.
    channels = scene.channels or ()
    saturations = [
        complete_from_preset(channel.accelerometer).saturation
        for channel in channels
        if channel.accelerometer is not None
    ]
    saturations += [channel.integrator.saturation for channel in channels if channel.integrator is not None]
    has_limit = any(saturation is not None for saturation in saturations)
    max_frequency = 0.0  # highest frequency of the motion [Hz]
    if has_filter or has_limit:
        max_frequency = float(np.abs(system.poles.imag).max(initial=0.0)) / (2 * np.pi)
    if system.finite_contact.any():
        # A sensor responds to a contact even if the contact begins and ends between two samples.
        max_frequency = max(max_frequency, system.max_rate / (2 * np.pi))
    oversampling = max_frequency / rate / MAX_RESOLVED_RATIO
    for spheres in spheres_of(scene).values():
        # The contact of two grains lasts half a period of their oscillation, and its force acts on the body.
        max_frequency = max(max_frequency, 0.5 / contact_time(spheres.settings))
    if has_filter:
        # The alias of the highest frequency, mirrored at half the oversampled rate, must be in the stopband.
        alias_ratio = max_frequency / rate + STOPBAND_EDGE
        resolved_ratio = max(max_frequency, MIN_BAND_HZ) / rate
        if not has_limit:
            resolved_ratio = min(resolved_ratio, PASSBAND_EDGE)
        oversampling = max(alias_ratio, resolved_ratio / MAX_RESOLVED_RATIO)
        # The drive is piecewise linear; its slope changes excite a table up to the table's corner frequency.
        corner = max((shaker.corner for shaker in scene.shakers), default=0.0)
        oversampling = max(oversampling, corner / rate / MAX_RESOLVED_RATIO)
    return max(1, min(math.ceil(oversampling), int(MAX_RATE / rate)))


class DriveInterpolator:
    """Linear interpolation of the drive at a multiple of its rate, block by block.

    >>> interpolator = DriveInterpolator(1, 2)
    >>> [interpolator.interpolate(np.array([block])).tolist() for block in ([1.0, 2.0], [4.0])]
    [[[1.0, 1.5, 2.0]], [[3.0, 4.0]]]
    """

    def __init__(self, inputs: int, factor: int) -> None:
        self._fractions = np.arange(1, factor + 1) / factor
        self._last = np.zeros((inputs, 0))

    def interpolate(self, drive: Array) -> Array:
        """Return the next block of drive at the higher rate, from its samples (inputs, samples).

        Each sample becomes `factor` values, the last of which is the sample. Sample 0 becomes one value.
        """
        if self._fractions.size == 1:
            return drive
        samples = np.concatenate([self._last, drive], axis=1)
        if samples.shape[1] == 0:
            return drive
        # Sample 0, which has no interval before it; empty in later blocks.
        first_sample = drive[:, : 1 - self._last.shape[1]]
        self._last = samples[:, -1:]
        start, end = samples[:, :-1, None], samples[:, 1:, None]
        values = start + (end - start) * self._fractions
        values[:, :, -1] = samples[:, 1:]
        values = values.reshape(len(drive), values.shape[1] * values.shape[2])
        return np.concatenate([first_sample, values], axis=1)
