"""Compiled signal processing: exact propagation through circuits, interpolation of the input, noise, decimation.

Nothing here knows channels, scenes or files. Start with `circuit`, then `propagation`, which
carries it through samples.
"""
