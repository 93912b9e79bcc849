"""Restrict a web page to browsers with a token.

The address of the first request contains the token; later requests contain it in a cookie.
"""

from __future__ import annotations

import hmac
import secrets
from typing import TYPE_CHECKING

from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

FORBIDDEN_TEXT = "Forbidden: open the address that `daq bench` printed, with its token."


class TokenGate:
    """An ASGI application that passes requests with the token on to another application, and rejects all others.

    The token also protects a page on the loopback address, to which any page in the same browser can send requests.
    `cookie` is the name of the cookie, which differs among the benches of a host.
    """

    def __init__(self, application: ASGIApp, cookie: str) -> None:
        self._application, self._cookie = application, cookie
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

        if self._is_valid(request.query_params.get("token", "")):
            await self._application(scope, receive, with_cookie)
        elif self._is_valid(request.cookies.get(self._cookie, "")):
            await self._application(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            await PlainTextResponse(FORBIDDEN_TEXT, 403)(scope, receive, send)

    def _is_valid(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(), self.token.encode())
