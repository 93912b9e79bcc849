"""Pytest plugin: tests of programs for NI's package `nidaqmx` run on a bench of emulated devices, without hardware.

Start with `plugin` (options and fixtures) and `bench` (the object that a test uses). A bench is a scene, or modules
without mechanics: see `description` and `wired_terminals`.
"""
