"""Constants, under the names of `nidaqmx.constants`."""

from typing import Any

from daq.face.constants import *  # noqa: F403
from daq.instrument.errors import unsupported


def __getattr__(name: str) -> Any:
    """Say of a constant that is not here what it means: it belongs to what the instrument does not have."""
    if name[:1].isupper():
        raise unsupported(f"nidaqmx.constants.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
