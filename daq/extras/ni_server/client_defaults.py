"""Connects scripts without gRPC options to the rig, by monkey-patching NI's client.

When Python starts, `prepare` patches public names: the client's classes with a parameter `grpc_options` receive default
options, and `System.local` returns `System.remote`. This also applies to child processes of the script, whether forked
or spawned.

With the fast clock, simulated time (*bench time*) advances only during calls to the server. `time.sleep` and `input`
are therefore replaced with such calls; Python has no other public way to do this.
"""

import builtins
import functools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, SupportsFloat, SupportsIndex

# Environment variables of the script's process.
SERVER = "SHOTRIG_SERVER"  # address of the server
FAST = "SHOTRIG_FAST"  # set if the clock is the fast clock
# Bench time for which a prompt waits [s].
_PROMPT_TIMEOUT_S = 10.0
# API key that disables session sharing: a duplicate task name is then an error, as in NI's driver.
STRICT = "shotrig: no sessions"
# Folder with the startup code of a script's process.
STARTUP = Path(__file__).resolve().parent / "startup"
# Connection (gRPC channel) of each process to each server, by process id and address.
_connections: dict[tuple[int, str], Any] = {}


def environment(address: str, follows_wall_clock: bool) -> dict[str, str]:
    """Return the environment of clients of a server at an address; `follows_wall_clock`: whether bench time does."""
    paths = [str(STARTUP), *filter(None, [os.environ.get("PYTHONPATH")])]
    # Forked child processes open new connections; grpc requires this environment variable before the fork.
    variables = {SERVER: address, "PYTHONPATH": os.pathsep.join(paths), "GRPC_ENABLE_FORK_SUPPORT": "1"}
    return variables if follows_wall_clock else {**variables, FAST: "1"}


def prepare() -> None:
    """Connect the client to the rig; with the fast clock, pauses and prompts of the script let bench time advance."""
    for owner, name, value in replacements():
        setattr(owner, name, value)
    if os.environ.get(FAST):
        time.sleep = _pass_bench_time
        builtins.input = _wait_for_enter


def replacements() -> Iterator[tuple[Any, str, Any]]:
    """Yield the public names of the client to replace, each as its owner, its name and its new value."""
    import nidaqmx
    from nidaqmx import Scale, system
    from nidaqmx.system import storage

    persisted = (storage.PersistedTask, storage.PersistedChannel, storage.PersistedScale)
    for owner in (nidaqmx.Task, Scale, system.Device, system.PhysicalChannel, *persisted):
        yield owner, "__init__", _with_options(owner.__init__)
    scale_types = ("lin", "map", "polynomial", "table")
    for name in ("calculate_reverse_poly_coeff", *(f"create_{scale_type}_scale" for scale_type in scale_types)):
        yield Scale, name, staticmethod(_with_options(getattr(Scale, name)))
    remote = system.System.remote
    yield system.System, "local", staticmethod(lambda: remote(_options()))


def _with_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function of the client with default session options."""

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        if keywords.get("grpc_options") is None:
            keywords["grpc_options"] = _options()
        return function(*arguments, **keywords)

    return call


def _options() -> Any:
    """Return session options of this process; a duplicate name of a task is an error, as with a local driver."""
    from nidaqmx import GrpcSessionOptions

    return GrpcSessionOptions(_connection(), "", api_key=STRICT)


def _connection() -> Any:
    """Return the connection of this process: a connection opened before a fork belongs to the parent process."""
    key = os.getpid(), os.environ[SERVER]
    if key not in _connections:
        _connections[key] = open_channel(key[1])
    return _connections[key]


def disconnect(address: str) -> None:
    """Close the connection of this process to a server."""
    connection = _connections.pop((os.getpid(), address), None)
    if connection is not None:
        connection.close()


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


def _pass_bench_time(seconds: SupportsFloat | SupportsIndex) -> None:
    """Let bench time advance; see `bench_time`."""
    _connection().unary_unary("/shotrig.Bench/Pass")(repr(float(seconds)).encode())


def _wait_for_enter(text: object = "", /) -> str:
    """Replace `input`: print the prompt, let bench time advance, and return an empty line."""
    print(text, end="", flush=True)
    _pass_bench_time(_PROMPT_TIMEOUT_S)
    return ""
