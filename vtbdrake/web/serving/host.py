"""A web server, on this machine alone by default: Meshcat's page with a module of ours, and a socket for it."""

from __future__ import annotations

import asyncio
import json
import reprlib
import socket
import threading
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Awaitable, Callable, Collection, Coroutine, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from typing import Any, TypeVar
from urllib.parse import quote

import msgpack  # type: ignore[import-untyped]
import uvicorn
import websockets
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.web.serving.access import Access
from vtbdrake.web.serving.relay import moves_camera, relay
from vtbdrake.web.serving.requests import wait_for_end
from vtbdrake.web.serving.tls import Tls
from vtbdrake.web.serving.web_page import check_host

_Action = TypeVar("_Action")

# How the connection to a browser, or to Meshcat, ends.
CLOSED = (WebSocketDisconnect, websockets.ConnectionClosed, OSError, RuntimeError)
NEXT_MESHCAT_TIME = 10.0  # s of wall time, for a Meshcat that follows one that has died
_MESHCAT_PERIOD = 0.1  # s of wall time between two looks for it
_NO_MESHCAT = 502  # status: Bad Gateway
_CLEAR = msgpack.packb({"type": "delete", "path": "/drake"})  # removes what a Meshcat has drawn
# Meshcat is on this machine, whatever proxies the environment names.
_OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))


class PortError(OSError):
    """The port is taken."""


