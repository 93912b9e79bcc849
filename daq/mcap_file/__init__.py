"""MCAP chunks in and out, whole or damaged; nothing about vibration.

Start with `writer` and `reader`; `damaged_file` reads what a torn file still holds.
"""
