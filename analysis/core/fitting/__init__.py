"""Fit of a scene to recordings of the real structure: values with 95 % intervals.

Start with `fit`. `problem` states the least-squares problem, `estimate` solves it and computes the covariance, and
`identifiability` lists the values that the recordings determine only in combination.
"""
