"""Types, under the names of `nidaqmx.types`."""

from daq.devices import DriverVersion

__all__ = ["DriverVersion"]
