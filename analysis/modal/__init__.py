"""Natural frequencies, damping ratios and shapes from frequency responses.

Start with `identification`; `lscf` is the estimator of poles.
"""
