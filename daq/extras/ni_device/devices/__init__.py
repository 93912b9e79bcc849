"""Devices for scripts: names of devices and channels, types of measurement, and TEDS of sensors."""
