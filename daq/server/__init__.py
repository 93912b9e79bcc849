"""The device on the network: NI's gRPC device protocol on top of the instrument; nothing of the physics in it."""
