"""The interval of clearances in which the worst peak of a design stays nearly the same: the tolerance of a design."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from rig.core.results import format_number
from rig.studies.design.choice import Objective, SearchSpace, Trial
from rig.studies.design.evaluator import Evaluator

#: Rise of the worst peak at the ends of the tolerance interval, relative to the design [dB].
MAX_RISE_DB = 0.5
#: Bisection stops when the ratio of its two clearances is below this value.
_RESOLUTION_RATIO = 1.06
#: The search for an end of the interval multiplies or divides the clearance by at most this factor in a step.
_STEP_RATIO = 1.6
#: Distance of the clearance from an end of the interval, in logarithmic widths, below which the middle is better.
_MIN_END_DISTANCE = 0.15


@dataclass(frozen=True)
class Tolerance:
    """Clearances of the heaviest damper for which the worst peak rises by at most `MAX_RISE_DB`.

    All clearances change by the same factor. `low`, `high`: ends of the interval [m]. `high` is infinite if the peak is
    low without a ceiling, too. Both ends are infinite if the peak is low only without a ceiling.
    """

    low: float
    high: float
    at_limit: tuple[bool, bool]  # whether each end is a limit of the search; the interval may then be wider
    chosen: float  # clearance of the chosen design [m]

    def __str__(self) -> str:
        """Report the interval, and the recommended clearance if the chosen clearance is near an end.

        >>> print(Tolerance(0.0035, 0.00475, (False, False), 0.00462))
        the largest peak rises by at most 0.5 dB for clearances from 3.5 to 4.75 mm. Build to the middle, 4.08 mm
        >>> print(Tolerance(7e-6, float("inf"), (False, False), float("inf")))
        the largest peak rises by at most 0.5 dB for every clearance above 0.007 mm
        """
        if np.isinf(self.low):
            rise = f"more than {MAX_RISE_DB:g} dB higher than without a ceiling"
            return f"with every searched clearance, the largest peak is {rise}: build no ceiling"
        low = format_number(1e3 * self.low)
        if np.isinf(self.high):
            without = "" if np.isinf(self.chosen) else " and without a ceiling: the clearance is not critical"
            return f"the largest peak rises by at most {MAX_RISE_DB:g} dB for every clearance above {low} mm{without}"
        high = format_number(1e3 * self.high)
        text = f"the largest peak rises by at most {MAX_RISE_DB:g} dB for clearances from {low} to {high} mm"
        if any(self.at_limit):
            ends = " and ".join(name for name, end in zip(("smallest", "largest"), self.at_limit, strict=True) if end)
            text += f" ({ends} searched clearance)"
        width, position = np.log(self.high / self.low), np.log(self.chosen / self.low)
        if width > 0.0 and min(position, width - position) < _MIN_END_DISTANCE * width:
            middle = (self.low * self.high) ** 0.5
            text += f". Build to the middle, {format_number(1e3 * middle)} mm"
        return text


def clearance_tolerance(
    objective: Objective, space: SearchSpace, best: Trial, trials: Iterable[Trial], evaluator: Evaluator
) -> Tolerance:
    """Compute the interval: increase and reduce the clearances in steps until the peak is too high, then bisect.

    `best`: the design whose interval is computed; `trials`: all designs computed.
    """
    max_peak = best.peak.magnitude * 10.0 ** (MAX_RISE_DB / 20.0)
    choice, heaviest_index = best.choice, best.choice.heaviest_index
    # The clearances of this design are multiplied by a common factor.
    unscaled = choice if choice.has_ceiling else choice.with_clearance(space.clearance[1])
    acceptable = {1.0: True} if choice.has_ceiling else {}
    for trial in trials:
        factor = trial.choice.clearances[heaviest_index] / unscaled.clearances[heaviest_index]
        same_dampers = (trial.choice.bodies, trial.choice.masses) == (unscaled.bodies, unscaled.masses)
        if (
            same_dampers and np.isfinite(factor)
            and np.allclose(trial.choice.clearances, unscaled.scale_clearances(factor).clearances, rtol=1e-6)
        ):  # fmt: skip
            acceptable.setdefault(factor, trial.peak.magnitude <= max_peak)

    def is_acceptable(factor: float) -> bool:
        if factor not in acceptable:
            (trial,) = evaluator.compute(objective, [unscaled.scale_clearances(factor)])
            acceptable[factor] = trial.peak.magnitude <= max_peak
        return acceptable[factor]

    unscaled_clearance = unscaled.clearances[heaviest_index]
    if not is_acceptable(1.0):
        return Tolerance(np.inf, np.inf, (False, False), np.inf)
    low, low_at_limit = _interval_end(
        is_acceptable, acceptable, min(space.clearance[0] / min(unscaled.clearances), 1.0)
    )
    if not choice.has_ceiling:
        return Tolerance(unscaled_clearance * low, np.inf, (low_at_limit, False), np.inf)
    high, high_at_limit = _interval_end(
        is_acceptable, acceptable, max(space.clearance[1] / max(unscaled.clearances), 1.0)
    )
    if high_at_limit and space.allows_no_ceiling and len(set(choice.bodies)) == len(choice.bodies):
        (without_ceiling,) = evaluator.compute(objective, [choice.without_ceiling()])
        if without_ceiling.peak.magnitude <= max_peak:
            high, high_at_limit = np.inf, False
    return Tolerance(
        unscaled_clearance * low, unscaled_clearance * high, (low_at_limit, high_at_limit), unscaled_clearance
    )


def _interval_end(
    is_acceptable: Callable[[float], bool], computed: Iterable[float], limit: float
) -> tuple[float, bool]:
    """Return the last acceptable factor of the clearances towards a limit, and whether it is the limit."""
    # Factors that are already `computed` are tried as steps, too.
    outwards = limit > 1.0
    between = {factor for factor in computed if (1.0 < factor < limit if outwards else limit < factor < 1.0)}
    points = sorted({*between, limit}, reverse=not outwards)
    accepted = 1.0
    for point in points:
        steps = max(1, int(np.ceil(abs(np.log(point / accepted)) / np.log(_STEP_RATIO) - 0.01)))
        for factor in [*np.geomspace(accepted, point, steps + 1)[1:-1].tolist(), point]:
            if not is_acceptable(factor):
                return _bisect(is_acceptable, accepted, factor), False
            accepted = factor
    return limit, True


def _bisect(is_acceptable: Callable[[float], bool], accepted: float, rejected: float) -> float:
    while abs(np.log(rejected / accepted)) > np.log(_RESOLUTION_RATIO):
        middle = float(np.sqrt(rejected * accepted))
        if is_acceptable(middle):
            accepted = middle
        else:
            rejected = middle
    return accepted
