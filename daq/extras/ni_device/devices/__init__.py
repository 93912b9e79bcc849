"""Devices that scripts can use, names of devices and channels, types of measurement, and TEDS of sensors."""
