"""The scene file: settings with units, their checks, YAML in and out, and the bundled scenes and data sheets.

A scene says what is on the bench; nothing here knows matrices or motion. Start with `scene`, the root of all settings;
`loading` reads a file, `consistency` holds the checks between parts of a scene.
"""
