"""Types, under the names of `nidaqmx.types`."""

from daq.face.devices import DriverVersion

__all__ = ["DriverVersion"]
