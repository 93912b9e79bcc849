"""Damper motion, estimated from the channels alone: impacts, type of motion, energy dissipated.

Start with `performance`; `impact_detection` finds impacts in a channel.
"""
