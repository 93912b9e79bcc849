"""Detection of hammer impacts in the force channel of an imported file, which has no markers."""

from typing import NamedTuple

import numpy as np

from rig.core.base.arrays import Array
from rig.core.numerics.runs import merge_spans, runs_of

# A pulse begins and ends at this fraction of the largest force, above the noise of the sensor.
_PULSE_RATIO = 0.05
# A pulse is an impact if its peak is at least this fraction of the largest force; smaller pulses are noise or a touch.
_IMPACT_RATIO = 0.1
# The force of a hammer acts for at most this fraction of the time; a shaker acts all the time.
_MAX_CONTACT_SHARE = 0.2
# Time after an impact in which further pulses are bounces of the hammer [s]; no person hits twice in this time.
_BOUNCE_S = 0.2
# An impact is double if a bounce of the hammer has at least this fraction of the impact's peak: a smaller bounce has
# little effect on the spectrum.
_DOUBLE_RATIO = 0.1
# Two crossings of the threshold within this time belong to the same pulse [s]: noise crosses it several times.
_CHATTER_S = 1e-3
# Maximum number of stored pulses, to limit the memory; no test has more impacts.
_MAX_PULSES = 200_000


class Pulse(NamedTuple):
    """A pulse of the force: its samples [first, stop), and its peak in N."""

    first: int
    stop: int
    peak: float
    is_double: bool = False  # whether a second pulse follows


class ForcePulses:
    """Detects pulses of a force, block by block."""

    def __init__(self) -> None:
        self._baseline: float | None = None
        self._peak = 0.0
        self._pulses: list[Pulse] = []
        self._samples = 0

    def add(self, first: int, force: Array) -> None:
        """Add the next samples in N; the first has the number `first`."""
        if self._baseline is None:
            self._baseline = float(np.nanmedian(force)) if np.isfinite(force).any() else 0.0
        magnitude = np.nan_to_num(abs(force - self._baseline))
        largest = float(magnitude.max(initial=0.0))
        if largest > self._peak:
            self._peak = largest
            self._pulses = [pulse for pulse in self._pulses if pulse.peak > _PULSE_RATIO * largest]
        runs = runs_of(magnitude > _PULSE_RATIO * self._peak)
        self._samples += magnitude.size
        if len(self._pulses) < _MAX_PULSES:
            self._pulses += [Pulse(first + a, first + b, float(magnitude[a:b].max())) for a, b in runs]

    def impacts(self, rate: float) -> list[Pulse]:
        """Return the impacts at a sample rate in Hz; an empty list if this is not the force of a hammer."""
        pulses = [pulse for pulse in self._pulses if pulse.peak > _PULSE_RATIO * self._peak]
        contact_samples = sum(pulse.stop - pulse.first for pulse in pulses)
        if not pulses or len(self._pulses) >= _MAX_PULSES or contact_samples > _MAX_CONTACT_SHARE * self._samples:
            return []
        impacts: list[Pulse] = []
        for first, stop in merge_spans([(pulse.first, pulse.stop) for pulse in pulses], round(_CHATTER_S * rate)):
            peak = max(pulse.peak for pulse in pulses if first <= pulse.first < stop)
            if impacts and first - impacts[-1].first < _BOUNCE_S * rate:
                if peak >= _DOUBLE_RATIO * impacts[-1].peak:
                    impacts[-1] = impacts[-1]._replace(is_double=True)
                continue
            if peak < _IMPACT_RATIO * self._peak:
                continue
            # The edges of a pulse extend beyond the samples above the threshold.
            edge = 2 + (stop - first) // 5
            impacts.append(Pulse(max(first - edge, 0), min(stop + edge, self._samples), peak))
        return impacts
