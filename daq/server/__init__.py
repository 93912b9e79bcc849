"""The device on the network."""
