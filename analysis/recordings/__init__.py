"""Common functions for recordings: slices of bounded memory, names, delays of channels.

Start with `slices`.
"""
