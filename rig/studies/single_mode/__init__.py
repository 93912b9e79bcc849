"""The approximate method (Eqs 4-21) of Inoue, Yokomichi and Hiraki (2011): one mode, closed-form motion of Types I-III.

Start with `reduction` for Eqs 12 and 13 (which mode, which mass ratio), then `periodic_motion` for Eqs 8-11 and
14-21.
"""
