"""Prediction of a test before it is recorded: maxima of sensors, converter and amplifier, and flights of dampers.

The linear response of the scene locates the maxima of a long test; a rehearsal of these parts, a simulation without a
recording, gives their size. Start with `foresee`.
"""
