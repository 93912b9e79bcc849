"""Checks of channels and of response curves: failed channels, steps of gain, flaws, implausible phases, jumps.

Start with `clean_segments`, which omits the flawed parts of a recording. Each check is independent of the estimators.
"""
