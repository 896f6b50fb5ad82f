"""Tests of who may use a server: each request is given to the application itself, without a network."""

from __future__ import annotations

import asyncio
from http.cookies import SimpleCookie
from typing import Any

import pytest
from starlette.types import Message, Receive, Scope, Send

from vtbdrake.web.access import Access

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

    def ask(
        self, path: str = "/", query: str = "", *, kind: str = "http", scheme: str = "http", **headers: str
    ) -> list[Message]:
        """Return what the access itself answers; nothing where the application got the request."""
        sent: list[Message] = []
        received: list[Message] = []

        async def receive() -> Message:
            received.append({"type": f"{kind}.connect"})
            return received[-1]

        async def send(message: Message) -> None:
            assert kind == "http" or received, "a WebSocket is closed after its request was received"
            sent.append(message)

        scope = {
            "type": kind,
            "scheme": scheme,
            "method": "GET",
            "path": path,
            "query_string": query.encode(),
            "headers": [(name.encode(), value.encode()) for name, value in ({"host": HOST} | headers).items()],
        }
        self.passed.clear()
        asyncio.run(self.access(scope, receive, send))
        assert bool(sent) != bool(self.passed)
        return sent

    @property
    def cookie(self) -> str:
        return f"vtbdrake-{PORT}={self.access.token}"


def test_token_is_exchanged_for_a_cookie_that_lets_in() -> None:
    server = Server()
    for path in ("", "/"):
        for scheme in ("http", "https"):
            start = server.ask(path, f"token={server.access.token}", scheme=scheme)[0]
            headers = dict(start["headers"])
            assert start["status"] == 303 and headers[b"location"] == b"./"
            (morsel,) = SimpleCookie(headers[b"set-cookie"].decode()).values()
            assert (morsel.key, morsel.value) == (f"vtbdrake-{PORT}", server.access.token)
            assert morsel["httponly"] is True and morsel["samesite"] == "strict"
            assert bool(morsel["secure"]) == (scheme == "https")
    assert not server.ask(cookie=server.cookie) and not server.ask(cookie=f"a=b; {server.cookie}; c=d")
    assert not server.ask("/session", kind="websocket", cookie=server.cookie)


@pytest.mark.parametrize("cookie", ['layout={"left": [1, 2]}', "list[0]=1", "name=a b", "flag", "=", "a\tb=c", "é=é"])
def test_cookies_of_other_servers_on_the_machine_do_not_lock_out(cookie: str) -> None:
    server = Server()
    assert not server.ask(cookie=f"{cookie}; {server.cookie}") and not server.ask(cookie=f"{server.cookie}; {cookie}")


def test_token_in_the_query_of_another_path_lets_in_without_a_cookie() -> None:
    server = Server()
    assert not server.ask("/page", f"token={server.access.token}")
    assert not server.ask("/", f"token={server.access.token}", kind="websocket")


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize("path", ["", "/", "/page", "/session"])
def test_who_does_not_know_the_token_is_refused(kind: str, path: str) -> None:
    server = Server()
    token = server.access.token
    cookies = ("", token, f"vtbdrake-{PORT + 1}={token}", f"vtbdrake-{PORT}={token[:-1]}", f"vtbdrake-{PORT}=é")
    for query in ("", "token=", "token=wrong", "token=wrong&token=é", f"other={token}"):
        for cookie in (*cookies, "not\tone;=,"):
            check_refusal(server.ask(path, query, kind=kind, cookie=cookie), "the token is missing or wrong")
    assert len(token) >= 22 and token != Server().access.token  # 16 random bytes


def check_refusal(sent: list[Message], reason: str) -> None:
    if sent[0]["type"] == "websocket.close":
        assert len(sent) == 1 and sent[0]["code"] == 1008 and reason in sent[0]["reason"]
    else:
        assert sent[0]["status"] == 403 and reason in sent[1]["body"].decode()


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_foreign_host_or_origin_is_refused_with_the_right_token(kind: str) -> None:
    server = Server(hosts=["robot.example:443"])
    query = f"token={server.access.token}"
    options = {"kind": kind, "cookie": server.cookie}
    for host in ("evil.example", f"evil.example:{PORT}", "127.0.0.1", f"127.0.0.1:{PORT + 1}", "robot.example", ""):
        for text in ("", query):
            check_refusal(server.ask("/session", text, **options, host=host), f"not reached as {host!r}")
    for origin in ("http://evil.example", f"http://localhost:{PORT}", "null", "", "http://127.0.0.1"):
        for text in ("", query):
            check_refusal(server.ask("/session", text, **options, origin=origin), f"pages of {origin} may not")
    for host in (HOST, f"localhost:{PORT}", f"[::1]:{PORT}", "robot.example:443"):
        assert not server.ask("/session", **options, host=host)
        assert not server.ask("/session", **options, host=host, origin=f"http://{host}")


def test_address_that_begins_with_the_token_needs_no_cookie() -> None:
    server = Server()
    token = server.access.token
    for path in (f"/{token}/", f"/{token}/page/view.js"):
        assert not server.ask(path, host="hub.example", origin="https://hub.example")
        assert server.passed[0]["root_path"] == f"/{token}" and server.passed[0]["path"] == path
    for path in (
        f"/{token}",
        f"/page/{token}",
        f"/page/{token}/",
        f"//{token}/",
        f"/{token[:-1]}/",
        f"/{token}x/",
        "/é/",
        token,
    ):
        check_refusal(server.ask(path), "the token is missing or wrong")


def test_lifespan_of_the_server_reaches_the_application() -> None:
    server = Server()
    asyncio.run(server.access({"type": "lifespan"}, None, None))  # type: ignore[arg-type]
    assert [scope["type"] for scope in server.passed] == ["lifespan"]
