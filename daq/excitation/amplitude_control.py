"""Control of the drive amplitude for a constant force amplitude, measured from the channels."""

from __future__ import annotations

import math

from rig.scene.excitation import FORCE_HELD

# If the force scatters, the tolerance of the level is twice the standard error, up to this fraction of the level.
WORST_TOLERANCE = 0.02
# Accepted slopes d log(force) / d log(drive). Dampers whose impacts begin can make the force rise slowly, rise
# steeply or even fall with the drive; a slope below this range is not used.
_FLATTEST, _STEEPEST = 0.3, 3.0
# If drives that bracket the level are closer than this log ratio without reaching it, the force jumps or has changed.
_CLOSEST = 2e-3
# If the force is still too large after a drive reduction to this fraction, the drive is not the cause.
_IN_VAIN = 1e-4


class AmplitudeControl:
    """Secant method in log(drive) and log(force) for a force amplitude in N, with steps limited by a bracket.

    >>> control, drive = AmplitudeControl(2.6), 0.1
    >>> for step in range(12):
    ...     force = 3 * drive**1.5
    ...     if control.is_at_level(force):
    ...         break
    ...     drive = control.next(drive, force)
    >>> step, abs(force / 2.6 - 1) < 0.005
    (3, True)
    """

    def __init__(self, level: float, limit: float = math.inf, longest_step: float = 3.0) -> None:
        self.level = level
        self.limit = limit
        self._longest = math.log(longest_step)
        self.restart()

    def restart(self) -> None:
        """Discard all observations: the frequency has changed."""
        self._before: tuple[float, float] | None = None
        self._low, self._high = -math.inf, math.inf
        self._first_cut = 0.0

    def is_at_level(self, force: float, standard_error: float = 0.0) -> bool:
        """Return whether a force amplitude with a relative standard error `standard_error` is at the level."""
        return abs(force / self.level - 1.0) <= min(max(FORCE_HELD, 2.0 * standard_error), WORST_TOLERANCE)

    def cut(self, drive: float, force: float) -> float | None:
        """Return an immediately reduced drive; None if a much smaller drive did not reduce the force."""
        self._first_cut = max(self._first_cut, drive)
        if drive < _IN_VAIN * self._first_cut:
            return None
        return drive * max(math.exp(-self._longest), min(1.0, self.level / force))

    def next(self, drive: float, force: float) -> float:
        """Compute the next drive amplitude, at most `limit`, from the present drive and its steady force in N."""
        here, error = math.log(drive), math.log(self.level / max(force, 1e-9 * self.level))
        slope = 1.0
        if self._before is not None and abs(here - self._before[0]) > 1e-3:
            slope = (self._before[1] - error) / (here - self._before[0])
        self._before = here, error
        # The drives nearest to the level, below and above it.
        if error > 0.0:
            self._low, self._high = here, self._high if self._high > here else math.inf
        else:
            self._low, self._high = self._low if self._low < here else -math.inf, here
        if self._high - self._low < _CLOSEST:
            self._low, self._high = -math.inf, math.inf
        longest = self._longest if slope >= _FLATTEST else 0.5 * self._longest
        step = error / (min(slope, _STEEPEST) if slope >= _FLATTEST else 1.0)
        there = here + max(-longest, min(longest, step))
        if math.isfinite(self._high - self._low):
            margin = 0.1 * (self._high - self._low)
            there = max(self._low + margin, min(self._high - margin, there))
        return min(math.exp(there), self.limit)
