"""MCAP chunks in and out, whole or damaged; nothing about vibration.

Start with `writer` and `reader`; `chunk` unpacks chunks, `damaged_file` reads the intact parts of a torn file.
"""
