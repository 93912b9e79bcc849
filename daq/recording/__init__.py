"""Recordings: their layout in an MCAP file, writing, reading, recovering.

The format is described in `LAYOUT.md` here. Nothing here knows how samples came about. Start with `layout`, then
`recorder` and `recording`.
"""
