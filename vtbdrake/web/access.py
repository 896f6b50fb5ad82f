"""Who may use a server on this machine: the token of its address, the Host and the Origin of each request."""

from __future__ import annotations

import secrets
from collections.abc import Collection
from urllib.parse import parse_qs, urlsplit

from starlette.requests import cookie_parser
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Receive, Scope, Send

_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


class Access:
    """An ASGI application that passes on the requests of those who know the token.

    The token comes once, in the address that is printed, and is exchanged for a cookie that scripts cannot read.
    Browsers send cookies of this machine to all its ports, so the cookie is named after the port. A page of another
    origin can make a browser send requests, but neither choose their Host nor hide its Origin.

    A frame in a notebook gets no such cookie: its site is that of a proxy or of VS Code. Its address begins with the
    token instead, ``/TOKEN/``, and so do those of all that it loads. A page that does not know the token cannot make a
    browser send it, so that Host and Origin, which are those of the proxy there, do not matter.

    Args:
        app: The application.
        port: The port of the server.
        hosts: Host names (with port) under which it is reached, beside those of the loopback interface.

    Attributes:
        token: The token.
    """

    def __init__(self, app: ASGIApp, *, port: int, hosts: Collection[str] = ()) -> None:
        self.token = secrets.token_urlsafe(16)
        self._app = app
        self._cookie = f"vtbdrake-{port}"
        self._hosts = {f"{name}:{port}" for name in _LOOPBACK} | set(hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if self._is_token(scope["path"].split("/", 2)[1:2]) and scope["path"].count("/") > 1:
            await self._app({**scope, "root_path": f"{scope.get('root_path', '')}/{self.token}"}, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        query = parse_qs(scope["query_string"].decode("latin-1"))
        reason = self._refusal(headers, query)
        if reason and scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": reason})  # becomes a 403
        elif reason:
            await PlainTextResponse(f"{reason}\n", status_code=403)(scope, receive, send)
        elif scope["type"] == "http" and "token" in query and scope["path"] in ("", "/"):
            response = RedirectResponse("./", status_code=303)
            secure = scope["scheme"] == "https"
            response.set_cookie(self._cookie, self.token, secure=secure, httponly=True, samesite="strict")
            await response(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    def _refusal(self, headers: dict[str, str], query: dict[str, list[str]]) -> str:
        """Return why a request is refused; empty if it is not."""
        host = headers.get("host", "")
        if host not in self._hosts:
            return f"this server is not reached as {host!r}: open the address that it has printed"
        origin = headers.get("origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return f"pages of {origin} may not use this server"
        tokens = [*query.get("token", []), cookie_parser(headers.get("cookie", "")).get(self._cookie, "")]
        if not self._is_token(tokens):
            return "the token is missing or wrong: open the address that the server has printed, with its token"
        return ""

    def _is_token(self, texts: Collection[str]) -> bool:
        """Return whether one of some texts is the token."""
        return any(secrets.compare_digest(text.encode(), self.token.encode()) for text in texts)
