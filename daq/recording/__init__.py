"""Recordings: their layout in an MCAP file, writing, reading, recovering.

The format is described in `LAYOUT.md` here. Nothing here knows how samples came about. Start with `recorder` and
`recording`; `sample_block` encodes samples, `markers` what happened meanwhile, and `recovery` mends a torn file.
"""
