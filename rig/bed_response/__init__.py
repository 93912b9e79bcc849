"""Steady motion with beds of grains, frequency by frequency, beside the same beds as one mass: `rig grains`.

A study over `rig.grain_beds`, whose pieces are computed by workers and kept in a table. Start with `bed_response`.
"""
