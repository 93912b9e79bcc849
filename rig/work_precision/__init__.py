"""Error against computing time for every way to compute a scene, ours and others': `rig cost`.

The rest of the product never imports these peers and references. Start with `motion_study`; `high_precision` is the
reference of forty digits that all are held against.
"""
