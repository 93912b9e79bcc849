"""Connects scripts without gRPC options to the rig, through changed defaults of NI's client.

Only public names of the client are changed: its classes with a parameter `grpc_options` receive default options, and
`System.local` returns `System.remote`. The change takes effect when a script imports the client, in the process of
the script and in its child processes, by fork and by spawn.
"""

from __future__ import annotations

import builtins
import functools
import importlib.util
import os
import sys
import time
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

SERVER, FAST, LIMITED = "SHOTRIG_SERVER", "SHOTRIG_FAST", "SHOTRIG_LIMITED"
# Key of clients without sessions: a duplicate name is then an error of the driver.
STRICT = "shotrig: no sessions"
_channels: dict[int, Any] = {}


def prepare() -> None:
    """Prepare the import of the client, and let bench time pass while the script sleeps."""
    sys.meta_path.insert(0, _ClientFinder())
    if os.environ.get(FAST):
        time.sleep = functools.partial(_ask, "Pass")
    if os.environ.get(FAST) or os.environ.get(LIMITED):
        builtins.input = _wait_for_enter
    if os.environ.get(LIMITED):
        show = sys.excepthook
        sys.excepthook = lambda kind, *rest: None if kind is KeyboardInterrupt else show(kind, *rest)


class _ClientFinder:
    """Finds the package of the client, and changes its defaults after the import."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != "nidaqmx":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        loader: Any = spec and spec.loader
        if loader is not None:
            execute = loader.exec_module

            def exec_module(module: ModuleType) -> None:
                execute(module)
                install()

            loader.exec_module = exec_module
        return spec


def install() -> None:
    """Set the rig as the default connection of the client's classes."""
    import nidaqmx
    from nidaqmx import system
    from nidaqmx.system import storage

    owners = [(nidaqmx, "Task"), (nidaqmx, "Scale"), (system, "Device"), (system, "PhysicalChannel")]
    owners += [(storage, name) for name in ("PersistedTask", "PersistedChannel", "PersistedScale")]
    for module, name in owners:
        owner = getattr(module, name, None)
        if owner is not None:
            owner.__init__ = _with_options(owner.__init__)
    kinds = ("lin", "map", "polynomial", "table")
    for name in ("calculate_reverse_poly_coeff", *(f"create_{kind}_scale" for kind in kinds)):
        function = getattr(nidaqmx.Scale, name, None)
        if function is not None:
            setattr(nidaqmx.Scale, name, staticmethod(_with_options(function)))
    remote = system.System.remote
    system.System.local = staticmethod(lambda: remote(_options()))


def _with_options(make: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(make)
    def call(*positional: Any, **named: Any) -> Any:
        if named.get("grpc_options") is None:
            named["grpc_options"] = _options()
        return make(*positional, **named)

    return call


def _options() -> Any:
    """Return session options for this process; a duplicate name is an error, as without a network."""
    from nidaqmx import GrpcSessionOptions

    return GrpcSessionOptions(_channel(), "", api_key=STRICT)


def _channel() -> Any:
    """Return the connection of this process: a connection opened before a fork belongs to the parent process."""
    if os.getpid() not in _channels:
        _channels[os.getpid()] = open_channel(os.environ[SERVER])
    return _channels[os.getpid()]


def open_channel(address: str) -> Any:
    """Open a connection of this process to a server, for messages of any size."""
    import grpc

    return grpc.insecure_channel(
        address,
        options=[
            ("grpc.max_receive_message_length", -1),
            ("grpc.max_send_message_length", -1),
            ("grpc.use_local_subchannel_pool", 1),
        ],
    )


def _ask(call: str, seconds: float = 0.0) -> None:
    _channel().unary_unary(f"/shotrig.Bench/{call}")(repr(float(seconds)).encode())


def _wait_for_enter(text: object = "", /) -> str:
    print(text, end="", flush=True)
    _ask("Prompt")
    return ""
