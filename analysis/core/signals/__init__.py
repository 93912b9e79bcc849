"""Evaluation of the signal of a channel without a reference: shock response spectrum.

Start with `shock_spectrum`.
"""
