"""The live scope: the rig in real time, with a viewer and typed commands.

Start with `scope`; `screen` is its display.
"""
