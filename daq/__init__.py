"""The instrument: sensors, converter, clock, tasks, recorder, replay."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Each public name and the module it lives in; a module is imported when one of its names is first used, so
# that `import daq` stays quick (numba alone takes longer to import than a whole impulse test takes to run).
_HOME: dict[str, str] = {
    "DaqError": "daq.errors",
    "Task": "daq.task",
    "connect": "daq.connection",
    "Recorder": "daq.recorder",
    "Recording": "daq.recording",
    "open": "daq.recording",
    "recover": "daq.salvage",
    "RunWarning": "daq.measurement",
    "record": "daq.measurement",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'daq' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
