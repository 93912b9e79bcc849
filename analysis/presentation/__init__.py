"""Output of the `analysis` commands: printed results, CSV tables, overlaid figures, and the demonstration.

Start with `presentation`.
"""
