"""Type of motion and periods to compute it over two parameters: `rig map`.

Start with `motion_map`; `grid` says which points, `figure` draws them.
"""
