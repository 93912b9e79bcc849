"""Access to the bench page requires the token of its address, or the cookie that the page sets."""

import asyncio
import contextlib
import socket
import threading

import pytest

uvicorn = pytest.importorskip("uvicorn", reason="the extra 'bench' is not installed")

from daq.extras.bench_page.access import MAX_CONNECTIONS, LimitedConnection, TokenGate  # noqa: E402

HOST = "127.0.0.1:8031"


async def page(scope, receive, send):
    """Answer every request, as the page does once the gate lets a request pass."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"page"})


def answer(gate, query="", cookie="", kind="http", **headers):
    """Return the messages that the gate sends in answer to a request."""
    messages = []

    async def receive():
        return {"type": f"{kind}.connect"}

    async def send(message):
        messages.append(message)

    headers = {"host": HOST} | headers | ({"cookie": cookie} if cookie else {})
    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    asyncio.run(gate({"type": kind, "query_string": query.encode(), "headers": raw}, receive, send))
    return messages


@pytest.fixture
def gate():
    return TokenGate(page, "127.0.0.1", "bench")


def test_token_in_the_address_sets_a_cookie(gate):
    first = answer(gate, f"token={gate.token}")[0]
    assert first["status"] == 200
    cookie = dict(first["headers"])[b"set-cookie"].decode()
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert answer(gate, cookie=cookie.partition(";")[0])[0]["status"] == 200


@pytest.mark.parametrize("query", ["", "token=", "token=guess"])
def test_request_without_token_is_rejected(gate, query):
    first, second = answer(gate, query, cookie="bench=guess")
    assert first["status"] == 403
    assert b"token" in second["body"]


def test_web_socket_needs_the_cookie(gate):
    assert answer(gate, kind="websocket")[0]["type"] == "websocket.close"
    assert answer(gate, cookie=f"bench={gate.token}", kind="websocket")[0]["type"] == "websocket.accept"


def test_each_bench_has_another_token(gate):
    assert TokenGate(page, "127.0.0.1", "bench").token != gate.token


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://127.0.0.1:9000"},
        {"origin": "http://attacker.example"},
        {"origin": "null"},
        {"host": "attacker.example:8031"},
        {"host": "[malformed"},
        {"host": ""},
        {"sec_fetch_site": "same-site", "sec_fetch_dest": "iframe"},
        {"sec_fetch_site": "cross-site", "sec_fetch_dest": "script"},
    ],
)
def test_request_of_another_origin_is_rejected(gate, kind, headers):
    for query, cookie in (("", f"bench={gate.token}"), (f"token={gate.token}", "")):
        first = answer(gate, query, cookie, kind, **headers)[0]
        assert first.get("status") == 403 or first["type"] == "websocket.close"


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": f"http://{HOST}", "sec_fetch_site": "same-origin"},
        {"sec_fetch_site": "cross-site", "sec_fetch_dest": "document"},
        {"host": "localhost:8031", "origin": "http://localhost:8031"},
        {"host": "[::1]:8031"},
        {"host": "192.168.1.4"},
        {"host": f"{socket.gethostname().partition('.')[0]}.lab.example:8031"},
    ],
)
def test_request_of_the_page_is_accepted(gate, headers):
    assert answer(gate, cookie=f"bench={gate.token}", **headers)[0]["status"] == 200


@pytest.fixture
def served_gate(gate):
    """The gate on a web server: function that connects, and the gate."""
    listener = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(gate, http=LimitedConnection, backlog=MAX_CONNECTIONS, log_level="critical")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    with contextlib.ExitStack() as connections:

        def connect():
            return connections.enter_context(socket.create_connection(listener.getsockname(), timeout=60.0))

        yield connect
        server.should_exit = True
        thread.join()


def test_headers_are_limited(served_gate):
    connection = served_gate()
    with contextlib.suppress(OSError):
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" + b"X: y\r\n" * 100_000)
    with contextlib.suppress(ConnectionError):
        assert connection.recv(100).startswith((b"HTTP/1.1 4", b""))
        while connection.recv(1 << 16):
            pass


def test_connections_are_limited(served_gate):
    connections = [served_gate() for _ in range(MAX_CONNECTIONS + 20)]
    with contextlib.suppress(ConnectionResetError):
        assert connections[-1].recv(1) == b""
    request = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    connections[0].sendall(request)
    assert b"403" in connections[0].makefile("rb").readline()


def test_idle_connection_is_closed(served_gate, monkeypatch):
    monkeypatch.setattr("daq.extras.bench_page.access._MAX_REQUEST_S", 0.0)
    connection = served_gate()
    with contextlib.suppress(ConnectionResetError):
        assert connection.recv(1) == b""
