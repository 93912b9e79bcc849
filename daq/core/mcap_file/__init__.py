"""MCAP files (https://mcap.dev), the container of a recording: records, chunks and summary.

The package does not depend on the content of a recording. Start with `writer` and `reader`; `chunk` unpacks chunks,
`damaged_file` reads the intact parts of a damaged file.
"""
