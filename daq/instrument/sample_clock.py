"""Sample clocks, counted in ticks of the bench."""

from __future__ import annotations

from fractions import Fraction


def samples_per_tick(rate: float, ticks: float) -> Fraction:
    """Give a sample rate [S/s] in samples per tick, as a ratio of whole numbers: rates are clocks divided by one.

    Parameters
    ----------
    ticks : float
        Ticks per second.

    Examples
    --------
    >>> samples_per_tick(51200.0 / 6, 51200.0)
    Fraction(1, 6)
    """
    return Fraction(rate).limit_denominator(10_000) / Fraction(ticks).limit_denominator(10_000)
