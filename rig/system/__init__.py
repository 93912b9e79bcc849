"""From a scene to its matrices and to the hybrid linear system that the engine simulates, with its open-loop drive.

No module of this folder integrates over time. Start with `structural_model` for M, C, K and modes, then read
`assembly`, which returns a `HybridSystem`.
"""
