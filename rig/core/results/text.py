"""Numbers, expanded uncertainties and ranges of frequencies as text."""

from collections.abc import Sequence
from math import ceil, floor, inf, isfinite, log10

import numpy as np

from rig.core.numerics.runs import runs_of

# Maximum number of listed ranges; more are summarized by a count, so a message stays readable.
_MAX_RANGES = 8
# Maximum number of digits of a value with an interval; further digits are finer than the tolerances of sample clocks.
_MAX_DIGITS = 6


def format_number(value: float) -> str:
    """Write a number with three digits, without a power of ten unless it is tiny or huge.

    >>> [format_number(value) for value in (2.6, 3000.0, 12345.6, 1.5e-7)]
    ['2.6', '3000', '12300', '1.5e-07']
    """
    return f"{float(f'{value:.3g}'):.10g}"


def format_percent(ratio: float) -> str:
    """Write a ratio in percent with two digits, without a power of ten.

    >>> [format_percent(ratio) for ratio in (0.0314, 0.997, 12.0, 0.00021)]
    ['3.1 %', '100 %', '1200 %', '0.021 %']
    """
    return f"{float(f'{100.0 * ratio:.2g}'):.10g} %"


def format_decimals(value: float, decimals: int) -> str:
    """Write a number with fixed decimals, or with three significant digits if these are more.

    >>> [format_decimals(value, 2) for value in (34.7773, 0.0, 2.0, 0.28, 4.10936e-05)]
    ['34.78', '0.00', '2.00', '0.280', '4.11e-05']
    """
    is_small = 0.0 < abs(value) < 10.0 ** (2 - decimals)
    return f"{value:#.3g}" if is_small else f"{value:.{decimals}f}"


def round_to_uncertainty(value: float, expanded: float) -> str:
    """Write a number rounded to the second significant digit of its expanded uncertainty.

    If the number is smaller than its uncertainty, it has two digits of its own.

    >>> round_to_uncertainty(0.0123456, 0.00021), round_to_uncertainty(1078.4, 134.0), round_to_uncertainty(376.0, 7e4)
    ('0.01235', '1080', '380')
    >>> round_to_uncertainty(3.14159, 0.0)
    '3.142'
    >>> round_to_uncertainty(3.14159e-12, 2e-14)
    '3.142e-12'
    """
    if not isfinite(expanded) or expanded <= 0.0:
        return f"{value:.4g}"
    decimals = 1 - floor(log10(expanded))
    # More than nine decimals would be mostly zeros; numbers that small are written with a power of ten.
    if decimals > 9 and 0.0 < abs(value) < 1e-6:
        return f"{value:.{max(decimals + floor(log10(abs(value))) + 1, 1)}g}"
    decimals = min(decimals, 9)
    if decimals < 0 and value:
        decimals = max(decimals, min(1 - floor(log10(abs(value))), 0))
    return f"{round(value, decimals):.{max(decimals, 0)}f}"


def format_frequency(frequency: float, expanded: float) -> str:
    """Write a frequency for a label: two decimals, or fewer if its expanded uncertainty exceeds 0.01 Hz.

    >>> format_frequency(13.0365, 1e-4), format_frequency(33.63, 0.31), format_frequency(167.0, 17.0)
    ('13.04 Hz', '33.6 Hz', '170 Hz')
    """
    smallest = 0.01 * min(frequency, 1.0)
    # The last digit is that of the first significant digit of the uncertainty.
    return f"{round_to_uncertainty(frequency, 10.0 * (expanded if expanded > smallest else smallest))} Hz"


def format_interval(value: float, expanded: float) -> str:
    """Write a number with its expanded uncertainty, for a table whose header gives the unit.

    >>> format_interval(2.4213, 0.204), format_interval(935.21, float("inf")), format_interval(1.0, 0.0)
    ('2.42 ± 0.20', '935.2 (± unknown)', '1')
    """
    if expanded == 0.0:
        return round_to_uncertainty(value, expanded)
    return " ± ".join(_round_pair(value, expanded)) if isfinite(expanded) else f"{value:.4g} (± unknown)"


