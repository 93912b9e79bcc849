"""How the rig is drawn: geometry, shapes, palette, and the picture of it at a moment.

This room does not depend on recordings and viewers. Start with `rig_view`.
"""
