"""Access to a web page, only for browsers with a token; the number of connections is limited.

The address of the first request contains the token; later requests contain it in a cookie. Browsers send the cookie to
all ports of a host. Requests of pages from other origins are therefore rejected.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

if TYPE_CHECKING:
    import asyncio


#: Maximum number of connections; one open page needs about six.
MAX_CONNECTIONS = 100
# Longest time [s] from a connection to the end of the headers of its first request; slow clients must not use up the
# connections.
_MAX_REQUEST_S = 5.0

FORBIDDEN_TEXT = "Forbidden: open the address that `daq bench` printed, with its token."


class TokenGate:
    """An ASGI application that passes requests with the token on to another application, and rejects all others.

    The token also protects a page on the loopback address, to which any page in the same browser can send requests.
    `host` is the name or address at which the page is served. `cookie` is the name of the cookie, which differs among
    the benches of a host.
    """

    def __init__(self, application: ASGIApp, host: str, cookie: str) -> None:
        self._application, self._cookie = application, cookie
        self._host_names = {"localhost", host.lower()}
        self._own_label = _first_label(socket.gethostname().lower())
        self.token = secrets.token_urlsafe(24)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or reject it."""
        if scope["type"] not in ("http", "websocket"):
            await self._application(scope, receive, send)
            return
        request = HTTPConnection(scope)

        async def with_cookie(message: Message) -> None:
            if message["type"] == "http.response.start":
                cookie = f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Strict"
                message["headers"] = [*message.get("headers", []), (b"set-cookie", cookie.encode())]
            await send(message)

        is_own = self._is_own(request.headers)
        if is_own and self._is_valid(request.query_params.get("token", "")):
            await self._application(scope, receive, with_cookie)
        elif is_own and self._is_valid(request.cookies.get(self._cookie, "")):
            await self._application(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await PlainTextResponse(FORBIDDEN_TEXT, 403, {"connection": "close"})(scope, receive, send)

    def _is_own(self, headers: Headers) -> bool:
        """Return whether a request names this host, and is not from a page of another origin."""
        host = headers.get("host", "")
        try:
            name = urlsplit(f"//{host}").hostname or ""
            origin = urlsplit(headers.get("origin", f"//{host}")).netloc
        except ValueError:
            return False
        is_other_page = headers.get("sec-fetch-site") in ("same-site", "cross-site")
        return (
            (name in self._host_names or _first_label(name) == self._own_label or _is_address(name))
            and origin == host
            # A link on another page may open this page, but not inside a frame.
            and (not is_other_page or headers.get("sec-fetch-dest") == "document")
        )

    def _is_valid(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())


def _first_label(name: str) -> str:
    """Return the name of a host without its domain."""
    return name.partition(".")[0]


def _is_address(name: str) -> bool:
    """Return whether a host is an IP address, which no other site can have as its name (DNS rebinding)."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class LimitedConnection(H11Protocol):
    """A connection of `uvicorn` that ends if there are too many, or if no request arrives soon."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin the connection."""
        super().connection_made(transport)
        if len(self.connections) > MAX_CONNECTIONS:
            transport.abort()
        else:
            self.loop.call_later(_MAX_REQUEST_S, self._end_without_request)

    def _end_without_request(self) -> None:
        # A web socket has a different protocol.
        if self.cycle is None and self.transport.get_protocol() is self:
            self.transport.abort()
