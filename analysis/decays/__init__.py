"""Free decays: envelopes, and damping ratio against amplitude, of a channel and of each mode in it.

Start with `free_decay`; `modal_decay` takes modes apart.
"""
