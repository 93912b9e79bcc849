"""Settings with units: the common behavior of all keys of a scene. No key of a scene is defined here.

Start with `settings`, the base class; `quantities` converts text with a unit to SI, and `quantity_field` is the field
type for it; `problems` contains the messages about invalid settings.
"""
