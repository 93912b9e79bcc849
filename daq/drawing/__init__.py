"""The drawing of the rig: geometry, shapes, palette, and poses.

This package does not depend on recordings and viewers. Start with `rig_view`.
"""
