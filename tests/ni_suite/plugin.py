"""Pytest plugin that lets NI's tests find this project's server in place of NI's."""

from __future__ import annotations

import os
from typing import Any


def pytest_configure(config: Any) -> None:
    """Let the fixture that starts NI's server start ours."""
    from tests import _grpc_utils  # NI's package `tests`

    _grpc_utils.GrpcServerProcess._get_grpc_server_exe = lambda self: os.environ["NI_SUITE_SERVER"]
