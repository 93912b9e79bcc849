"""Data sheets of sensors, shakers and converter modules, by name; the files are in `presets/`.

Data sheets contain values, but no settings of a scene: `rig.core.scene.presets` completes settings with these values.
Start with `data_sheets`; `modules` describes what a converter module accepts from a client program.
"""
