"""Pytest plugin: tests of programs for NI's package `nidaqmx` run on a bench of emulated devices, without hardware.

Start with `plugin`, the options and fixtures, and `test_bench`, which tests use. A bench is a scene, or it has modules
without mechanics: see `description` and `wired_terminals`.
"""
