"""The drawing of the rig: geometry, shapes, palette, and motion.

This package does not depend on recordings and viewers. Start with `rig_view`.
"""
