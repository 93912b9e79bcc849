"""Access to the bench page requires the token of its address, or the cookie that the page sets."""

from __future__ import annotations

import asyncio

import pytest

from daq.bench_page.access import TokenGate


async def page(scope, receive, send):
    """Answer every request, as the page does once the gate lets a request pass."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"page"})


def answer(gate, query="", cookie="", kind="http"):
    """Return the messages that the gate sends in answer to a request."""
    messages = []

    async def receive():
        return {"type": f"{kind}.connect"}

    async def send(message):
        messages.append(message)

    headers = [(b"cookie", cookie.encode())] if cookie else []
    asyncio.run(gate({"type": kind, "query_string": query.encode(), "headers": headers}, receive, send))
    return messages


@pytest.fixture
def gate():
    return TokenGate(page, "bench")


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
    assert TokenGate(page, "bench").token != gate.token
