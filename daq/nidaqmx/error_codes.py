"""Codes of errors and warnings, under the names of `nidaqmx.error_codes`."""

from daq.errors import DAQmxErrors, DAQmxWarnings

__all__ = ["DAQmxErrors", "DAQmxWarnings"]
