"""Direction of power flow at the driving point: a passive structure absorbs power from the driving force.

The real part of the driving-point mobility is positive at every frequency, because the force supplies power; see
`daq.importing.driving_power`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from daq.importing.driving_power import returns_energy
from rig.results.response import Response

# Only points with a smaller relative bound are evaluated.
_KNOWN_SHARE = 0.3


def reversed_force(curves: Sequence[Response]) -> str:
    """Warn if the force absorbs power from the structure at the driving point; empty otherwise.

    `curves`: responses to one force, measured together; only those at the driving point are evaluated.
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


def takes_energy(curve: Response) -> bool:
    """Whether the reference absorbs power from the structure at the resonances of a driving-point response."""
    mobility = curve.to("velocity").sorted()
    size = abs(mobility.value)
    known = np.isfinite(size) & (size > 0.0) & (np.nan_to_num(mobility.bound()) < _KNOWN_SHARE * size)
    frequency = np.log(mobility.frequency[known])
    spread = frequency.size > 1 and np.ptp(frequency) > 0.0
    width = np.gradient(frequency) if spread else np.ones(frequency.size)
    return returns_energy(mobility.value[known] * width)
