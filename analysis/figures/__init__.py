"""Figures of responses, decays, modes and dampers, in the style that all figures share (`rig.figure_style`).

Start with `frf_figure`.
"""
