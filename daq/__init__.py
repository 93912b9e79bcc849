"""The instrument: sensors, converter, clock, tasks, recorder, replay."""

from __future__ import annotations

from importlib import import_module
from typing import Any

# Each public name and the module it lives in; a module is imported when one of its names is first used, so
# that `import daq` stays quick (numba alone takes longer to import than a whole impulse test takes to run).
_HOME: dict[str, str] = {
    "DaqError": "daq.instrument.errors",
    "Task": "daq.face.task",
    "connect": "daq.instrument.connection",
    "Recorder": "daq.recording.recorder",
    "Recording": "daq.recording.recording",
    "open": "daq.recording.recording",
    "recover": "daq.recording.recovery",
    "RunWarning": "daq.measurement.run",
    "record": "daq.measurement.run",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'daq' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
