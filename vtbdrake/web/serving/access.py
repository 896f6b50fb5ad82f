"""Who may use a server on this machine: tickets that are good once, and the sessions that they become."""

from __future__ import annotations

import os
import re
import secrets
from collections import OrderedDict
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

from starlette.requests import Request
from starlette.responses import HTMLResponse, PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vtbdrake.lcm.hub.tcpq import user_of
from vtbdrake.web.serving.web_page import check_host

_LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
_DEFAULT_PORTS = (":80", ":443")  # which browsers leave out
_ENTRANCE = Path(__file__).with_name("page")
_LONGEST_TICKET = 100  # bytes
_MOST_TICKETS = 1000  # that wait to be used; older ones are forgotten
_ORIGIN = re.compile(r"https?://[\w.\-]+(:\d+)?")
_WAY_IN = "open an address that vtbdrake has printed; each is good for one browser"


@dataclass(frozen=True)
class _Ticket:
    """What a ticket is good for.

    Attributes:
        own_user: Whether it is good for programs of this user (and root) alone.
        used: Called when it has become a session.
    """

    own_user: bool
    used: Callable[[], None]


class Access:
    """An ASGI application that passes on the requests of those who were let in.

    An address has a ticket behind ``#``, which browsers send to nobody: the page at ``/``, which is for everybody,
    posts it to the server. A ticket is good once, and becomes a session: a secret at the beginning of the path,
    ``/SESSION/``, of the page and of all that it loads. So a session belongs to the port. (Browsers send a cookie of
    this machine to all its ports, also to other users' ports.) A page of another origin, which can make a browser
    send requests and show frames, does not know the session; and it can neither choose the Host of its requests nor
    hide their Origin, which are checked, too.

    The page of a session may not be shown in a frame. That of `framed_session` may, in a notebook, whose front end
    tells its origins; it also comes through proxies, whose Host and Origin it has.

    Args:
        app: The application.
        port: The port of the server.
        hosts: Host names with port, ``name:port``, under which it is reached, beside the names of the loopback
            interface.

    Raises:
        ValueError: A host name has no port, or is an address to listen on.
    """

    def __init__(self, app: ASGIApp, *, port: int, hosts: Collection[str] = ()) -> None:
        for host in hosts:
            check_host(host)
        self._app = app
        names = {f"{name}:{port}" for name in _LOOPBACK} | set(hosts)
        self._hosts = names | {n.removesuffix(p) for n in names for p in _DEFAULT_PORTS if n.endswith(p)}
        self._tickets: OrderedDict[str, _Ticket] = OrderedDict()
        # Session -> whether it is shown in frames.
        self._sessions: dict[str, bool] = {}

    def ticket(self, *, own_user: bool = False, used: Callable[[], None] = lambda: None) -> str:
        """Return a new ticket.

        Args:
            own_user: Whether it is good for programs of this user (and root) alone: others can read it, too, for
                instance on the command line of a browser.
            used: Called once it has become a session, in the thread of the server.
        """
        ticket = secrets.token_urlsafe(16)
        self._tickets[ticket] = _Ticket(own_user, used)
        while len(self._tickets) > _MOST_TICKETS:
            self._tickets.popitem(last=False)
        return ticket

    def framed_session(self) -> str:
        """Return a new session whose page may be shown in a frame of a notebook."""
        return self._begin(framed=True)

    def _begin(self, *, framed: bool) -> str:
        session = secrets.token_urlsafe(16)
        self._sessions[session] = framed
        return session

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        session = self._session(scope["path"])
        framed = self._sessions.get(session, False)
        send = partial(_send_protected, send, _ancestors(scope) if framed else "'none'")
        if not framed and (reason := self._refusal(scope)):
            await _refuse(reason, scope, receive, send)
        elif session:
            await self._app({**scope, "root_path": f"{scope.get('root_path', '')}/{session}"}, receive, send)
        elif scope["type"] == "http" and (answer := self._entrance(scope)) is not None:
            await (await answer(Request(scope, receive)))(scope, receive, send)
        else:
            await _refuse(f"this address has no session of the server: {_WAY_IN}", scope, receive, send)

    def _session(self, path: str) -> str:
        """Return the session at the beginning of a path; empty if there is none."""
        if path.count("/") < 2:  # Without the second, relative addresses would miss the session.
            return ""
        first = path.split("/", 2)[1]
        return next((s for s in tuple(self._sessions) if secrets.compare_digest(s.encode(), first.encode())), "")

    def _refusal(self, scope: Scope) -> str:
        """Return the reason why a request is refused for its Host or Origin; empty if it is not."""
        headers = _headers(scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if host not in self._hosts:
            return f"this server is not reached as {host!r}: {_WAY_IN}"
        if origin is not None and urlsplit(origin).netloc != host:
            return f"pages of {origin} may not use this server"
        return ""

    def _entrance(self, scope: Scope) -> Callable[[Request], Any] | None:
        """Return the function that answers a request without a session; None if there is none."""
        answers: Mapping[tuple[str, str], Callable[[Request], Any]] = {
            ("GET", ""): _entrance_page,
            ("GET", "/"): _entrance_page,
            ("POST", "/enter"): self._enter,
        }
        return answers.get((scope["method"], scope["path"]))

    async def _enter(self, request: Request) -> Response:
        """Exchange a ticket for a session, which is answered as a relative address."""
        text = b""
        async for part in request.stream():
            text += part
            if len(text) > _LONGEST_TICKET:
                break
        ticket = next((t for t in tuple(self._tickets) if secrets.compare_digest(t.encode(), text)), "")
        if not ticket:
            return PlainTextResponse(f"this address is not valid, or was used already: {_WAY_IN}", status_code=403)
        granted = self._tickets[ticket]
        if granted.own_user and _user(request.scope) not in (0, os.geteuid()):
            return PlainTextResponse(f"this address is for a browser of another user: {_WAY_IN}", status_code=403)
        del self._tickets[ticket]
        session = self._begin(framed=False)
        granted.used()
        return PlainTextResponse(f"{session}/")


def _headers(scope: Scope) -> dict[str, str]:
    return {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}


def _user(scope: Scope) -> int | None:
    """Return the user at the other end of a connection; None if this machine does not know it."""
    client, server = scope.get("client"), scope.get("server")
    return user_of((client[0], client[1]), (server[0], server[1])) if client and server else None


def _ancestors(scope: Scope) -> str:
    """Return the origins of pages that may frame the page of a notebook: its address names them; empty for any."""
    origins = parse_qs(scope["query_string"].decode("latin-1")).get("in", [])
    if not origins or not all(map(_ORIGIN.fullmatch, origins)):
        return ""
    return " ".join(["'self'", *origins])


async def _send_protected(send: Send, ancestors: str, message: Message) -> None:
    """Send a message; an answer gets headers that keep its page from others.

    Args:
        send: Sends it.
        ancestors: The pages that may show it in a frame; empty for those that are not known here.
        message: The message.
    """
    if message["type"] == "http.response.start":
        headers = {
            b"cache-control": b"no-store",
            b"referrer-policy": b"no-referrer",
            **({b"content-security-policy": f"frame-ancestors {ancestors}".encode()} if ancestors else {}),
        }
        own_headers = [(name, value) for name, value in message["headers"] if name.lower() not in headers]
        message = {**message, "headers": [*own_headers, *headers.items()]}
    await send(message)


async def _refuse(reason: str, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": reason})  # becomes a 403
    else:
        await PlainTextResponse(f"{reason}\n", status_code=403)(scope, receive, send)


async def _entrance_page(_: Request) -> Response:
    return HTMLResponse(_entrance_text())


@cache
def _entrance_text() -> str:
    """Return the page at ``/`` with its script in it, which a browser would otherwise ask for."""
    text = (_ENTRANCE / "enter.html").read_text("utf-8")
    tag, script = '<script type="module" src="enter.js"></script>', (_ENTRANCE / "enter.js").read_text("utf-8")
    return text.replace(tag, f'<script type="module">\n{script}</script>')
