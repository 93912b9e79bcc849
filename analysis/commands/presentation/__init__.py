"""Output of the `analysis` commands: printed results, CSV tables, figures, and the demonstration.

Start with `frf_findings`, the output of `analysis frf`; each command has such a module.
"""
