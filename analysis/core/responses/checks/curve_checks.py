"""Checks of response curves: power flow at the driving point, and jumps between branches.

A passive structure absorbs power from the driving force, so the real part of the driving-point mobility is positive at
every frequency; see `daq.core.signal_chain.driving_power`. A curve jumps where the motion of dampers changes to another
stable branch.
"""

from collections.abc import Sequence

import numpy as np

from daq.core.signal_chain.driving_power import returns_energy
from rig.core.results.response import Response

# The power is evaluated at points whose relative expanded uncertainty is at most this value.
_MAX_UNCERTAINTY = 0.3
# Smallest step of the complex logarithm [nepers, radians] at a jump, in addition to the two following limits.
_MIN_STEP = 0.25
# A jump exceeds the larger of the steps on either side, scaled to the same frequency spacing, by this factor.
_MIN_RATIO_TO_NEIGHBORS = 4.0
# A jump exceeds this number of standard uncertainties of the step, which noise does not reach at thousands of points.
_MIN_SIGMAS = 5.0
# Largest random uncertainty (expanded) of a point with a jump, relative to its value; otherwise it is noise.
_MAX_NOISE_RATIO = 0.5


def reversed_force(curves: Sequence[Response]) -> str:
    """Return a warning if the structure seems to supply power at the driving point, due to a reversed sign.

    `curves`: responses to one force, measured together; only those at the driving point are evaluated. Without a
    reversed sign, the warning is empty.
    """
    reversed_curves = [curve for curve in curves if curve.is_driving_point and supplies_power(curve)]
    if not reversed_curves:
        return ""
    names = ", ".join(dict.fromkeys(curve.ratio for curve in reversed_curves))
    return (
        f"{names}: the phase at the driving point indicates a reversed channel, because the structure would supply "
        "energy (at resonances, the phase of the compliance is +90° instead of -90°). In the table of `daq import`, "
        "give sign: -1 for the force, or for this response if only this response is wrong; or turn the sensor around."
    )


def supplies_power(curve: Response) -> bool:
    """Return whether the structure seems to supply power to the force at the resonances of a driving-point response."""
    mobility = curve.to("velocity").sorted()
    magnitude = abs(mobility.value)
    is_precise = np.nan_to_num(mobility.bound()) < _MAX_UNCERTAINTY * magnitude
    valid = np.isfinite(magnitude) & (magnitude > 0.0) & is_precise
    log_frequency = np.log(mobility.frequency[valid])
    # Each point represents a range of the logarithmic frequency axis.
    has_several = log_frequency.size > 1 and np.ptp(log_frequency) > 0.0
    width = np.gradient(log_frequency) if has_several else np.ones(log_frequency.size)
    return returns_energy(mobility.value[valid] * width)


def find_jumps(frf: Response) -> list[tuple[float, str]]:
    """Locate the frequencies at which a curve jumps from one branch to another.

    `frf`: points in the order of measurement. Returns for each jump the mean frequency of the two points [Hz] and
    ``"jump up"`` or ``"jump down"`` in the order of measurement.

    >>> f = np.linspace(10.0, 20.0, 11)
    >>> value = np.where(f < 14.5, 1.0 + 0.02 * f, 0.5 + 0.02 * f).astype(complex)
    >>> error = np.full(11, 1e-6)
    >>> find_jumps(Response.curve(f, value, "body3", error=error, degrees_of_freedom=error + 38))
    [(14.5, 'jump down')]
    """
    if frf.frequency.size < 4:
        return []
    log_steps = np.log(frf.value[1:] / frf.value[:-1])
    step, spacing = abs(log_steps), np.maximum(abs(np.diff(frf.frequency)), 1e-12)
    # Steps expected over the same spacing, from the slopes on either side.
    slope = step / spacing
    before, after = np.append(0.0, slope[:-1]) * spacing, np.append(slope[1:], 0.0) * spacing
    # Without a stated uncertainty, a step cannot be distinguished from noise.
    relative = np.nan_to_num(frf.error / abs(frf.value), nan=np.inf)
    noise = np.hypot(relative[1:], relative[:-1])
    is_noise = ~(frf.random_bound() <= _MAX_NOISE_RATIO * abs(frf.value))
    is_jump = ~(is_noise[1:] | is_noise[:-1]) & (
        (step > _MIN_STEP) & (step > _MIN_RATIO_TO_NEIGHBORS * np.maximum(before, after)) & (step > _MIN_SIGMAS * noise)
    )
    return [
        (float(0.5 * (frf.frequency[i] + frf.frequency[i + 1])), "jump up" if log_steps[i].real > 0 else "jump down")
        for i in np.flatnonzero(is_jump)
    ]
