"""Beds of grains in a shaken structure: discrete elements by LAMMPS, coupled both ways to the exact linear system.

Start with `coupling`; `bed` tells LAMMPS what is in a cavity. LAMMPS is loaded when the first bed is made. Nothing here
knows tests or sensors.
"""
