"""Oversampling of the rig by a delta-sigma converter, and interpolation of the drive."""

from __future__ import annotations

import math

import numpy as np

from daq.signal_chain.decimation_filter import PASS, STOP
from rig.arrays import Array
from rig.grain_beds.spheres import contact_time, spheres_of
from rig.scene.presets import complete_from_preset
from rig.scene.scene import Scene
from rig.scene.shaker import TableShaker
from rig.system.assembly import assemble

#: Frequency up to which the motion of every rig is resolved, Hz.
MIN_BAND_HZ = 1000.0
#: Motion is resolved up to this ratio to the oversampled rate: cubics through its samples (`daq.dsp.interpolation`)
#: are accurate to 0.0001 dB.
MAX_RESOLVED_RATIO = 0.1
#: Largest oversampled rate, Hz. Faster oscillations are aliased, as in a real modulator.
MAX_RATE = 1.024e6


def oversampling(scene: Scene) -> int:
    """Choose the number of intervals per sample, at least 1.

    Without a decimation filter the voltage between samples matters only to a sensor that may reach its limit, or
    during a finite-duration contact. With a filter, oscillations beyond half the sample rate must be resolved
    before they can be filtered out.

    >>> import rig
    >>> scene = rig.loads("structure: {masses: [1 kg], springs: [10 MN/m]}")
    >>> for rate in (1e3, 5e3, 51.2e3):
    ...     filtered = scene.replace(converter={"rate": rate, "filter": "delta_sigma"})
    ...     oversampling(filtered)
    5
    2
    1
    """
    system, rate = assemble(scene), scene.converter.true_rate
    filtered = complete_from_preset(scene.converter).filter is not None
    # A limit of a sensor on the rig, or of its amplifier, acts on the signal in front of any filter.
    channels = scene.channels or ()
    saturations = [
        complete_from_preset(channel.accelerometer).saturation
        for channel in channels
        if channel.accelerometer is not None
    ]
    saturations += [channel.integrator.saturation for channel in channels if channel.integrator is not None]
    has_limit = any(saturation is not None for saturation in saturations)
    max_frequency = 0.0
    if filtered or has_limit:
        max_frequency = float(np.abs(system.poles.imag).max(initial=0.0)) / (2 * np.pi)
    if system.finite_contact.any():
        # A landing may end between two samples, and still acts on the sensor.
        max_frequency = max(max_frequency, system.max_rate / (2 * np.pi))
    required = max_frequency / rate / MAX_RESOLVED_RATIO
    for spheres in spheres_of(scene).values():
        # A contact of grains lasts half a period of their oscillation, and its force acts on the body.
        max_frequency = max(max_frequency, 0.5 / contact_time(spheres.settings))
    if filtered:
        image_ratio = max_frequency / rate + STOP
        resolved_band = max(max_frequency, MIN_BAND_HZ) / rate
        required = max(image_ratio, (resolved_band if has_limit else min(resolved_band, PASS)) / MAX_RESOLVED_RATIO)
        # The drive is piecewise linear; its corners excite a table up to its bandwidth.
        bandwidths = (shaker.bandwidth for shaker in scene.shakers if isinstance(shaker, TableShaker))
        required = max(required, max(bandwidths, default=0.0) / rate / MAX_RESOLVED_RATIO)
    return max(1, min(math.ceil(required), int(MAX_RATE / rate)))


class DriveLine:
    """Linear interpolation of the drive at a multiple of its rate, block by block.

    >>> line = DriveLine(1, 2)
    >>> line.through(np.array([[1.0, 2.0]])).tolist(), line.through(np.array([[4.0]])).tolist()
    ([[1.0, 1.5, 2.0]], [[3.0, 4.0]])
    """

    def __init__(self, inputs: int, factor: int) -> None:
        self._fractions = np.arange(1, factor + 1) / factor
        self._last = np.zeros((inputs, 0))

    def through(self, drive: Array) -> Array:
        """Return the drive (inputs, intervals) at the ends of all intervals; no interval ends at the first sample."""
        if self._fractions.size == 1:
            return drive
        nodes = np.concatenate([self._last, drive], axis=1)
        if nodes.shape[1] == 0:
            return drive
        first_column = drive[:, : 1 - self._last.shape[1]]
        self._last = nodes[:, -1:]
        start, end = nodes[:, :-1, None], nodes[:, 1:, None]
        line = start + (end - start) * self._fractions
        line[:, :, -1] = nodes[:, 1:]
        return np.concatenate([first_column, line.reshape(len(drive), line.shape[1] * line.shape[2])], axis=1)
