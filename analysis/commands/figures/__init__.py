"""Figures of responses, decays, modes and dampers, in the common style of `rig.core.base.figure_style`.

Start with `frf_figure`.
"""
