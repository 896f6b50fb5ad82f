"""Tests of who may use a server: each request is given to the application itself, without a network."""

from __future__ import annotations

import asyncio
import os
import re
from collections.abc import Callable
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from vtbdrake.web.serving import access as access_module
from vtbdrake.web.serving.access import Access

pytestmark = pytest.mark.one_python

PORT = 8123
HOST = f"127.0.0.1:{PORT}"


class Server:
    """An access before an application that notes the scopes that get through to it."""

    def __init__(self, **options: Any) -> None:
        self.passed: list[Scope] = []
        self.access = Access(self._app, port=PORT, **options)

    async def _app(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.passed.append(scope)
        if scope["type"] == "http":
            await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"text/html")]})
            await send({"type": "http.response.body", "body": b""})

    def ask(
        self,
        path: str = "/",
        query: str = "",
        *,
        kind: str = "http",
        method: str = "GET",
        body: bytes = b"",
        user: int | None = None,
        **headers: str,
    ) -> list[Message]:
        """Return what is answered."""
        sent: list[Message] = []
        received: list[Message] = []

        async def receive() -> Message:
            if received:
                await asyncio.Event().wait()  # Nothing more comes.
            received.append({"type": f"{kind}.connect"} if kind != "http" else {"type": "http.request", "body": body})
            return received[-1]

        async def send(message: Message) -> None:
            assert kind == "http" or received, "a WebSocket is closed after its request was received"
            sent.append(message)

        scope = {
            "type": kind,
            "scheme": "http",
            "method": method,
            "path": path,
            "query_string": query.encode(),
            "headers": [(name.encode(), value.encode()) for name, value in ({"host": HOST} | headers).items()],
            "client": ("127.0.0.1", 5000),
            "server": ("127.0.0.1", PORT),
        }
        self.passed.clear()
        asyncio.run(self.access(scope, receive, send))
        return sent

    def enter(self, ticket: str, **options: Any) -> tuple[int, str]:
        """Return status and text of the answer to a ticket."""
        start, *rest = self.ask("/enter", method="POST", body=ticket.encode(), **options)
        return start["status"], b"".join(part.get("body", b"") for part in rest).decode()

    def session(self) -> str:
        status, path = self.enter(self.access.ticket())
        assert status == 200
        return path.removesuffix("/")

    def lets_in(self, *args: Any, **options: Any) -> bool:
        """Whether a request reaches the application; one that does not is refused."""
        sent = self.ask(*args, **options)
        if not self.passed:
            assert sent[0].get("status", 403) == 403
        return bool(self.passed)


def test_ticket_becomes_a_session_once() -> None:
    server = Server()
    used: list[str] = []
    ticket = server.access.ticket(used=lambda: used.append("used"))
    status, path = server.enter(ticket, origin=f"http://{HOST}")
    assert status == 200 and re.fullmatch(r"[\w-]{22,}/", path) and ticket not in path and used == ["used"]
    for kind in ("http", "websocket"):
        for rest in ("", "page/view.js", "session"):
            assert server.lets_in(f"/{path}{rest}", kind=kind)
            assert server.passed[0]["root_path"] == f"/{path[:-1]}" and server.passed[0]["path"] == f"/{path}{rest}"
    status, text = server.enter(ticket)
    assert status == 403 and "was used already: open an address that vtbdrake has printed" in text
    assert used == ["used"] and server.session() != path[:-1]


def test_wrong_tickets_are_refused() -> None:
    server = Server()
    ticket, session = server.access.ticket(), server.session()
    for text in ("", "wrong", ticket[:-1], f"{ticket}x", session, "é", "x" * 100_000):
        assert server.enter(text)[0] == 403
    assert len(ticket) >= 22 and ticket != Server().access.ticket()  # 16 random bytes
    assert server.enter(ticket)[0] == 200


