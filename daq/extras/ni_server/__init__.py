"""Server of the emulated instrument for clients, by NI's gRPC device protocol.

Start with `service`, which receives calls; `protocol` decodes requests and encodes responses, `calls` executes them.
"""
