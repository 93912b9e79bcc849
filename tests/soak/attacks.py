"""Attacks on the page and on the server of `daq bench`: afterwards both must serve their own user as before."""

import logging
import random
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import urlsplit

import grpc
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect

from daq.extras.ni_server.served_instrument import Limits
from tests.soak.command import CommandResult
from tests.soak.servers import PATIENCE_S, Server

# Broken connections are intended.
logging.getLogger("websockets").setLevel(logging.CRITICAL)

# Largest part of an attack, and number of connections of a flood; the servers admit fewer.
_FLOOD_BYTES = 200 << 20
_FLOOD_CONNECTIONS = 300
# Time during which a slow attack holds its connections.
_HOLD_S = 8.0
# Growth of memory by an attack that is not limited by the server: some of the largest requests at a time.
_MAX_GROWTH_BYTES = 256 << 20
_TASK_METHOD = "/nidaqmx_grpc.NiDAQmx/CreateTask"


@dataclass(frozen=True)
class Target:
    """A running bench."""

    page: str  # address with the token
    device: str  # address of the device
    rng: random.Random

    @property
    def host(self) -> str:
        """Host and port of the page."""
        return urlsplit(self.page).netloc

    @property
    def endpoints(self) -> tuple[tuple[str, int], ...]:
        """Addresses of page and device."""
        return tuple((name, int(port)) for name, _, port in (a.partition(":") for a in (self.host, self.device)))

    def send(self, endpoint: int, *parts: bytes, repeats: int = 1) -> bytes:
        """Send bytes to page (0) or device (1) until the connection ends; return the first bytes of the answer."""
        with socket.create_connection(self.endpoints[endpoint], timeout=_HOLD_S) as connection, suppress(OSError):
            with suppress(OSError):
                connection.sendall(parts[0])
                for _ in range(repeats):
                    connection.sendall(parts[-1])
            return connection.recv(1 << 12)
        return b""

    def request(self, path: str, **headers: str) -> int:
        """Return the status of a request to the page."""
        request = urllib.request.Request(f"http://{self.host}{path}", headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
                return int(answer.status)
        except urllib.error.HTTPError as error:
            return error.code

    def live(self, query: str | None = None, **options: object) -> ClientConnection:
        """Open the web socket of the page, with its token unless `query` is given."""
        query = urlsplit(self.page).query if query is None else query
        return connect(f"ws://{self.host}/live?{query}", open_timeout=PATIENCE_S, **options)  # type: ignore[arg-type]


def _rejected(status: int) -> list[str]:
    return [] if status == 403 else [f"status {status}"]


def _socket_rejected(target: Target, query: str | None, **headers: str) -> list[str]:
    try:
        target.live(query, additional_headers=headers).close()
    except WebSocketException:
        return []
    return ["web socket opened"]


def _many_headers(target: Target) -> list[str]:
    target.send(0, b"GET / HTTP/1.1\r\n", b"X-Flood: 1\r\n" * 10_000, repeats=_FLOOD_BYTES // 120_000)
    return []


def _long_header(target: Target) -> list[str]:
    target.send(0, b"GET / HTTP/1.1\r\nX: ", b"x" * (1 << 20), repeats=_FLOOD_BYTES >> 20)
    return []


def _idle_connections(target: Target, start: bytes = b"", endpoint: int = 0) -> list[str]:
    with ExitStack() as stack, suppress(OSError):
        for _ in range(_FLOOD_CONNECTIONS):
            connection = stack.enter_context(socket.create_connection(target.endpoints[endpoint], timeout=5.0))
            with suppress(OSError):
                connection.sendall(start)
        time.sleep(_HOLD_S)
    return []


def _slow_headers(target: Target) -> list[str]:
    return _idle_connections(target, b"GET / HTTP/1.1\r\nHost: ")


def _slow_body(target: Target) -> list[str]:
    return _idle_connections(target, b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 1000000000\r\n\r\nx")


def _endless_body(target: Target) -> list[str]:
    start = f"POST / HTTP/1.1\r\nHost: {target.host}\r\nContent-Length: 99999999999\r\n\r\n".encode()
    target.send(0, start, bytes(1 << 20), repeats=_FLOOD_BYTES >> 20)
    return []


def _wrong_host(target: Target) -> list[str]:
    return _rejected(target.request(f"/?{urlsplit(target.page).query}", Host="attacker.example"))


def _wrong_origin(target: Target) -> list[str]:
    return _rejected(target.request(f"/?{urlsplit(target.page).query}", Origin="http://127.0.0.1:1"))


def _guessed_tokens(target: Target) -> list[str]:
    guesses = ("", "%00", "a" * 4000, urlsplit(target.page).query[6:-1])
    return [fault for guess in guesses for fault in _rejected(target.request(f"/?token={guess}"))]


def _other_paths(target: Target) -> list[str]:
    query = urlsplit(target.page).query
    paths = ("/docs", "/browser/../bench.py", "/browser/%2e%2e/bench.py", "/browser//etc/passwd", f"/report/{10**40}")
    statuses = {path: target.request(f"{path}?{query}") for path in paths}
    return [f"{path}: {status}" for path, status in statuses.items() if status not in (403, 404)]


def _malformed_requests(target: Target) -> list[str]:
    for _ in range(200):
        target.send(target.rng.randrange(2), target.rng.randbytes(target.rng.randrange(1, 2000)) + b"\r\n\r\n")
    return []


def _socket_without_token(target: Target) -> list[str]:
    return _socket_rejected(target, "")


def _socket_of_other_site(target: Target) -> list[str]:
    return _socket_rejected(target, None, Origin="http://attacker.example")


def _oversize_frame(target: Target) -> list[str]:
    with suppress(WebSocketException, OSError), target.live(max_size=None) as live:
        live.send("[" + "1," * (40 << 20) + "1]")
        while live.recv(timeout=PATIENCE_S):
            pass
    return []


def _malformed_messages(target: Target) -> list[str]:
    values = (None, True, -1, 1e308, float("nan"), "x" * 1000, [], {}, [1, 2], [10**400, 1], "\0")
    names = ("start", "stop", "record", "span", "clear", "accept", "theory", "level", "frequency", "kind", "", None)
    messages = [b"\xff", "", "{}", "[", "[" * 5000, *(f'["{name}", NaN]' for name in names)]
    messages += [repr([name, value]).replace("'", '"') for name in names for value in values]
    for text in target.rng.sample(messages, 60):
        with suppress(WebSocketException, OSError, TimeoutError), target.live(max_size=None) as live:
            live.send(text)
            live.recv(timeout=1.0)
    with target.live() as live:
        live.send('["stop", null]')
    return []


def _deaf_browsers(target: Target) -> list[str]:
    with ExitStack() as stack:
        for _ in range(20):
            stack.enter_context(target.live(max_queue=1, close_timeout=0.1))
        time.sleep(_HOLD_S)
    return []


def _idle_clients(target: Target) -> list[str]:
    return _idle_connections(target, endpoint=1)


def _endless_client(target: Target) -> list[str]:
    # A frame of HTTP/2 with a body that never ends.
    start = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])
    target.send(1, start, bytes(1 << 20), repeats=_FLOOD_BYTES >> 20)
    return []


def _many_settings(target: Target) -> list[str]:
    ping = bytes([0, 0, 8, 6, 0, 0, 0, 0, 0]) + bytes(8)
    target.send(1, b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0]), ping * 1000, repeats=1000)
    return []


