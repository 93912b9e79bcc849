"""Recordings, responses and modes in other programs' formats: UFF, MATLAB, WAV, CSV, NPZ, SEP-005.

Start with `export`.
"""
