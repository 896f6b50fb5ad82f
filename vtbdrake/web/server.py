"""The web server of a session: Meshcat's page with our controls, and a socket for commands and frames."""

from __future__ import annotations

import asyncio
import json
import logging
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

import uvicorn
import websockets
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket, WebSocketDisconnect

from vtbdrake.failures import one_line
from vtbdrake.web.access import Access
from vtbdrake.web.relay import relay
from vtbdrake.web.session import Session, SessionError

_log = logging.getLogger(__name__)

_PAGE = Path(__file__).with_name("page")
# Behind the last script of Meshcat's page, whose viewer it uses.
_SCRIPT = '<script type="module" src="page/view.js"></script>\n'
_FRAME_PERIOD = 0.05  # s of wall time between two frames for a page
_PATIENCE = 1.0  # s, for a frame
_CLOSED = (WebSocketDisconnect, websockets.ConnectionClosed, OSError, RuntimeError)


class PortError(OSError):
    """The port is taken."""


class Server:
    """Serves a session on the loopback interface, from a thread of its own.

    Args:
        session: The session.
        port: The port; 0 for any that is free.
        hosts: Host names (with port) under which proxies offer it.

    Attributes:
        url: The address of the page, with its token.

    Raises:
        PortError: The port is taken.
    """

    def __init__(self, session: Session, *, port: int = 0, hosts: Collection[str] = ()) -> None:
        self._session = session
        self._socket = _listen(port)
        self.port = int(self._socket.getsockname()[1])
        self._steering: Page | None = None
        self._pages: list[Page] = []
        app = Starlette(
            routes=[
                WebSocketRoute("/session", self._serve_page),
                WebSocketRoute("/", self._relay_meshcat),
                Mount("/page", StaticFiles(directory=_PAGE)),
                Route("/", self._index),
                Route("/{path:path}", self._asset),
            ]
        )
        access = Access(app, port=self.port, hosts=hosts)
        self.url = f"http://127.0.0.1:{self.port}/?token={access.token}"
        config = uvicorn.Config(
            access, log_level="warning", lifespan="off", ws="websockets-sansio", timeout_graceful_shutdown=1
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(
            target=self._server.run, kwargs={"sockets": [self._socket]}, name="vtbdrake web", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """End the server and all its connections."""
        self._server.should_exit = True
        self._thread.join()
        self._socket.close()

    # -- Meshcat

    async def _index(self, _: Request) -> Response:
        status, body, kind = await run_in_threadpool(_fetch, f"{self._session.meshcat_url}/")
        head, end, tail = body.decode().rpartition("</body>")
        return Response(f"{head}{_SCRIPT}{end}{tail}", status_code=status, media_type=kind, headers=_HEADERS)

    async def _asset(self, request: Request) -> Response:
        path = quote(request.path_params["path"])
        status, body, kind = await run_in_threadpool(_fetch, f"{self._session.meshcat_url}/{path}")
        return Response(body, status_code=status, media_type=kind)

    async def _relay_meshcat(self, browser: WebSocket) -> None:
        """Pass Meshcat's messages on; what the browser sends to Meshcat is dropped."""
        url = self._session.meshcat_url.replace("http", "ws", 1)
        await browser.accept()
        try:
            async with websockets.connect(url, max_size=None, compression=None) as meshcat:
                drop = asyncio.create_task(_drop_all(browser))
                try:
                    await relay(meshcat.recv, browser.send_bytes)
                finally:
                    drop.cancel()
        except _CLOSED:
            pass
        with suppress(*_CLOSED):
            await browser.close()

    # -- commands and frames

    async def _serve_page(self, browser: WebSocket) -> None:
        await browser.accept()
        page = Page(self._session, browser)
        self._pages.append(page)
        if self._steering is None:
            self._steering = page
        try:
            await page.serve(self)
        except _CLOSED:
            pass
        finally:
            self._pages.remove(page)
            if self._steering is page:
                self._steering = next(iter(self._pages), None)
            with suppress(SessionError):
                await run_in_threadpool(self._session.watch, page, ())

    def steers(self, page: Page) -> bool:
        """Return whether a page may change anything: one at a time."""
        return self._steering is page

    def take_over(self, page: Page) -> None:
        """Let a page steer, instead of the one that does."""
        self._steering = page


class Page:
    """The connection to one page."""

    def __init__(self, session: Session, browser: WebSocket) -> None:
        self._session = session
        self._browser = browser
        self._watched: tuple[str, ...] = ()
        # Command -> what it does with the message; those of `_ANYBODY` do not steer.
        self._commands: dict[str, Callable[[Mapping[str, Any]], Any]] = {
            "play": lambda _: session.play(),
            "pause": lambda _: session.pause(),
            "step": lambda message: session.advance(int(message.get("steps", 1))),
            "reset": lambda _: session.reset(),
            "speed": lambda message: session.set_speed(float(message["speed"])),
            "seek": lambda message: session.seek(message["time"]),
            "write": lambda message: session.write(message["values"], compare=bool(message.get("compare", False))),
            "switch": lambda message: session.switch(
                message.get("mode"), sense=message.get("sense"), act=message.get("act")
            ),
            "preview": lambda message: session.preview(message["values"]),
            "cancel_preview": lambda _: session.cancel_preview(),
            "cancel_comparison": lambda _: session.cancel_comparison(),
            "watch": self._watch,
        }

    async def serve(self, server: Server) -> None:
        """Answer commands, and send frames."""
        hello = {
            "type": "hello",
            "scenario": self._session.scenario.name(),
            "variables": dict(self._session.variables),
            "bodies": list(self._session.bodies),
        }
        await self._send(hello)
        tasks = [asyncio.create_task(self._send_frames(server)), asyncio.create_task(self._answer(server))]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _send(self, message: Mapping[str, Any]) -> None:
        await self._browser.send_text(json.dumps(message, allow_nan=False))

    async def _send_frames(self, server: Server) -> None:
        number = 0
        while True:
            frame = await run_in_threadpool(self._session.wait_for_frame, number, _PATIENCE)
            if frame is None:
                continue
            number = frame.number
            values = {address: frame.values[address] for address in self._watched if address in frame.values}
            shown = {**asdict(frame), "values": values, "speed": _finite(frame.speed)}
            await self._send({"type": "frame", "steers": server.steers(self), **shown})
            await asyncio.sleep(_FRAME_PERIOD)

    async def _answer(self, server: Server) -> None:
        while True:
            text = await self._browser.receive_text()
            number, error, result = None, "", None
            try:
                message = json.loads(text)
                number = message.get("id")
                result = await self._carry_out(message, server)
            except (ValueError, LookupError, TypeError, AttributeError) as failure:
                error = one_line(failure)
            await self._send({"type": "answer", "id": number, "error": error, "result": result})

    async def _carry_out(self, message: Mapping[str, Any], server: Server) -> Any:
        name = message.get("do")
        if name == "take over":
            return server.take_over(self)
        if name not in self._commands:
            raise SessionError(f"there is no command {name!r}; there are: {', '.join(self._commands)}")
        if name != "watch" and not server.steers(self):
            raise SessionError("another page steers this session: take over first")
        return await run_in_threadpool(self._commands[name], message)

    def _watch(self, message: Mapping[str, Any]) -> None:
        self._session.watch(self, message["addresses"])
        self._watched = tuple(message["addresses"])


_HEADERS = {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff"}


def _finite(value: float) -> float | str:
    return value if value < float("inf") else "unlimited"


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise PortError(
            f"port {port} cannot be used ({one_line(error)}): give another one, or 0 for any that is free"
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
    with suppress(*_CLOSED):
        while True:
            await browser.receive()
