"""Reproduce the paper's figures and assess its claims: `analysis paper`.

Start with `reproduce`; `claims` contains the verdicts.
"""
