"""Recordings and responses in other programs' formats: UFF, WAV, CSV, NPZ, SEP-005.

Start with `export`.
"""
