"""Natural frequencies, damping ratios and shapes from frequency responses.

Start with `identification`; the package `modal_models` fits the poles.
"""
