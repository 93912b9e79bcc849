"""The hits of a hammer, found in its force channel: nobody marked them on a real bench."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from daq.importing.overloads import joined
from daq.importing.signal import Array
from rig.numerics.runs import runs_of

# A pulse stands out of the force at rest by this part of the largest force; a hit has this part of it at least.
_OUT, _HIT = 0.05, 0.1
# A hammer that is in contact for more than this part of the time is none.
_MOST_CONTACT = 0.2
# What follows a hit within this time, s, is the hammer that bounces, and belongs to it.
_BOUNCE = 0.2
_MOST = 200_000


class Pulse(NamedTuple):
    """A force that rises from rest and goes back: samples [first, stop), and its largest value in N."""

    first: int
    stop: int
    peak: float


class ForcePulses:
    """Looks for pulses in a force, block after block."""

    def __init__(self) -> None:
        self._rest: float | None = None
        self._largest = 0.0
        self._pulses: list[Pulse] = []
        self._contact = self._samples = 0

    def add(self, first: int, force: Array) -> None:
        """Take the next samples in N, the first one numbered `first`."""
        if self._rest is None:
            self._rest = float(np.nanmedian(force)) if np.isfinite(force).any() else 0.0
        size = np.nan_to_num(abs(force - self._rest))
        largest = float(size.max(initial=0.0))
        if largest > self._largest:
            self._largest = largest
            self._pulses = [pulse for pulse in self._pulses if pulse.peak > _OUT * largest]
        spans = runs_of(size > _OUT * self._largest)
        self._samples += size.size
        self._contact += sum(stop - start for start, stop in spans)
        if len(self._pulses) < _MOST:
            self._pulses += [Pulse(first + a, first + b, float(size[a:b].max())) for a, b in spans]

    def hits(self, rate: float) -> list[Pulse]:
        """Give the hits; none where the force is not one of a hammer."""
        pulses = [pulse for pulse in self._pulses if pulse.peak > _OUT * self._largest]
        contact = sum(pulse.stop - pulse.first for pulse in pulses)
        if not pulses or len(self._pulses) >= _MOST or contact > _MOST_CONTACT * self._samples:
            return []
        found: list[Pulse] = []
        # What chatters around the threshold is one pulse.
        for first, stop in joined([(pulse.first, pulse.stop) for pulse in pulses], round(1e-3 * rate)):
            peak = max(pulse.peak for pulse in pulses if first <= pulse.first < stop)
            if peak < _HIT * self._largest or (found and first - found[-1].first < _BOUNCE * rate):
                continue
            # Flanks below the threshold.
            flank = 2 + (stop - first) // 5
            found.append(Pulse(max(first - flank, 0), min(stop + flank, self._samples), peak))
        return found
