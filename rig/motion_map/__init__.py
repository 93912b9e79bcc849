"""Type of motion and computing time over two parameters: `rig map`.

Start with `motion_map`; `grid` says which points, `figure` draws them.
"""
