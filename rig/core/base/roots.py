"""Root of a function in a bracket by Brent's method.

R. P. Brent, Algorithms for Minimization without Derivatives, 1973, chapter 4. The steps are those of
`scipy.optimize.brentq`, with the same results to the last bit. The import of `scipy.optimize` alone would take a sixth
of the time of a command.
"""

from collections.abc import Callable

# Relative tolerance of a root: four units in the last place.
_RELATIVE_TOLERANCE = 4 * 2.0**-52


def bracketed_root(function: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Return the root between two arguments at which the function has different signs; `tolerance`: absolute.

    >>> round(bracketed_root(lambda x: x**3 - 2.0, 0.0, 2.0, 1e-13), 12)
    1.259921049895
    """
    previous, current = low, high
    f_previous, f_current = function(low), function(high)
    if f_previous == 0.0:
        return low
    if f_current == 0.0:
        return high
    if (f_previous < 0.0) == (f_current < 0.0):
        raise ValueError(f"the function has the same sign at {low:g} and {high:g}; expected different signs.")
    # The root is between `current` and `opposite`; the last two steps were `step` and `step_before`.
    opposite, f_opposite, step_before, step = previous, f_previous, 0.0, 0.0
    while True:
        if f_previous != 0.0 and f_current != 0.0 and (f_previous < 0.0) != (f_current < 0.0):
            opposite, f_opposite = previous, f_previous
            step_before = step = current - previous
        if abs(f_opposite) < abs(f_current):
            previous, current, opposite = current, opposite, current
            f_previous, f_current, f_opposite = f_current, f_opposite, f_current
        limit = (tolerance + _RELATIVE_TOLERANCE * abs(current)) / 2
        bisection = (opposite - current) / 2
        if f_current == 0.0 or abs(bisection) < limit:
            return current
        trial = bisection
        if abs(step_before) > limit and abs(f_current) < abs(f_previous):
            if previous == opposite:
                trial = -f_current * (current - previous) / (f_current - f_previous)
            else:
                slope = (f_previous - f_current) / (previous - current)
                slope_opposite = (f_opposite - f_current) / (opposite - current)
                numerator = -f_current * (f_opposite * slope_opposite - f_previous * slope)
                denominator = slope_opposite * slope * (f_opposite - f_previous)
                trial = numerator / denominator if denominator else bisection
        if trial is not bisection and 2 * abs(trial) < min(abs(step_before), 3 * abs(bisection) - limit):
            step_before, step = step, trial
        else:
            step_before = step = bisection
        previous, f_previous = current, f_current
        current += step if abs(step) > limit else (limit if bisection > 0.0 else -limit)
        f_current = function(current)
