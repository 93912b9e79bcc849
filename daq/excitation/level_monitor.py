"""Monitor of the force level of a sweep: it marks deviations and warns at the end."""

from __future__ import annotations

from daq.excitation.station import Station

# Permitted relative deviation of the force from its level.
ALLOWED = 0.1
# Intervals with a shorter gap are merged, s.
_PAUSE = 0.5
# Remedy if the channels do not measure the force.
READABLE = "take more sensitive sensors, a smaller converter: range, or more force"


class LevelWatch:
    """Marks intervals in which the force deviates by more than 10 % from its level in N as ``level``."""

    def __init__(self, station: Station, level: float) -> None:
        self._station, self._level = station, level
        self.lowest = self.highest = 1.0
        self._open: tuple[int, int, float, float] | None = None
        self._worst = (1.0, 0.0)
        self._samples = self._stretches = 0

    def add(self, first: int, stop: int, frequency: float, force: float) -> None:
        """Add the force amplitude in N of the samples first to stop - 1, at a frequency in Hz."""
        ratio = force / self._level
        self.lowest, self.highest = min(self.lowest, ratio), max(self.highest, ratio)
        if self._open is not None and first - self._open[1] >= self._station.samples(_PAUSE):
            self._note()
        if abs(ratio - 1.0) <= ALLOWED:
            return
        begin, _, worst, at = self._open or (first, stop, 1.0, frequency)
        if abs(ratio - 1.0) > abs(worst - 1.0):
            worst, at = ratio, frequency
        self._open = begin, stop, worst, at

    def close(self, samples: int) -> None:
        """Mark an open interval, and warn if the force of the sweep deviated from its level."""
        if self._open is not None:
            self._note()
        if self._stretches:
            worst, at = self._worst
            advice = "sweep more slowly, or step"
            if self.lowest == 0.0:
                advice = (
                    f"in places the channels read no force, less than one count of the converter: {READABLE}"
                )
            self._station.warn(
                f"the spring force was off its level of {self._level:g} N by more than {ALLOWED:.0%} in "
                f"{self._stretches} stretch{'es' if self._stretches > 1 else ''}, {self._samples / samples:.1%} of "
                f"the sweep (marked as level): {worst:.3g} times the level at {at:.2f} Hz; {advice}"
            )

    def _note(self) -> None:
        assert self._open is not None
        first, stop, worst, at = self._open
        self._station.mark("level", first, stop, worst=worst, frequency=at, level=self._level)
        self._samples += stop - first
        self._stretches += 1
        if abs(worst - 1.0) > abs(self._worst[0] - 1.0):
            self._worst = worst, at
        self._open = None
