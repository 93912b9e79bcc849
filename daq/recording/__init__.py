"""Recordings: their layout in an MCAP file, writing, reading, recovering.

The format is described in `LAYOUT.md` here. This room does not depend on the source of samples. Start with `recorder`
and `recording`; `sample_block` encodes samples, `markers` the events of a test, and `recovery` repairs a torn file.
"""
