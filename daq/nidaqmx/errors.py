"""Errors and warnings, under the names of `nidaqmx.errors`."""

from daq.instrument.errors import DaqError, DaqReadError, DaqResourceWarning, DaqWarning, DaqWriteError

# The base class of that package's errors.
Error = DaqError

__all__ = ["DaqError", "DaqReadError", "DaqResourceWarning", "DaqWarning", "DaqWriteError", "Error"]
