"""The run of a test: the loop of drive and samples, limits, what is checked before and reported after.

Nothing here knows the simulator beyond the bench. Start with `run`, which holds `record()`.
"""
