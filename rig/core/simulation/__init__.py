"""Simulation of a scene: `simulate()` for an open loop, `Plant` for drive samples block by block, energy balance.

This package does not depend on the engine's time steps or on sensors. Start with `simulate`.
"""
