"""The paper's approximate method (Eqs 4-21): a one-mode reduction with closed-form motion of Types I to III.

Start with `reduction` for Eqs 12 and 13 (which mode, which mass ratio), then `periodic_motion` for Eqs 8-11 and
14-21.
"""
