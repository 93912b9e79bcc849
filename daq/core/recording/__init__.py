"""Recordings: their layout in an MCAP file, writing, reading, recovering.

The format is described in `LAYOUT.md` here. The package does not depend on the source of the samples. Start with
`recorder` and `recording`; `sample_block` encodes samples, `markers` the events of a test, and `recovery` repairs an
incomplete file.
"""