class Host:
    """Serves a page from a thread of its own, on the loopback interface or by https on another one.

    Args:
        meshcat_url: Returns the address of the Meshcat that the page shows; empty while there is none. If one dies, the
            page goes on with the next.
        script: The module that Meshcat's page loads, in one of the folders ``page``; empty for none.
        packages: Packages whose folders ``page`` are served at ``page/``, beside the one of this package.
        serve: Serves the socket of one page, from its acceptance on; None if there is none.
        routes: What else is served.
        port: The port; 0 for any that is free.
        hosts: Host names (with port) under which proxies offer it.
        tls: Where other devices reach it by https; None keeps it to this machine.

    Raises:
        ValueError: A host name has no port, or is an address to listen on; or a `TlsError`: the certificate cannot be
            used, or this machine has no such address.
        PortError: The port is taken.
    """

    def __init__(
        self,
        meshcat_url: Callable[[], str],
        *,
        script: str = "",
        packages: Collection[str] = (),
        serve: Callable[[WebSocket], Awaitable[None]] | None = None,
        routes: Collection[BaseRoute] = (),
        port: int = 0,
        hosts: Collection[str] = (),
        tls: Tls | None = None,
    ) -> None:
        self._meshcat_url, self._serve = meshcat_url, serve
        # Behind the last script of Meshcat's page, whose viewer it uses. Links that ask for what it imports at once
        # (modulepreload) make the panel no earlier, and the first picture later.
        self._script = f'<script type="module" src="page/{script}"></script>\n' if script else ""
        for name in hosts:
            check_host(name)
        self._socket = _listen(port, *(tls.address() if tls else (socket.AF_INET, "127.0.0.1")))
        self.port = int(self._socket.getsockname()[1])
        app = Starlette(
            routes=[
                *([WebSocketRoute("/session", until_closed(self._serve_socket))] if serve else []),
                WebSocketRoute("/", until_closed(self._relay_meshcat)),
                *routes,
                Mount("/page", StaticFiles(packages=[(name, "page") for name in (__package__, *packages)])),
                Route("/", self._index),
                Route("/{path:path}", self._asset),
            ]
        )
        names = [*hosts, *([f"{tls.host}:{self.port}"] if tls else [])]
        self._access = Access(app, port=self.port, hosts=names)
        self._origin = f"{'https' if tls else 'http'}://{tls.host if tls else '127.0.0.1'}:{self.port}"
        config = uvicorn.Config(
            self._access,
            log_level="warning",
            lifespan="off",
            ws="websockets-sansio",
            # Pings keep connections through proxies open. Pongs wait behind commands, which may take long: a late one
            # ends nothing.
            ws_ping_timeout=None,
            timeout_graceful_shutdown=1,
        )
        config.ws_per_message_deflate = tls is not None  # On the loopback interface it only takes time.
        with ExitStack() as stack:
            if tls:
                try:
                    config.ssl_certfile, config.ssl_keyfile = stack.enter_context(tls.files())
                except ValueError:
                    self._socket.close()
                    raise
            config.load()  # It reads the certificate.
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="vtbdrake web", daemon=True
        )
        self._thread.start()

    def address(self, *, used: Callable[[], None] = lambda: None) -> str:
        """Return a new address of the page, which is good for one browser.

        Args:
            used: Called in the thread of the server when a browser has used it.
        """
        return f"{self._origin}/#{self._access.ticket(used=used)}"

    def open_browser(self) -> bool:
        """Open the page in a browser of this user; return whether there is one.

        Its address stands on a command line, which all users of the machine can read: only this one can use it.
        """
        return webbrowser.open(f"{self._origin}/#{self._access.ticket(own_user=True)}")

    def framed_path(self) -> str:
        """Return a new path of the page, for a frame in a notebook."""
        return f"{self._access.framed_session()}/"

    def close(self) -> None:
        """End the server and all its connections; one whose command hangs is left behind after 10 s."""
        self._server.should_exit = True
        for task in tuple(self._server.server_state.tasks):  # Browsers do not end them by themselves.
            task.get_loop().call_soon_threadsafe(task.cancel)
        wait_for_end(self._thread, "the page's server")
        self._socket.close()

    async def _serve_socket(self, browser: WebSocket) -> None:
        assert self._serve is not None
        await browser.accept()
        with suppress(*CLOSED):
            await self._serve(browser)

    async def _index(self, _: Request) -> Response:
        status, body, kind = await self._fetched("")
        head, end, tail = body.decode().rpartition("</body>")
        headers = {"X-Content-Type-Options": "nosniff"}  # Not of assets: Meshcat calls its script text.
        return Response(f"{head}{self._script}{end}{tail}", status_code=status, media_type=kind, headers=headers)

    async def _asset(self, request: Request) -> Response:
        path = quote(request.path_params["path"])
        status, body, kind = await self._fetched(path)
        return Response(body, status_code=status, media_type=kind)

    async def _fetched(self, path: str) -> tuple[int, bytes, str]:
        """Return status, body and media type of a resource of Meshcat, or of the next one if it has just died."""
        loop = asyncio.get_running_loop()
        limit = loop.time() + NEXT_MESHCAT_TIME
        while True:
            answer = await run_in_threadpool(_fetch, f"{self._meshcat_url()}/{path}")
            if answer[0] != _NO_MESHCAT or loop.time() >= limit:
                return answer
            await asyncio.sleep(_MESHCAT_PERIOD)

    async def _relay_meshcat(self, browser: WebSocket) -> None:
        """Pass Meshcat's messages on; what the browser sends to Meshcat is dropped."""
        await browser.accept()
        with suppress(*CLOSED):
            # Where nothing moves, nothing is sent that could fail: only reading notices that a browser is gone.
            await first_of(self._pass_on(browser), _drop_all(browser))
        with suppress(*CLOSED):
            await browser.close()

    async def _pass_on(self, browser: WebSocket) -> None:
        """Pass on the messages of a Meshcat, and if it dies, of the next one, until there is none for a while.

        A browser that lost its connection would load the page anew, and a headset would leave virtual reality.
        """
        options: dict[str, Any] = {"max_size": None, "compression": None, "ping_interval": None, "proxy": None}
        before, is_shown, loop = "", False, asyncio.get_running_loop()
        limit = loop.time() + NEXT_MESHCAT_TIME
        while loop.time() < limit:
            url = self._meshcat_url()
            if not url or url == before:
                await asyncio.sleep(_MESHCAT_PERIOD)
                continue
            with suppress(OSError, websockets.InvalidHandshake):  # It may have died since.
                async with websockets.connect(url.replace("http", "ws", 1), **options) as meshcat:
                    receive = partial(_receive, meshcat, keeps_camera=is_shown)
                    if is_shown:
                        await browser.send_bytes(_CLEAR)
                    is_shown = True
                    await relay(receive, browser.send_bytes)
            before, limit = url, loop.time() + NEXT_MESHCAT_TIME


async def send(browser: WebSocket, message: Mapping[str, Any]) -> None:
    """Send a message to a page.

    Args:
        browser: The socket of the page.
        message: Plain data for JSON, without NaN and infinity.
    """
    await browser.send_text(_text(message))


def _text(message: Mapping[str, Any]) -> str:
    return json.dumps(message, allow_nan=False)


async def receive(browser: WebSocket) -> str | bytes:
    """Return the content of the next frame of a page.

    Raises:
        WebSocketDisconnect: The page is gone.
    """
    message = await browser.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message["code"], message.get("reason"))
    text: str | None = message.get("text")
    return message["bytes"] if text is None else text


