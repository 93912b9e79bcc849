"""A hybrid linear system becomes a trajectory: exact flow between contacts, guards, impacts, the compiled kernel.

The engine knows no scene and no channel. Start with `propagator`, the system on its way through time; `flow_tables`
holds the exact flow of each configuration, `guards` finds the first contact of a step, `contact` decides what happens
at it.
"""
