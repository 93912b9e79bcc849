"""Pytest plugin: NI's tests start this project's server instead of NI's server."""

import os
from typing import Any


def pytest_configure(config: Any) -> None:
    """Replace the path of the server program in NI's fixture."""
    # This is NI's package `tests`.
    from tests import _grpc_utils

    _grpc_utils.GrpcServerProcess._get_grpc_server_exe = lambda self: os.environ["NI_SUITE_SERVER"]
