"""Export of recordings, frequency responses and modes: UFF, MATLAB, WAV, CSV, NPZ, SEP-005.

Start with `export`.
"""
