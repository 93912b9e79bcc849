"""Jumps of a frequency response from one branch of a nonlinear resonance to another."""

from __future__ import annotations

import numpy as np

from rig.results.response import Response

# A step of a curve is a jump if it exceeds each of three limits: an absolute value (nepers or radians), a multiple
# of the steps on either side, and a multiple of its standard error.
_MIN_STEP = 0.25
_MIN_RATIO_TO_NEIGHBORS = 4.0
_MIN_SIGMAS = 5.0


def jumps(frf: Response) -> list[tuple[float, str]]:
    """Find the frequencies at which a curve jumps from one branch to another.

    `frf`: points in the order measured. Returns mean frequency of the two points in Hz, and ``"jump up"`` or ``"jump
    down"`` in the order measured.

    >>> f = np.linspace(10.0, 20.0, 11)
    >>> value = np.where(f < 14.5, 1.0 + 0.02 * f, 0.5 + 0.02 * f).astype(complex)
    >>> error = np.full(11, 1e-6)
    >>> jumps(Response.curve(f, value, "body3", error=error, degrees=error + 38))
    [(14.5, 'jump down')]
    """
    if frf.frequency.size < 4:
        return []
    steps = np.log(frf.value[1:] / frf.value[:-1])
    size, width = abs(steps), np.maximum(abs(np.diff(frf.frequency)), 1e-12)
    # Expected steps over the same width, from the slopes on either side.
    before, after = np.append(0.0, (size / width)[:-1]) * width, np.append((size / width)[1:], 0.0) * width
    # Without an error bar a step cannot be distinguished from noise.
    relative = np.nan_to_num(frf.error / abs(frf.value), nan=np.inf)
    noise = np.hypot(relative[1:], relative[:-1])
    is_jump = (
        (size > _MIN_STEP)
        & (size > _MIN_RATIO_TO_NEIGHBORS * np.maximum(before, after))
        & (size > _MIN_SIGMAS * noise)
    )
    return [
        (
            float(0.5 * (frf.frequency[i] + frf.frequency[i + 1])),
            "jump up" if steps[i].real > 0 else "jump down",
        )
        for i in np.flatnonzero(is_jump)
    ]
