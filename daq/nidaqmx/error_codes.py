"""Codes of errors and warnings, under the names of `nidaqmx.error_codes`."""

from daq.instrument.errors import DAQmxErrors, DAQmxWarnings

__all__ = ["DAQmxErrors", "DAQmxWarnings"]
