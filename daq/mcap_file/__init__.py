"""MCAP chunks in and out, whole or damaged; nothing about vibration.

Start with `writer` and `reader`; `chunk` checks what a chunk says of itself, `damaged_file` reads what
a torn file still holds.
"""
