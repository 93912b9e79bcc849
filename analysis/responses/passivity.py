"""Direction of energy at the driving point: a passive structure takes energy from the force that drives it.

The mobility at the driving point has a positive real part at every frequency, the power that the force supplies (Ewins,
Modal Testing, 2nd ed., section 2.6). It is negative throughout if the force, or the response there, has the wrong sign.
Near resonances the real part is large, so that phase errors of filters and delays well below a quarter of a period do
not change its sign.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.responses.frf import Frf

# Points count whose real part is a larger share of their magnitude, and whose bound is a smaller one.
_CLEAR_SHARE = 0.3
# Share of the real part, over the logarithm of frequency, that must be negative. Errors of phase far from resonances
# give either sign; a reversed channel gives 1.
_REVERSED_SHARE = 0.8
# Share that points that count must have of the whole curve: an antiresonance alone has less.
_LEAST_SHARE = 0.02


def reversed_force(curves: Sequence[Frf]) -> str:
    """Warn if the force gains energy from the structure at the driving point; empty if it does not.

    Parameters
    ----------
    curves : sequence of Frf
        Responses to one force, measured together; those elsewhere than at the force do not count.
    """
    wrong = [curve for curve in curves if curve.is_driving_point and takes_energy(curve)]
    if not wrong:
        return ""
    names = ", ".join(dict.fromkeys(curve.ratio for curve in wrong))
    return (
        f"{names}: the phase at the driving point is that of a reversed channel (+90° instead of -90° at resonances), "
        "so that the structure would supply energy. Reverse the force, or this response if it alone is wrong: "
        "sign: -1 in the table of `daq import`, or turn the sensor round."
    )


def takes_energy(curve: Frf) -> bool:
    """Whether the reference takes energy from the structure at the resonances of a driving-point response."""
    mobility = curve.to("velocity").sorted()
    power, size = mobility.value.real, abs(mobility.value)
    known = np.isfinite(power) & (size > 0.0) & (np.nan_to_num(mobility.bound()) < _CLEAR_SHARE * size)
    if not known.any():
        return False
    frequency = np.log(mobility.frequency[known])
    width = (
        np.gradient(frequency) if np.ptp(frequency) > 0.0 and frequency.size > 1 else np.ones(frequency.size)
    )
    whole = float(size[known] @ width)
    clear = abs(power[known]) > _CLEAR_SHARE * size[known]
    supplied = (power[known] * width)[clear]
    total = float(abs(supplied).sum())
    return total > _LEAST_SHARE * whole and -float(supplied.sum()) > _REVERSED_SHARE * total
