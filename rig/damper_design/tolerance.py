"""The interval of clearances in which the worst peak of a design stays nearly the same."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from rig.damper_design.answers import Answers
from rig.damper_design.choice import Question, Space, Trial
from rig.results import format_number

#: Rise of the worst peak at the ends of the interval, dB.
RISE = 0.5
#: Ratio of clearances to which the ends are bisected.
_RESOLUTION = 1.06
#: Ratio of clearances per outward step where no trial is available.
_STEP = 1.6
#: Distance from an end of the interval, as a share of its logarithmic width, below which a choice is near that end.
_NEAR = 0.15


@dataclass(frozen=True)
class Tolerance:
    """Clearances of the heaviest damper for which the worst peak rises by at most `RISE`; others in proportion.

    `low`, `high`: ends of the interval, m; `high` is infinite if a ceiling is not required.
    """

    low: float
    high: float
    limited: tuple[bool, bool]  # whether each end is a limit of the search, so that the interval may be wider
    chosen: float  # clearance of the chosen design, m

    def __str__(self) -> str:
        """Report the interval, and the recommended clearance if the chosen clearance is near an end.

        >>> print(Tolerance(0.0035, 0.00475, (False, False), 0.00462))
        the worst peak stays within 0.5 dB for clearances from 3.5 to 4.75 mm: build to the middle, 4.08 mm ± 16 %
        >>> print(Tolerance(7e-6, float("inf"), (False, False), float("inf")))
        the worst peak stays within 0.5 dB for every clearance above 0.007 mm
        """
        if np.isinf(self.low):
            return f"with any clearance searched the worst peak is more than {RISE:g} dB higher: build no ceiling"
        low = format_number(1e3 * self.low)
        if np.isinf(self.high):
            return f"the worst peak stays within {RISE:g} dB for every clearance above {low} mm"
        high = format_number(1e3 * self.high)
        text = f"the worst peak stays within {RISE:g} dB for clearances from {low} to {high} mm"
        if any(self.limited):
            ends = " and ".join(
                name for name, end in zip(("smallest", "largest"), self.limited, strict=True) if end
            )
            text += f" ({ends} searched)"
        width, place = np.log(self.high / self.low), np.log(self.chosen / self.low)
        if width > 0.0 and min(place, width - place) < _NEAR * width:
            middle = (self.low * self.high) ** 0.5
            text += f": build to the middle, {format_number(1e3 * middle)} mm ± {100.0 * np.expm1(0.5 * width):.0f} %"
        return text


def tolerance(
    question: Question, space: Space, best: Trial, trials: Iterable[Trial], answers: Answers
) -> Tolerance:
    """Compute the interval: outward through the trials with the same dampers, then by bisection.

    `best`: the design whose interval is computed; `trials`: all designs computed.
    """
    most = best.peak.size * 10.0 ** (RISE / 20.0)
    choice, heaviest = best.choice, best.choice.heaviest
    shape = choice if choice.has_ceiling else choice.with_clearance(space.clearance[1])
    known = {1.0: True} if choice.has_ceiling else {}
    for trial in trials:
        factor = trial.choice.clearances[heaviest] / shape.clearances[heaviest]
        same = (trial.choice.bodies, trial.choice.masses) == (shape.bodies, shape.masses)
        if (
            same and np.isfinite(factor)
            and np.allclose(trial.choice.clearances, shape.wider(factor).clearances, rtol=1e-6)
        ):  # fmt: skip
            known.setdefault(factor, trial.peak.size <= most)

    def serves(factor: float) -> bool:
        if factor not in known:
            (trial,) = answers.of(question, [shape.wider(factor)])
            known[factor] = trial.peak.size <= most
        return known[factor]

    reference = shape.clearances[heaviest]
    if not serves(1.0):
        return Tolerance(np.inf, np.inf, (False, False), np.inf)
    low, low_limited = _end(serves, known, min(space.clearance[0] / min(shape.clearances), 1.0))
    if not choice.has_ceiling:
        return Tolerance(reference * low, np.inf, (low_limited, False), np.inf)
    high, high_limited = _end(serves, known, max(space.clearance[1] / max(shape.clearances), 1.0))
    if high_limited and space.without_ceiling and len(set(choice.bodies)) == len(choice.bodies):
        (unlimited,) = answers.of(question, [choice.without_ceiling()])
        if unlimited.peak.size <= most:
            high, high_limited = np.inf, False
    return Tolerance(reference * low, reference * high, (low_limited, high_limited), reference)


def _end(serves: Callable[[float], bool], known: Iterable[float], limit: float) -> tuple[float, bool]:
    """Return the last acceptable factor from 1 towards a limit, and whether it is the limit."""
    outwards = limit > 1.0
    between = {f for f in known if (1.0 < f < limit if outwards else limit < f < 1.0)}
    points = sorted({*between, limit}, reverse=not outwards)
    last = 1.0
    for point in points:
        steps = max(1, int(np.ceil(abs(np.log(point / last)) / np.log(_STEP) - 0.01)))
        for following in [*np.geomspace(last, point, steps + 1)[1:-1].tolist(), point]:
            if not serves(following):
                return _bisect(serves, last, following), False
            last = following
    return limit, True


def _bisect(serves: Callable[[float], bool], last: float, beyond: float) -> float:
    while abs(np.log(beyond / last)) > np.log(_RESOLUTION):
        middle = float(np.sqrt(beyond * last))
        if serves(middle):
            last = middle
        else:
            beyond = middle
    return last
