"""Access of the analysis to recordings: segments that fit into memory, names, and delays of channels.

Start with `slices`.
"""
