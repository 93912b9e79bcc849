"""Detection of hammer hits in a force channel: a real bench does not mark them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from daq.importing.overloads import joined
from rig.arrays import Array
from rig.numerics.runs import runs_of

# Ratio to the largest force that a pulse exceeds.
_PULSE_RATIO = 0.05
# Ratio to the largest force that a hit exceeds.
_HIT_RATIO = 0.1
# Share of the time in contact beyond which the force is not that of a hammer.
_MAX_CONTACT_SHARE = 0.2
# Time after a hit in which further pulses are bounces of the hammer, s.
_BOUNCE_S = 0.2
# Time within which pulses that chatter around the threshold are one, s.
_CHATTER_S = 1e-3
# Maximum number of stored pulses.
_MAX_PULSES = 200_000


class Pulse(NamedTuple):
    """A force that rises from rest and returns: samples [first, stop), and its largest value in N."""

    first: int
    stop: int
    peak: float


class ForcePulses:
    """Detects pulses of a force, block by block."""

    def __init__(self) -> None:
        self._rest: float | None = None
        self._largest = 0.0
        self._pulses: list[Pulse] = []
        self._contact = self._samples = 0

    def add(self, first: int, force: Array) -> None:
        """Add the next samples in N; the first has the number `first`."""
        if self._rest is None:
            self._rest = float(np.nanmedian(force)) if np.isfinite(force).any() else 0.0
        size = np.nan_to_num(abs(force - self._rest))
        largest = float(size.max(initial=0.0))
        if largest > self._largest:
            self._largest = largest
            self._pulses = [pulse for pulse in self._pulses if pulse.peak > _PULSE_RATIO * largest]
        spans = runs_of(size > _PULSE_RATIO * self._largest)
        self._samples += size.size
        self._contact += sum(stop - start for start, stop in spans)
        if len(self._pulses) < _MAX_PULSES:
            self._pulses += [Pulse(first + a, first + b, float(size[a:b].max())) for a, b in spans]

    def hits(self, rate: float) -> list[Pulse]:
        """Return the hits; none if the force is not that of a hammer."""
        pulses = [pulse for pulse in self._pulses if pulse.peak > _PULSE_RATIO * self._largest]
        contact = sum(pulse.stop - pulse.first for pulse in pulses)
        if not pulses or len(self._pulses) >= _MAX_PULSES or contact > _MAX_CONTACT_SHARE * self._samples:
            return []
        hits: list[Pulse] = []
        for first, stop in joined([(pulse.first, pulse.stop) for pulse in pulses], round(_CHATTER_S * rate)):
            peak = max(pulse.peak for pulse in pulses if first <= pulse.first < stop)
            if peak < _HIT_RATIO * self._largest or (hits and first - hits[-1].first < _BOUNCE_S * rate):
                continue
            # The flanks of a pulse are below the threshold.
            flank = 2 + (stop - first) // 5
            hits.append(Pulse(max(first - flank, 0), min(stop + flank, self._samples), peak))
        return hits
