"""Exact periodic motions by the shooting method: orbits, their stability, branches over a parameter, and sweeps.

Start with `periodic_orbit`; `shooting` evaluates the equations of the orbit with a given sequence of events, and their
derivatives; `orbit` computes its stability from the derivatives; `branches` follows the orbit over a parameter.
"""
