"""What is installed, under the names of `nidaqmx.system`."""

from daq.face.devices import Device, PhysicalChannel, System

__all__ = ["Device", "PhysicalChannel", "System"]
