"""Texts on errors that the intervals of results lack, because the scene states no tolerance."""

from collections.abc import Sequence

from analysis.core.responses.frequency_responses import EXCLUDED_ALIASING
from rig.core.results.response import Response
from rig.core.results.uncertainty import CLOCK, SENSITIVITY, SYSTEMATIC


def includes_sensors(frfs: Sequence[Response]) -> bool:
    """Return whether the uncertainties of all responses contain tolerances of their sensors."""
    return all(any(name in frf.limits for name in (SENSITIVITY, SYSTEMATIC)) for frf in frfs)


def unstated_tolerances(frfs: Sequence[Response]) -> list[str]:
    """Return the causes of errors that the uncertainties of responses lack, because the scene does not state them."""
    has_clock = all(CLOCK in frf.limits for frf in frfs)
    missing = ["calibration"] * (not includes_sensors(frfs)) + ["the sample clock"] * (not has_clock)
    return missing + ["aliasing"] * any(EXCLUDED_ALIASING in text for frf in frfs for text in frf.warnings)


def unstated_text(missing: Sequence[str]) -> str:
    """Write which errors the intervals of results lack, and why; `missing`: from `unstated_tolerances`.

    >>> unstated_text(["calibration", "the sample clock", "aliasing"])
    'errors of calibration, the sample clock and aliasing: no tolerance or filter is stated'
    """
    errors = " and ".join(filter(None, [", ".join(missing[:-1]), missing[-1]]))
    return f"errors of {errors}: no tolerance{' or filter' * ('aliasing' in missing)} is stated"


def intervals_text(missing: Sequence[str]) -> str:
    """Write which errors the intervals of results lack, for a caption; `missing`: from `unstated_tolerances`."""
    return f"95 % intervals (without {unstated_text(missing)})" if missing else "95 % intervals"
