"""Beds of grains in a shaken structure: discrete elements by LAMMPS, coupled both ways to the exact linear system.

Start with `coupling`; `bed` creates the grains of a cavity. LAMMPS is loaded with the first bed. No module of this
folder depends on tests or sensors.
"""