def _round_pair(value: float, expanded: float) -> tuple[str, str]:
    """Round a number of at most six digits and its expanded uncertainty to the same digit; the uncertainty upwards.

    >>> _round_pair(2.4213, 0.204), _round_pair(13.036529, 0.000071)
    (('2.42', '0.20'), ('13.0365', '0.0001'))
    """
    decimals = _MAX_DIGITS - 1 - floor(log10(abs(value))) if value and isfinite(value) else 0
    last = 10.0**-decimals
    if 0 < decimals <= 9 and 0.0 < expanded < 10.0 * last:
        return f"{value:.{decimals}f}", f"{ceil(expanded / last) * last:.{decimals}f}"
    return round_to_uncertainty(value, expanded), round_to_uncertainty(expanded, expanded)


def format_limited(value: float, expanded: float, highest: float = inf) -> str:
    """Write a quantity between 0 and a highest value with its interval, or as "below" or "above" if one end is outside.

    An interval that is entirely out of range is written as it is.

    >>> format_limited(31.2, 18.0, 100.0), format_limited(5.3, 18.0, 100.0), format_limited(86.0, 18.0, 100.0)
    ('31 ± 18', 'below 23', 'above 68')
    >>> format_limited(-31.2, 18.0, 100.0), format_limited(130.0, 18.0, 100.0)
    ('-31 ± 18', '130 ± 18')
    >>> format_limited(50.0, 60.0, 100.0), format_limited(12.345, float("nan")), format_limited(float("nan"), 1.0)
    ('not determined', '12.35', '')
    """
    if not isfinite(value):
        return ""
    low, high = value - expanded, value + expanded
    if low <= 0.0 and high >= highest:
        return "not determined"
    if high <= 0.0 or low >= highest:
        return format_interval(value, expanded)
    if low <= 0.0 < expanded < inf:
        return f"below {round_to_uncertainty(high, expanded)}"
    if high >= highest:
        return f"above {round_to_uncertainty(low, expanded)}"
    return format_interval(value, expanded if expanded == expanded else 0.0)


def format_quantity(value: float, expanded: float, unit: str) -> str:
    """Write a number with expanded uncertainty and unit: (2.42 ± 0.20) %, so both have the unit.

    >>> format_quantity(2.4213, 0.204, "%"), format_quantity(935.21, float("inf"), "µm/N")
    ('(2.42 ± 0.20) %', '935.2 µm/N (± unknown)')
    """
    if not isfinite(expanded):
        return f"{round_to_uncertainty(value, expanded)} {unit} (± unknown)"
    return f"({' ± '.join(_round_pair(value, expanded))}) {unit}"


def format_frequencies(frequencies: Sequence[float], chosen: Sequence[bool]) -> str:
    """List the chosen frequencies in Hz; adjacent frequencies form ranges. More than 8 ranges become a count.

    >>> format_frequencies([10.0, 11.0, 12.5, 14.0, 20.0], [True, False, True, True, True])
    '10 and 12.5 to 20 Hz'
    >>> format_frequencies([3.0, 1.0, 3.0], [False, True, True])
    '1 to 3 Hz'
    >>> format_frequencies(range(40), [k % 2 == 0 for k in range(40)])
    '20 of 40 frequencies from 0 to 38 Hz'
    """
    distinct, index = np.unique(np.asarray(frequencies, dtype=np.float64), return_inverse=True)
    flags = np.zeros(distinct.size, dtype=bool)
    flags[index[np.asarray(chosen, dtype=bool)]] = True
    limits = [(f"{distinct[first]:.4g}", f"{distinct[stop - 1]:.4g}") for first, stop in runs_of(flags)]
    if len(limits) > _MAX_RANGES:
        return f"{flags.sum()} of {flags.size} frequencies from {limits[0][0]} to {limits[-1][1]} Hz"
    *before, last = [low if low == high else f"{low} to {high}" for low, high in limits]
    return f"{', '.join(before)} and {last} Hz" if before else f"{last} Hz"


def table_lines(rows: Sequence[Sequence[str]], alignment: str) -> list[str]:
    """Return the lines of a table with a header; `alignment` has ``<`` or ``>`` for each column.

    Columns that are empty below the header are omitted.

    >>> table_lines([("channel", "peak / Hz", "note"), ("body1", "12.54", "")], "<><")
    ['channel  peak / Hz', 'body1        12.54']
    """
    columns = [
        [f"{cell:{align}{max(map(len, column))}}" for cell in column]
        for column, align in zip(zip(*rows, strict=True), alignment, strict=True)
        if any(column[1:])
    ]
    return ["  ".join(row).rstrip() for row in zip(*columns, strict=True)]
