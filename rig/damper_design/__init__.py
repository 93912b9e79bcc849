"""Which dampers, where: mass, clearance and place that make the worst peak smallest; knows no sensor, no recording.

Start with `design`; `search` tries choices, `worst_peak` says how good one is.
"""
