"""A test on the virtual bench: drive and samples in a loop, limits, checks before the test, reports after it.

This package uses the simulator only through the bench. Start with `run`, which contains `record()`.
"""
