"""Natural frequencies, damping ratios and shapes from frequency responses.

Start with `identification`; `lscf` estimates the initial poles.
"""
