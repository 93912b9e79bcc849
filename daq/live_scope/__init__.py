"""The live scope: the rig in real time, in the viewer, with commands typed at it.

Start with `scope`; `screen` is what it shows.
"""
