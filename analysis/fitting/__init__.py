"""A scene fitted to recordings of the real structure: what its values are, how certain, and what cannot be told.

Knows the rig, as its model of what was recorded.
"""
