"""Propagates a hybrid linear system in time: exact flow between contacts, guards, impacts, the compiled kernel.

The engine does not depend on scenes or channels. Start with `propagator`, which integrates a system over time.
`flow_tables` contains the exact flow of each configuration, `guards` finds the first contact of a step, and `contact`
applies the contact laws.
"""
