"""How the rig is drawn: geometry, shapes, palette, and the picture of it at a moment.

Nothing here knows recordings or viewers. Start with `rig_view`.
"""
