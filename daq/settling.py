"""Has a steady state been reached? Judged from amplitudes measured in successive windows of equal length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

ComplexArray = NDArray[np.complex128]

# Differences kept to find the decay of the transient; two pairs are the fewest that can show one.
_DIFFERENCES = 6
FEWEST_LOOKS = 4
# Below this share of predictable change, what is left looks like noise rather than like a decaying transient.
_COHERENT = 0.8
_NOISE_LOOKS = 12
_AGREEING = 6


class Settling:
    """Judge of steady state.

    A mode that still rings adds to the amplitude seen in each window (a *look*) a transient that shrinks and
    turns by the same complex factor rho from look to look, so that the change from one look to the next does
    too. The factor found from the last changes tells how far the amplitude still has to go:
    change * rho / (1 - rho). Comparing two successive looks alone would not do: a 13 Hz mode damped by 0.5 %
    changes by only 4 % of what is left in 0.1 s.

    Where changes follow no such law they are noise (of sensors, or of dampers in irregular motion). Then the
    amplitude counts as steady when two halves of the latest looks agree within their scatter and the scatter
    does not fall.

    Parameters
    ----------
    tolerance : float
        Largest change still to come, relative to the amplitude.

    Examples
    --------
    >>> judge = Settling(1e-3)
    >>> for look in range(40):
    ...     judge.add(np.array([1.0 - 0.5 * 0.8**look + 0j]))
    ...     if judge.settled:
    ...         break
    >>> look, bool(0.5 * 0.8**look < 1e-3)
    (30, True)
    """

    def __init__(self, tolerance: float) -> None:
        self.tolerance = tolerance
        self._looks: list[ComplexArray] = []
        self._forecasts: list[ComplexArray] = []
        self._steady_before = False
        self.settled = False

    def restart(self) -> None:
        """Forget all looks: the drive has been changed."""
        self._looks.clear()
        self._forecasts.clear()
        self._steady_before = self.settled = False

    @property
    def looks(self) -> int:
        """Looks since the last restart."""
        return len(self._looks)

    @property
    def latest(self) -> ComplexArray:
        """Amplitudes of the latest look, shape (quantities,)."""
        return self._looks[-1]

    @property
    def rising(self) -> bool:
        """Whether the first quantity grew from the look before to the latest."""
        return len(self._looks) > 1 and bool(abs(self._looks[-1][0]) > abs(self._looks[-2][0]))

    def add(self, amplitudes: ComplexArray) -> None:
        """Take the next look: complex amplitudes, shape (quantities,)."""
        self._looks.append(amplitudes)
        self._forecasts.append(self._forecast())
        if len(self._looks) < FEWEST_LOOKS:
            return
        steady = bool(np.all(self._decayed() | self._within() | self._scattered()))
        # One look may pass by chance, where a beat turns back on itself.
        self.settled = steady and self._steady_before
        self._steady_before = steady

    def expected(self) -> ComplexArray:
        """Amplitudes the quantities are heading for, as far as the looks tell; shape (quantities,)."""
        return self._forecasts[-1]

    def wavering(self) -> NDArray[np.float64]:
        """Change of `expected` over the last looks, relative to it; shape (quantities,)."""
        latest = np.array(self._forecasts[-3:])
        return np.ptp(abs(latest), axis=0) / np.maximum(abs(latest[-1]), np.finfo(float).tiny)

    def beat(self) -> NDArray[np.float64]:
        """Turn of the transient from look to look, rad, infinite where no law is seen; (quantities,)."""
        if len(self._looks) < FEWEST_LOOKS:
            return np.full(self._looks[-1].size, np.inf)
        _, factor, coherence = self._law()
        return np.where(coherence > _COHERENT, np.maximum(abs(np.angle(factor)), 1e-9), np.inf)

    def _forecast(self) -> ComplexArray:
        if len(self._looks) < FEWEST_LOOKS:
            return self._looks[-1]
        changes, factor, coherence = self._law()
        believable = (coherence > _COHERENT) & (abs(factor) < 0.995)
        recent = np.mean(self._looks[-_NOISE_LOOKS // 2 :], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(believable, self._looks[-1] + changes[-1] * factor / (1.0 - factor), recent)

    def left(self) -> NDArray[np.float64]:
        """Estimated change still to come, relative to the amplitude; shape (quantities,)."""
        changes, factor, _ = self._law()
        change = abs(changes[-2:]).max(axis=0)
        # A factor close to 1 can not be told from 1; the transient then outlasts anything seen so far.
        return change * abs(factor) / np.maximum(abs(1.0 - factor), 1e-3) / self._size()

    def doubt(self) -> NDArray[np.float64]:
        """Relative standard error of `expected`, by the scatter of the looks; shape (quantities,)."""
        if len(self._looks) < _NOISE_LOOKS:
            return np.zeros(self._looks[-1].size)
        latest = np.array(self._looks[-_NOISE_LOOKS // 2 :])
        return np.sqrt(np.mean(abs(latest - latest.mean(axis=0)) ** 2, axis=0) / len(latest)) / self._size()

    def _size(self) -> NDArray[np.float64]:
        return np.maximum(abs(self._looks[-1]), np.finfo(float).tiny)

    def _law(self) -> tuple[ComplexArray, ComplexArray, NDArray[np.float64]]:
        """Last changes, the factor from one to the next and how well it explains them (0 to 1)."""
        changes = np.diff(np.array(self._looks[-_DIFFERENCES - 1 :]), axis=0)
        before, after = changes[:-1], changes[1:]
        cross = np.sum(before.conj() * after, axis=0)
        power, other = (np.maximum(np.sum(abs(part) ** 2, axis=0), 1e-280) for part in (before, after))
        return changes, cross / power, abs(cross) ** 2 / power / other

    def _decayed(self) -> NDArray[np.bool_]:
        _, _, coherence = self._law()
        return (coherence > _COHERENT) & (self.left() < self.tolerance)

    def _within(self) -> NDArray[np.bool_]:
        """Whether all looks agree within the tolerance and their mean hardly drifts, whatever their law.

        Several modes that beat at once show no common factor. The mean over half of these looks moves by a
        tenth or more of what a slow transient still has to go, unless that lasts for more than thirty looks.
        """
        if len(self._looks) < _AGREEING:
            return np.zeros(self._looks[-1].size, dtype=bool)
        latest = np.array(self._looks[-_AGREEING:])
        spread = abs(latest - latest.mean(axis=0)).max(axis=0)
        drift = abs(latest[_AGREEING // 2 :].mean(axis=0) - latest[: _AGREEING // 2].mean(axis=0))
        limit = self.tolerance * self._size()
        return (spread < limit) & (drift < 0.1 * limit)

    def _scattered(self) -> NDArray[np.bool_]:
        if len(self._looks) < _NOISE_LOOKS:
            return np.zeros(self._looks[-1].size, dtype=bool)
        latest = np.array(self._looks[-_NOISE_LOOKS:])
        halves = latest[: _NOISE_LOOKS // 2], latest[_NOISE_LOOKS // 2 :]
        early, late = (np.sqrt(np.mean(abs(half - half.mean(axis=0)) ** 2, axis=0)) for half in halves)
        shift = abs(halves[1].mean(axis=0) - halves[0].mean(axis=0))
        error = np.hypot(early, late) / np.sqrt(_NOISE_LOOKS // 2)
        agree = shift < np.maximum(2.0 * error, self.tolerance * self._size())
        _, _, coherence = self._law()
        return agree & (coherence < _COHERENT) & (late > 0.7 * early)
