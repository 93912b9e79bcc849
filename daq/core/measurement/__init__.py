"""Runs a test on its bench: the loop of drive and samples, limits, checks before the test and reports after it.

This package uses the simulator only through the bench. Start with `run`, which contains `record()`.
"""
