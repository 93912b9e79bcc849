"""Free decays: envelope of a channel, and damping ratio against amplitude for each mode.

Start with `free_decay`; `modal_decay` separates and analyzes the modes.
"""
