"""Checks the metadata fields of a recording when it is opened; later code relies on their values."""

import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rig.core.base.errors import RecordingError
from rig.core.base.escaping import is_single_line

# Longest name [characters]; a longer name is a sign of damage.
MAX_NAME_LENGTH = 200
# Times are computed from sample indices as floats, which are exact up to this value.
MAX_SAMPLES = 2**53


class Check(NamedTuple):
    """Condition of a valid value, and its description for messages."""

    is_valid: Callable[[Any], bool]
    expected: str


def check(fields: Mapping[str, Any], checks: Mapping[str, Check]) -> None:
    """Apply the checks to the fields of the same names; raise `RecordingError` at the first invalid value.

    >>> check({"rate": 0.0}, {"rate": POSITIVE})
    Traceback (most recent call last):
    rig.core.base.errors.RecordingError: rate = 0.0; expected a positive number
    """
    for key, value in fields.items():
        if key in checks and not checks[key].is_valid(value):
            text = repr(value) if not isinstance(value, int) or abs(value) < 1e60 else "a number of hundreds of digits"
            raise RecordingError(f"{key} = {text[:80]}; expected {checks[key].expected}")


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number below 1e300.

    >>> is_number(1), is_number(True), is_number(float("nan")), is_number(10**400), is_number("1")
    (True, False, False, False, False)
    """
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def is_name(value: Any) -> bool:
    r"""Return whether a value is one line of printable text, at most `MAX_NAME_LENGTH` characters long.

    >>> is_name("body 1"), is_name(""), is_name("a\x1b[31m"), is_name("a" * 1000)
    (True, False, False, False)
    """
    return isinstance(value, str) and 0 < len(value) <= MAX_NAME_LENGTH and is_single_line(value)


def is_count(value: Any) -> bool:
    """Return whether a value is a whole number of at least 1 that a float represents exactly."""
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MAX_SAMPLES


def _is_location(value: Any) -> bool:
    """Return whether a value is a location on the rig, such as "body 1" or "table"; it may be empty."""
    if isinstance(value, str) and value.startswith("body "):
        return re.fullmatch(r"body [1-9][0-9]{0,5}", value) is not None
    return value == "" or is_name(value)


def _are_roots(value: Any) -> bool:
    """Return whether a value is a list of zeros or poles, each as a list of its real and imaginary parts."""
    return (
        isinstance(value, list)
        and len(value) <= 100
        and all(isinstance(root, list) and len(root) == 2 and all(map(is_number, root)) for root in value)
    )


# Fields of `DecimationFilter`.
_FILTER_FIELDS = ("rate", "delay", "cutoff", "beta")


def _is_filter(value: Any) -> bool:
    if not isinstance(value, dict) or (value and set(value) != set(_FILTER_FIELDS)):
        return False
    return all(POSITIVE.is_valid(number) for number in value.values()) and value.get("delay", 0) <= 10_000


def _optional(check: Check) -> Check:
    """Return a check that also accepts None (null in JSON)."""
    return Check(lambda value: value is None or check.is_valid(value), f"{check.expected}, or null")


NAME = Check(is_name, f"a line of 1 to {MAX_NAME_LENGTH} printable characters")
NUMBER = Check(is_number, "a finite number")
POSITIVE = Check(lambda value: is_number(value) and value > 0, "a positive number")
NOT_ZERO = Check(lambda value: is_number(value) and value != 0, "a number other than zero")
COUNT = Check(is_count, "a whole number, at least 1")
BOOLEAN = Check(lambda value: isinstance(value, bool), "true or false")
TEXT = Check(lambda value: isinstance(value, str), "text")
NAMES = Check(lambda value: isinstance(value, list) and all(map(is_name, value)), "a list of names")

CHANNEL_CHECKS = {
    "name": NAME,
    "at": Check(_is_location, "a location such as body 1 or table"),
    "sensitivity": NOT_ZERO,
    "rate": POSITIVE,
    "zeros": Check(_are_roots, "at most 100 pairs of numbers, rad/s"),
    "poles": Check(_are_roots, "at most 100 pairs of numbers, rad/s"),
    "gain": NUMBER,
    "average": BOOLEAN,
    "delay": Check(lambda value: is_number(value) and abs(value) < 1e6, "a time in seconds"),
    "filter": Check(_is_filter, f"{', '.join(_FILTER_FIELDS)} as positive numbers, or nothing"),
    "volts_per_count": _optional(NOT_ZERO),
    "range": _optional(POSITIVE),
    "sensor": Check(
        lambda value: isinstance(value, dict) and all(isinstance(text, str) for text in value.values()),
        "texts by their names",
    ),
}
