"""A run of a scene: `simulate()` open loop, `Plant` block by block under drive samples, and the energy ledger.

Nothing here knows how the engine steps, or what a sensor does to the motion. Start with `simulate`.
"""
