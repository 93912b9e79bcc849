"""The device on the network: NI's gRPC device protocol on top of the instrument; nothing of the physics in it.

Start with `service`, where calls arrive; `protocol` says what goes in and out of them, `calls` does them.
"""
