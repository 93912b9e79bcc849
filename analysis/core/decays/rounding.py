"""Rounding of a decay to counts: random errors if there is noise, and else wrong amplitudes."""

import numpy as np

from analysis.core.responses.errors.systematic import reproducible_rounding, tone_gain_error
from rig.core.base.arrays import Array

# Power of the rounding error [counts²].
_POWER = 1.0 / 12.0


def rounding_noise(count: float, bandwidth: float) -> float:
    """Return the rms of the analytic signal of rounding errors in a band [m/s²].

    `count`: size of a count [m/s²]; `bandwidth`: relative to the sample rate. The errors have equal power at all
    frequencies up to half the sample rate.
    """
    return float(2.0 * count * np.sqrt(_POWER * bandwidth))


def damping_error(amplitude: Array, half_fall: float, noise: float, count: float, bandwidth: float) -> Array:
    """Return the limit of the relative error of a damping ratio from a decay by 2 `half_fall` nepers.

    `amplitude`: amplitudes of the mode, m/s²; `noise`: rms of the analytic signal in the band, m/s². Without noise, the
    amplitude of a rounded sine is wrong by a factor that depends on the amplitude.
    """
    if not count:
        return np.zeros(amplitude.size)
    counts = amplitude / count
    ends = (tone_gain_error(0.5 * (counts * ratio) ** 2 + _POWER) for ratio in np.exp([half_fall, -half_fall]))
    # The noise outside the band is assumed to have the same spectral density as that inside.
    power = np.array((noise / (2.0 * count)) ** 2 / bandwidth)
    return np.asarray(reproducible_rounding(power) * sum(ends) / (2.0 * half_fall))
