"""A scene fitted to recordings of the real structure: its values with 95 % intervals, and which are undetermined.

Knows the rig, as its model of what was recorded. Start with `fit`; `problem` is the least squares, `estimate`
solves it and says how certain the values are, `identifiability` which of them go together.
"""
