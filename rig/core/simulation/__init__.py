"""A run of a scene: `simulate()` open loop, `Plant` block by block under drive samples, and the energy balance.

This package does not depend on the engine's time steps or on sensors. Start with `simulate`.
"""
