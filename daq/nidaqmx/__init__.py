"""The instrument under the names of the package nidaqmx.

A script written for that package and accelerometer channels runs on the rig with one line changed::

    import daq.nidaqmx as nidaqmx

The scene on the bench is the one given to `daq.connect`, else the one the environment variable
SHOTRIG_SCENE names, else the paper's rig with three dampers. What the rig's instrument does not have raises
`DaqError` naming the call.
"""

from daq.face.task import Task
from daq.instrument.errors import DaqError, DaqReadError, DaqResourceWarning, DaqWarning, DaqWriteError
from daq.nidaqmx import constants, error_codes, errors, stream_readers, stream_writers, system, types, utils

__all__ = [
    "DaqError",
    "DaqReadError",
    "DaqResourceWarning",
    "DaqWarning",
    "DaqWriteError",
    "Task",
    "constants",
    "error_codes",
    "errors",
    "stream_readers",
    "stream_writers",
    "system",
    "types",
    "utils",
]
