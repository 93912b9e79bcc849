"""From a scene to matrices, and to the hybrid linear system that the engine runs, with its open-loop drive.

Nothing here steps through time. Start with `structure` for M, C, K, then `assembly`, which returns a `HybridSystem`.
"""
