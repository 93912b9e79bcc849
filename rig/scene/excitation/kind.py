"""Types of the settings that several kinds of test have."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal

from pydantic import Field

from rig.settings.problems import Problem
from rig.settings.quantities import FORCE, FREQUENCY, LENGTH, TIME, VOLTAGE
from rig.settings.quantity_field import Quantity

Frequency = Annotated[float, Quantity(FREQUENCY, above=0.0)]
Duration = Annotated[float, Quantity(TIME, above=0.0)]
# The unit of the drive depends on the shaker: volts at its amplifier, or displacement of the table.
Force = Annotated[float, Quantity(FORCE, above=0.0)]
Drive = Annotated[float, Quantity(VOLTAGE, LENGTH, above=0.0)]
Forces = Annotated[float | tuple[float, ...], Quantity(FORCE, above=0.0, listed=True)]
Drives = Annotated[float | tuple[float, ...], Quantity(VOLTAGE, LENGTH, above=0.0, listed=True)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]
ShakerNumber = Annotated[int, Field(ge=1)]
Start = Annotated[
    Literal["settled", "empty"],
    Field(
        description="Initial position, at rest with the dampers on their floors. settled: static equilibrium; empty: "
        "x = 0, the equilibrium of the structure without dampers."
    ),
]
Spacing = Literal["linear", "log"]

#: Maximum number of frequencies of a test.
MAX_STEPS = 100_000
#: Relative tolerance within which a controller accepts a force.
FORCE_TOLERANCE = 0.005


def spaced_frequencies(first: float, last: float, points: int, spacing: str) -> tuple[float, ...]:
    """Return `points` frequencies, evenly spaced on a linear or logarithmic axis; first and last are exact.

    >>> spaced_frequencies(8.0, 10.0, 3, "linear")
    (8.0, 9.0, 10.0)
    """
    fractions = [k / (points - 1) for k in range(points)]
    if spacing == "log":
        interior = [first * (last / first) ** fraction for fraction in fractions]
    else:
        interior = [first + (last - first) * fraction for fraction in fractions]
    return (first, *interior[1:-1], last)


def check_band(low: float, high: float) -> Iterable[Problem]:
    """Check that a frequency band is given with its lower end first."""
    if low >= high:
        yield Problem(("from",), f"got {low:g} Hz, which is not below to, {high:g} Hz. Give the lower end first.")
