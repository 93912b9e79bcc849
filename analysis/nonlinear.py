"""Signs of nonlinearity in a stepped sine: jumps, harmonics, and what the dampers do, all from the channels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from analysis.detection import impacts
from analysis.frf import Frf

if TYPE_CHECKING:
    from analysis.stepped import Sweep
    from daq.recording import Recording

# A step of the curve counts as a jump when it is this large (in nepers or radians) and this many times the
# steps on either side of it, and stands out of the error bars.
JUMP = 0.25
_STANDS_OUT = 4.0
_ERRORS = 5.0


def jumps(frf: Frf) -> list[tuple[float, str]]:
    """Frequencies at which a curve jumps from one branch to another.

    Parameters
    ----------
    frf : Frf
        Points in the order measured.

    Returns
    -------
    list of (frequency, text)
        Middle of the two points in Hz, and ``"jump up"`` or ``"jump down"`` as it was met.

    Examples
    --------
    >>> f = np.linspace(10.0, 20.0, 11)
    >>> value = np.where(f < 14.5, 1.0 + 0.02 * f, 0.5 + 0.02 * f).astype(complex)
    >>> none = np.full(11, 1e-6)
    >>> jumps(Frf(f, value, none, 1.0 - none, none + 38, "body3"))
    [(14.5, 'jump down')]
    """
    if frf.frequency.size < 4:
        return []
    steps = np.log(frf.value[1:] / frf.value[:-1])
    size, apart = abs(steps), np.maximum(abs(np.diff(frf.frequency)), 1e-12)
    # What the slopes on either side would make of as wide a step.
    before, after = np.append(0.0, (size / apart)[:-1]) * apart, np.append((size / apart)[1:], 0.0) * apart
    # Without an error bar a step cannot be told from noise.
    relative = np.nan_to_num(frf.error / abs(frf.value), nan=np.inf)
    noise = np.hypot(relative[1:], relative[:-1])
    found = (size > JUMP) & (size > _STANDS_OUT * np.maximum(before, after)) & (size > _ERRORS * noise)
    return [
        (
            float(0.5 * (frf.frequency[i] + frf.frequency[i + 1])),
            "jump up" if steps[i].real > 0 else "jump down",
        )
        for i in np.flatnonzero(found)
    ]


@dataclass(frozen=True)
class DamperMotion:
    """What impacts tell of a damper's motion at one frequency.

    Attributes
    ----------
    frequency : float
        Hz.
    channel : str
        Channel on the damper's body.
    floor, ceiling : float
        Impacts a period.
    threshold : float
        Smallest velocity jump that would have been seen, m/s.
    """

    frequency: float
    channel: str
    floor: float
    ceiling: float
    threshold: float

    @property
    def name(self) -> str:
        """Kind of motion.

        Types II and III of the paper both strike floor and ceiling once a period; how long the damper
        stays at the ceiling does not show in impacts.
        """
        if self.floor == 0 and self.ceiling == 0:
            return "at rest on its body, or impacts below the threshold"
        if abs(self.floor - 1.0) < 0.05 and self.ceiling < 0.05:
            return "Type I: floor once a period"
        if abs(self.floor - 1.0) < 0.05 and abs(self.ceiling - 1.0) < 0.05:
            return "Type II or III: floor and ceiling once a period"
        return "other: several impacts a period, subharmonic or irregular"


def damper_motion(rec: Recording, sweep: Sweep, channel: str) -> list[DamperMotion]:
    """Count impacts a period in every measured window of one channel."""
    out = []
    for frequency, (first, stop) in zip(sweep.lines.frequency, sweep.windows, strict=True):
        found = impacts(rec, channel, int(first), int(stop))
        # The search leaves out the ends of its stretch.
        inner = found.searched * float(frequency)
        kinds = found.kind
        out.append(
            DamperMotion(
                float(frequency),
                found.channel,
                float(np.sum(kinds == "floor")) / inner,
                float(np.sum(kinds == "ceiling")) / inner,
                found.threshold,
            )
        )
    return out
