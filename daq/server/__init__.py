"""The device on the network: NI's gRPC device protocol for the instrument.

Start with `service`, which receives calls; `protocol` decodes requests and encodes responses, `calls` executes them.
"""
