"""Uncertainty of responses: random errors, systematic errors, and their budget.

Start with `budget`, which combines random and systematic errors. `random_errors` contains covariances between lines and
outputs.
"""
