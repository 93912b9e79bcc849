"""The scene file: its settings, their checks, YAML in and out, and the bundled scenes.

A scene describes what is on the bench. This package computes neither matrices nor motion. Start with `scene`, the
root of all settings; `loading` reads a file, and `consistency` checks the parts of a scene against each other.
"""
