"""Damper motion, estimated from the channels alone: impacts, type of motion, dissipated energy.

Start with `dampers`; `impact_detection` detects impacts in a channel.
"""
