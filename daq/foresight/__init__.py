"""Foresight: what a test will do to sensors, converter, amplifier and dampers, stated before it is recorded.

The linear response of the scene says where a long test is largest; a rehearsal of those parts, without a recording,
says how large. Nothing here writes a file. Start with `foresee`.
"""