def command_of(content: str | bytes) -> dict[str, Any]:
    """Return the command, a JSON object, in the content of a frame.

    Raises:
        ValueError: There is none.
    """
    if isinstance(content, bytes):
        raise ValueError("a command is a frame of text, not of bytes")
    try:
        command = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"a command is a JSON object ({one_line(error)})") from error
    if not isinstance(command, dict):
        raise ValueError(f"a command is a JSON object, not {reprlib.repr(command)}")
    return command


def action_of(command: Mapping[str, Any], actions: Mapping[str, _Action]) -> _Action:
    """Return the action that a command names.

    Args:
        command: The message of a page, whose ``do`` names the action.
        actions: The actions by name.

    Raises:
        ValueError: There is none of that name.
    """
    name = command.get("do")
    if not isinstance(name, str) or name not in actions:
        raise ValueError(f"there is no command {reprlib.repr(name)}; there are: {', '.join(actions)}")
    return actions[name]


async def answer_commands(
    browser: WebSocket,
    carry_out: Callable[[Mapping[str, Any]], Awaitable[Any]],
    *,
    together: bool = False,
    next_frame: Callable[[WebSocket], Awaitable[str | bytes]] = receive,
) -> None:
    """Carry out the commands of a page, and answer each with its result or its error.

    Args:
        browser: The connection to the page.
        carry_out: Carries out a command, and returns its result.
        together: Whether a command need not wait for the one before it.
        next_frame: Returns the content of the next frame, as `receive` does.
    """

    async def answer(content: str | bytes) -> None:
        number = None
        try:
            command = command_of(content)
            if isinstance(command.get("id"), int):
                number = command["id"]
            result = await carry_out(command)
            text = _text({"type": "answer", "id": number, "error": "", "result": result})
        except FAILURES as failure:  # It is told on the page, which waits for an answer.
            error = f"it lacks {failure}" if isinstance(failure, KeyError) else one_line(failure)
            text = _text({"type": "answer", "id": number, "error": error, "result": None})
        await browser.send_text(text)

    async def answer_if_open(content: str | bytes) -> None:
        with suppress(*CLOSED):
            await answer(content)

    tasks: set[asyncio.Task[None]] = set()
    try:
        while True:
            content = await next_frame(browser)
            if together:
                task = asyncio.create_task(answer_if_open(content))
                tasks.add(task)
                task.add_done_callback(tasks.discard)
            else:
                await answer(content)
    finally:
        for task in tasks:
            task.cancel()


async def first_of(*tasks: Coroutine[Any, Any, None]) -> None:
    """Run what serves a page, until one of them ends or fails."""
    running = [asyncio.create_task(task) for task in tasks]
    try:
        done, _ = await asyncio.wait(running, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)


def until_closed(serve: Callable[[WebSocket], Awaitable[None]]) -> Callable[[WebSocket], Awaitable[None]]:
    """Return a handler that also ends in silence when the server ends while its browser is connected."""

    async def serve_until_closed(browser: WebSocket) -> None:
        with suppress(asyncio.CancelledError):
            await serve(browser)

    return serve_until_closed


def _listen(port: int, family: socket.AddressFamily, address: str) -> socket.socket:
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((address, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise PortError(
            f"port {port} cannot be used at {address} ({one_line(error)}): give another one, or 0 for any that is free"
        ) from None
    listener.listen()
    return listener


def _fetch(url: str) -> tuple[int, bytes, str]:
    """Return status, body and media type of a resource of Meshcat."""
    try:
        with _OPENER.open(url, timeout=10.0) as answer:
            return answer.status, answer.read(), answer.headers.get_content_type()
    except urllib.error.HTTPError as error:
        return error.code, error.read(), "text/plain"
    except (OSError, ValueError) as error:
        return _NO_MESHCAT, f"Meshcat does not answer: {one_line(error)}".encode(), "text/plain"


async def _receive(meshcat: websockets.ClientConnection, *, keeps_camera: bool) -> bytes | str:
    """Return the next message of Meshcat; one that moves the camera may be left out, as a person has moved it since."""
    data = await meshcat.recv()
    while keeps_camera and moves_camera(data):
        data = await meshcat.recv()
    return data


async def _drop_all(browser: WebSocket) -> None:
    with suppress(*CLOSED):
        while True:
            await browser.receive()