def test_entrance_is_for_everybody_and_has_no_secret() -> None:
    server = Server()
    server.session()
    for path in ("", "/"):
        start, *_ = server.ask(path)
        assert start["status"] == 200 and not server.passed
    for path in ("/enter.html", "/enter.js", "/enter", "/page/enter.js", "/../access.py"):
        assert not server.lets_in(path)
    assert not server.lets_in("/", method="POST")


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_who_does_not_know_the_session_is_refused(kind: str) -> None:
    server = Server()
    session, ticket = server.session(), server.access.ticket()
    wrong = (
        session,
        f"{session[:-1]}/",
        f"{session}x/",
        f"page/{session}/",
        f"/{session}/",
        f"{ticket}/",
        "é/",
        "page",
    )
    for path in wrong:
        for cookie in ("", f"vtbdrake-{PORT}={session}"):
            assert not server.lets_in(f"/{path}", kind=kind, cookie=cookie)
            assert not server.lets_in(f"/{path}", f"token={session}", kind=kind)
    if kind == "websocket":
        assert not server.lets_in("/", kind=kind)
        assert server.ask("/", kind=kind)[0]["code"] == 1008


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_foreign_host_or_origin_is_refused_with_the_right_session(kind: str) -> None:
    server = Server(hosts=["robot.example:443", "hub.example:9000"])
    path = f"/{server.session()}/session"
    for host in ("evil.example", f"evil.example:{PORT}", "127.0.0.1", f"127.0.0.1:{PORT + 1}", "hub.example", ""):
        assert not server.lets_in(path, kind=kind, host=host)
        assert server.enter(server.access.ticket(), host=host)[0] == 403
    for origin in ("http://evil.example", f"http://localhost:{PORT}", f"http://127.0.0.1:{PORT + 1}", "null", ""):
        assert not server.lets_in(path, kind=kind, origin=origin)
        assert server.enter(server.access.ticket(), origin=origin)[0] == 403
    # A browser leaves out the port of https.
    for host in (HOST, f"localhost:{PORT}", f"[::1]:{PORT}", "robot.example:443", "robot.example", "hub.example:9000"):
        assert server.lets_in(path, kind=kind, host=host)
        assert server.lets_in(path, kind=kind, host=host, origin=f"http://{host}")


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "0.0.0.0:80", "[::]:80", "::", "robot.example", "robot.example:x", ":80", "a:0", ""]
)
def test_host_that_is_no_name_of_a_proxy_is_refused(host: str) -> None:
    with pytest.raises(ValueError, match=f"expected NAME:PORT of a proxy .*not {re.escape(repr(host))}; .*--tls NAME"):
        Server(hosts=[host])


def headers_of(sent: list[Message]) -> dict[str, str]:
    return {name.decode(): value.decode() for name, value in sent[0]["headers"]}


def test_no_page_can_be_framed_by_another_and_none_is_stored() -> None:
    server = Server()
    for path in ("/", f"/{server.session()}/", "/wrong/"):
        headers = headers_of(server.ask(path, "in=http://127.0.0.1:9999"))
        assert headers["content-security-policy"] == "frame-ancestors 'none'"
        assert headers["referrer-policy"] == "no-referrer" and headers["cache-control"] == "no-store"


def test_page_of_a_notebook_is_framed_by_its_front_end_through_any_proxy() -> None:
    server = Server()
    path = f"/{server.access.framed_session()}/"
    proxy = {"host": "hub.example", "origin": "https://hub.example"}
    assert server.lets_in(path, **proxy) and server.lets_in(f"{path}session", kind="websocket", **proxy)
    headers = headers_of(server.ask(path, "in=http%3A%2F%2Flocalhost%3A8888&in=https%3A%2F%2Fhub.example", **proxy))
    assert headers["content-security-policy"] == "frame-ancestors 'self' http://localhost:8888 https://hub.example"
    # The webviews of VS Code, whose origins no policy can name.
    for query in ("", "in=vscode-webview://0abc", "in=http://a.example%3B%20script-src%20*"):
        assert "content-security-policy" not in headers_of(server.ask(path, query, **proxy))
    assert not server.lets_in(f"/{server.session()}/", **proxy)


@pytest.mark.parametrize(("user", "good"), [(os.geteuid(), True), (0, True), (os.geteuid() + 1, False), (None, False)])
def test_ticket_of_the_browser_that_was_started_is_good_for_this_user_alone(
    user: int | None, good: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(access_module, "user_of", users(user))
    server = Server()
    ticket = server.access.ticket(own_user=True)
    status, text = server.enter(ticket)
    assert status == (200 if good else 403) and (good or "for a browser of another user" in text)
    # Somebody else does not use it up.
    monkeypatch.setattr(access_module, "user_of", users(os.geteuid()))
    assert server.enter(ticket)[0] == (403 if good else 200)


def users(user: int | None) -> Callable[..., int | None]:
    def user_of(address: tuple[str, int], peer: tuple[str, int]) -> int | None:
        assert (address, peer) == (("127.0.0.1", 5000), ("127.0.0.1", PORT))
        return user

    return user_of


def test_lifespan_of_the_server_reaches_the_application() -> None:
    server = Server()
    asyncio.run(server.access({"type": "lifespan"}, None, None))  # type: ignore[arg-type]
    assert [scope["type"] for scope in server.passed] == ["lifespan"]
