"""A web server, on this machine alone by default: Meshcat's page with a module of ours, and a socket for it."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Awaitable, Callable, Collection, Coroutine, Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import uvicorn
import websockets
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from vtbdrake.failures import FAILURES, one_line
from vtbdrake.web.access import Access
from vtbdrake.web.relay import relay
from vtbdrake.web.tls import Tls

_PAGE = Path(__file__).with_name("page")
# How the connection to a browser, or to Meshcat, ends.
CLOSED = (WebSocketDisconnect, websockets.ConnectionClosed, OSError, RuntimeError)
_HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}


class PortError(OSError):
    """The port is taken."""


class Host:
    """Serves a page from a thread of its own, on the loopback interface or by https on another one.

    Args:
        meshcat_url: The address of the Meshcat that the page shows.
        script: The module in the folder ``page`` that Meshcat's page loads.
        serve: Serves the socket of one page, from its acceptance on.
        routes: What else is served.
        port: The port; 0 for any that is free.
        hosts: Host names (with port) under which proxies offer it.
        tls: Where other devices reach it by https; None keeps it to this machine.

    Attributes:
        url: The address of the page, with its token.

    Raises:
        PortError: The port is taken.
        TlsError: The certificate cannot be used, or this machine has no such address.
    """

    def __init__(
        self,
        meshcat_url: str,
        *,
        script: str,
        serve: Callable[[WebSocket], Awaitable[None]],
        routes: Collection[BaseRoute] = (),
        port: int = 0,
        hosts: Collection[str] = (),
        tls: Tls | None = None,
    ) -> None:
        self._meshcat_url, self._serve = meshcat_url, serve
        # Behind the last script of Meshcat's page, whose viewer it uses.
        self._script = f'<script type="module" src="page/{script}"></script>\n'
        self._socket = _listen(port, *(tls.address() if tls else (socket.AF_INET, "127.0.0.1")))
        self.port = int(self._socket.getsockname()[1])
        app = Starlette(
            routes=[
                WebSocketRoute("/session", until_closed(self._serve_socket)),
                WebSocketRoute("/", until_closed(self._relay_meshcat)),
                *routes,
                Mount("/page", StaticFiles(directory=_PAGE)),
                Route("/", self._index),
                Route("/{path:path}", self._asset),
            ]
        )
        names = [*hosts, *([f"{tls.host}:{self.port}"] if tls else [])]
        access = Access(app, port=self.port, hosts=names)
        self.url = (
            f"{'https' if tls else 'http'}://{tls.host if tls else '127.0.0.1'}:{self.port}/?token={access.token}"
        )
        config = uvicorn.Config(
            access,
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

    def close(self) -> None:
        """End the server and all its connections."""
        self._server.should_exit = True
        for task in tuple(self._server.server_state.tasks):  # Browsers do not end them by themselves.
            task.get_loop().call_soon_threadsafe(task.cancel)
        self._thread.join()
        self._socket.close()

    async def _serve_socket(self, browser: WebSocket) -> None:
        await browser.accept()
        with suppress(*CLOSED):
            await self._serve(browser)

    async def _index(self, _: Request) -> Response:
        status, body, kind = await run_in_threadpool(_fetch, f"{self._meshcat_url}/")
        head, end, tail = body.decode().rpartition("</body>")
        return Response(f"{head}{self._script}{end}{tail}", status_code=status, media_type=kind, headers=_HEADERS)

    async def _asset(self, request: Request) -> Response:
        path = quote(request.path_params["path"])
        status, body, kind = await run_in_threadpool(_fetch, f"{self._meshcat_url}/{path}")
        return Response(body, status_code=status, media_type=kind)

    async def _relay_meshcat(self, browser: WebSocket) -> None:
        """Pass Meshcat's messages on; what the browser sends to Meshcat is dropped."""
        url = self._meshcat_url.replace("http", "ws", 1)
        await browser.accept()
        try:
            async with websockets.connect(url, max_size=None, compression=None, ping_interval=None) as meshcat:
                # Where nothing moves, nothing is sent that could fail: only reading notices that a browser is gone.
                await first_of(relay(meshcat.recv, browser.send_bytes), _drop_all(browser))
        except CLOSED:
            pass
        with suppress(*CLOSED):
            await browser.close()


async def send(browser: WebSocket, message: Mapping[str, Any]) -> None:
    """Send a message to a page."""
    await browser.send_text(json.dumps(message, allow_nan=False))


async def answer_commands(
    browser: WebSocket, carry_out: Callable[[Mapping[str, Any]], Awaitable[Any]], *, together: bool = False
) -> None:
    """Carry out the commands of a page, and answer each with its result or its error.

    Args:
        browser: The connection to the page.
        carry_out: Carries out a command, and returns its result.
        together: Whether a command need not wait for the one before it.
    """

    async def answer(text: str) -> None:
        number, error, result = None, "", None
        try:
            message = json.loads(text)
            number = message.get("id")
            result = await carry_out(message)
        except FAILURES as failure:  # It is told on the page, which waits for an answer.
            error = one_line(failure)
        await send(browser, {"type": "answer", "id": number, "error": error, "result": result})

    async def answer_if_open(text: str) -> None:
        with suppress(*CLOSED):
            await answer(text)

    tasks: set[asyncio.Task[None]] = set()
    try:
        while True:
            text = await browser.receive_text()
            if together:
                task = asyncio.create_task(answer_if_open(text))
                tasks.add(task)
                task.add_done_callback(tasks.discard)
            else:
                await answer(text)
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
        with urllib.request.urlopen(url, timeout=10.0) as answer:
            return answer.status, answer.read(), answer.headers.get_content_type()
    except urllib.error.HTTPError as error:
        return error.code, error.read(), "text/plain"
    except OSError as error:
        return 502, f"Meshcat does not answer: {one_line(error)}".encode(), "text/plain"


async def _drop_all(browser: WebSocket) -> None:
    with suppress(*CLOSED):
        while True:
            await browser.receive()
