"""Mass, clearance and location of dampers for the smallest worst peak; independent of sensors and recordings.

Start with `design`; `search` evaluates candidate designs, `worst_peak` computes the peak of a design.
"""
