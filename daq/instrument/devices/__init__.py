"""Devices that scripts can use: data sheets, names, kinds of measurement, and electronic data sheets of sensors."""
