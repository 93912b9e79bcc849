"""The device: chassis, clock, acquisition, generation, triggers, buffers.

It knows no client. Start with `chassis`.
"""
