"""Steady motion with beds of grains over frequency, compared with the same beds as one mass: `rig grains`.

A study over `rig.grain_beds`, whose pieces are computed by workers and stored in a table. Start with `bed_response`.
"""
