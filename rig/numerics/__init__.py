"""Mathematics that knows no rig: SIMD loops, fused sums, Bernstein polynomials, complementarity, continuation.

Nothing here may know what a scene, a body or a damper is. Start with `bernstein` for how a first contact is isolated,
and with `simd` for how a compiled loop is written.
"""
