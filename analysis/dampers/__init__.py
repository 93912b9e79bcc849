"""What the dampers did, told from channels alone: impacts, type of motion, energy taken out.

Start with `performance`; `impact_detection` finds impacts in a channel.
"""
