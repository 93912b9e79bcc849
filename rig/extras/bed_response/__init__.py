"""Steady-state motion of beds of grains at each frequency, compared with single-mass models, for `rig grains`.

Worker processes compute the motion at each frequency, and a table stores it. Start with `bed_response`.
"""
