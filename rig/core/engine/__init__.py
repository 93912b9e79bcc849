"""Propagates a hybrid linear system in time: exact flow between contacts, guards, impacts, the compiled kernel.

The engine does not depend on scenes or channels. Start with `propagator`, which integrates a system over time.
`flow_tables` contains the exact flow of each configuration, `law_tables` the laws of the elements, `guards` locates the
first event of a step, and `resets` applies it. No module of this folder depends on the kinds of elements.
"""
