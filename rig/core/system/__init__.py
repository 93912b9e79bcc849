"""The matrices of a scene, the hybrid linear system that the engine simulates, and its open-loop drive.

No module of this folder integrates over time. Start with `structural_model` for M, C, K and modes, then read
`assembly`, which returns a `HybridSystem`.
"""
