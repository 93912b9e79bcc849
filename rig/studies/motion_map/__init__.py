"""Map of type of motion and settling time over two parameters: `rig map`.

Start with `motion_map`; `grid` selects the points.
"""