def _malformed_protobuf(target: Target) -> list[str]:
    with grpc.insecure_channel(target.device) as channel:
        call = channel.unary_unary(_TASK_METHOD)
        for _ in range(200):
            with suppress(grpc.RpcError):
                call(target.rng.randbytes(target.rng.randrange(1, 3000)), timeout=PATIENCE_S)
    return []


def _oversize_message(target: Target) -> list[str]:
    with grpc.insecure_channel(target.device, options=[("grpc.max_send_message_length", -1)]) as channel:
        call, largest = channel.unary_unary(_TASK_METHOD), Limits().max_request_bytes
        for _ in range(10):
            with suppress(grpc.RpcError):
                call(bytes(largest - 100), timeout=PATIENCE_S)
        try:
            call(bytes(largest + 1), timeout=PATIENCE_S)
        except grpc.RpcError as error:
            return [] if error.code() is grpc.StatusCode.RESOURCE_EXHAUSTED else [f"message ended in {error.code()}"]
    return ["message accepted"]


ATTACKS: tuple[Callable[[Target], list[str]], ...] = (
    _many_headers, _long_header, _idle_connections, _slow_headers, _slow_body, _endless_body, _wrong_host,
    _wrong_origin, _guessed_tokens, _other_paths, _malformed_requests, _socket_without_token, _socket_of_other_site,
    _oversize_frame, _malformed_messages, _deaf_browsers, _idle_clients, _endless_client, _many_settings,
    _malformed_protobuf, _oversize_message,
)  # fmt: skip


def attack(scene: Path, folder: Path, rng: random.Random) -> tuple[CommandResult, list[str]]:
    """Attack a bench once; its page and its device must answer, and it must end as usual with little memory."""
    chosen = ATTACKS[rng.randrange(len(ATTACKS))]
    bench = Server(["daq", "bench", str(scene), "--no-browser", "--port", "0", "--device-port", "0"], folder)
    faults, before = [], bench.peak_memory()
    if bench.device:
        target = Target(bench.page, bench.device, rng)
        faults = chosen(target) + _unusable(target)
    faults += ["memory grows"] if bench.peak_memory() - before > _MAX_GROWTH_BYTES else []
    result, end_faults = bench.end()
    command = (*result.command, f"({chosen.__name__[1:]})")
    return replace(result, command=command), [f"{chosen.__name__[1:]}: {fault}" for fault in faults + end_faults]


def _unusable(target: Target) -> list[str]:
    """Return what the user of the bench can no longer do."""
    faults = []
    try:
        if target.request(target.page.partition(target.host)[2]) != 200:
            faults.append("page rejected")
        with target.live(max_size=None) as live:
            for _ in range(3):
                live.recv(timeout=PATIENCE_S)
    except (OSError, WebSocketException) as error:
        faults.append(f"page lost ({type(error).__name__})")
    with grpc.insecure_channel(target.device) as channel:
        try:
            channel.unary_unary(_TASK_METHOD)(b"", timeout=PATIENCE_S)
        except grpc.RpcError as error:
            faults.append(f"device lost ({error.code().name})")  # type: ignore[attr-defined]
    return faults
