"""The rate of the chassis' clock: one that the rates of all tasks divide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

# Ticks per sample of the fastest task that the clock makes at most, so that all rates divide it.
_MOST_TICKS = 8


class NeededRate(NamedTuple):
    """A rate that a task samples at [S/s], and whether it has to divide that of the clock."""

    rate: float
    divides: bool


def divides(rate: float, clock: float) -> bool:
    """Whether a clock makes a rate by leaving ticks out."""
    ratio = clock / rate
    return round(ratio) >= 1 and abs(ratio - round(ratio)) < 1e-6


def clock_rate(mine: NeededRate, held: Sequence[NeededRate], others: Sequence[NeededRate]) -> float:
    """Choose the rate of the clock, S/s.

    Parameters
    ----------
    mine : NeededRate
        Of the task that is to run.
    held : sequence of NeededRate
        Of tasks that have reserved what they need.
    others : sequence of NeededRate
        Of all that are configured; they count as long as one clock makes all rates.

    Examples
    --------
    >>> clock_rate(NeededRate(10240.0, True), [], [NeededRate(51200.0 / 6, True)])
    51200.0
    """
    for needed in ([mine, *others], [mine, *held], [mine]):
        exact = {each.rate for each in needed if each.divides}
        rate = _common_multiple({each.rate for each in needed}) or _common_multiple(exact)
        if rate is not None:
            return rate
    return mine.rate


def _fraction(rate: float) -> Fraction:
    """Give a rate as a ratio of whole numbers: module rates are a clock divided by one."""
    return Fraction(rate).limit_denominator(10_000)


def _common_multiple(rates: set[float]) -> float | None:
    """Find the lowest rate that all of some divide; None if it is out of reach."""
    if not rates:
        return None
    if len(rates) == 1:
        return next(iter(rates))
    ratios = [_fraction(each) for each in rates]
    common = Fraction(
        math.lcm(*(each.numerator for each in ratios)), math.gcd(*(each.denominator for each in ratios))
    )
    fastest = max(ratios)
    return float(common) if common <= _MOST_TICKS * fastest else None
