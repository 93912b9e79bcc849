"""Settings with units: what all keys of a scene have in common. This package knows no key of a scene.

Start with `settings`, the base class; `quantities` converts text with a unit to SI, and `quantity_field` is the field
type for it; `problems` holds what is reported about invalid settings.
"""
