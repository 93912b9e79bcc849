"""Connections to a server: gRPC calls them channels."""

from __future__ import annotations

import grpc


def open_channel(address: str) -> grpc.Channel:
    """Open a connection of this process to a server, for messages of any size."""
    return grpc.insecure_channel(
        address,
        options=[
            ("grpc.max_receive_message_length", -1),
            ("grpc.max_send_message_length", -1),
            ("grpc.use_local_subchannel_pool", 1),
        ],
    )
