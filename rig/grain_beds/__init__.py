"""Beds of grains in a shaken structure: discrete elements by LAMMPS, coupled both ways to the exact linear system.

Start with `coupling`; `bed` sets up the contents of a cavity. LAMMPS is loaded with the first bed. Nothing here
knows tests or sensors.
"""
