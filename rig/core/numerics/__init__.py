"""Numerical methods: SIMD loops, fused sums, Bernstein polynomials, linear complementarity, continuation; compilation.

No module of this folder depends on scenes, bodies or dampers. Start with `bernstein` for the location of the first zero
of a function, and with `simd` for the form of a compiled loop.
"""
