"""Exact periodic motions by the shooting method: orbits, their stability, branches over a parameter, and sweeps.

Start with `periodic_orbit`; `shooting` solves for the orbit of a given sequence of events, with the derivative of the
flow through its events, `orbit` computes its stability from that, and `branches` follows it over a parameter.
"""
