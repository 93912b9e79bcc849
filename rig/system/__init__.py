"""From a scene to matrices, and to the hybrid linear system that the engine runs, with its open-loop drive.

Nothing here steps through time. Start with `structural_model` for M, C, K and modes, then `assembly`, which returns a
`HybridSystem`.
"""
