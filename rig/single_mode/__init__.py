"""The paper's approximate method (Eqs 4-21): one mode kept, periodic motion of Types I to III in closed form.

Start with `reduction` for Eqs 12 and 13 (which mode, which mass ratio), then `periodic_motion` for Eqs 8-11 and 14-21.
"""
