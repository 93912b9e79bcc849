"""Entry point of the simulation of grains, so the core does not depend on the extra `grains`."""

from functools import cache
from importlib.metadata import entry_points
from typing import Any


@cache
def grains_simulation() -> Any:
    """Load the module `simulation` of the beds of grains, which provides `propagator` and `simulate`."""
    (point,) = entry_points(group="shotrig.grains")
    return point.load()
