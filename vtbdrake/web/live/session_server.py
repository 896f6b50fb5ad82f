"""The web server of a session: one of its pages steers."""

from __future__ import annotations

import asyncio
import base64
import io
import re
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from PIL import Image
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.visualization.viewpoint import Viewpoint
from vtbdrake.web.live.ghosts import TINTS
from vtbdrake.web.live.layers import PERCEIVED_TINT, LayerError
from vtbdrake.web.live.log_session import LogSession
from vtbdrake.web.live.loop_session import LoopSession
from vtbdrake.web.live.session import Session, SessionError
from vtbdrake.web.live.simulation_session import PlayedSession
from vtbdrake.web.live.watching import opening_addresses
from vtbdrake.web.serving.host import Host, action_of, answer_commands, first_of, receive, send, until_closed
from vtbdrake.web.vr.virtual_reality import VirtualReality

_FRAME_PERIOD = 0.05  # s of wall time between two frames for a page
_PATIENCE = 1.0  # s, for a frame
_JPEG_QUALITY = 80
# s without a frame of the page that drives: it is frozen, or its connection is, and nobody holds its sticks.
RELEASE_TIME = 1.0
# Commands of pages that do not steer.
_ANYBODY = ("watch", "layers", "landmarks", "snapshot")

# What a page is told that asks a loop for what only played time can do.
_NOT_PLAYED = "a loop that runs elsewhere keeps its own time and switches: this is done to simulations alone"


class Server:
    """Serves a session from a thread of its own.

    Args:
        session: The session.
        folder: Where tests are saved.
        study: The file of the study in which drives are stored as trials; None: nowhere.
        vr: Lets headsets that open it lead a robot; None if none may. It is closed with the server.
        **address: Port, hosts and tls, see `Host`.

    Attributes:
        host: The web server.

    Raises:
        PortError: The port is taken.
        TlsError: The certificate cannot be used, or this machine has no such address.
    """

    def __init__(
        self,
        session: Session[Any],
        *,
        folder: Path = Path(),
        study: Path | None = None,
        vr: VirtualReality | None = None,
        **address: Any,
    ) -> None:
        routes: list[BaseRoute] = []
        if isinstance(session, PlayedSession):
            routes.append(Route("/camera/{name}", partial(_camera_image, session)))
        if vr is not None:
            routes.append(WebSocketRoute("/vr", until_closed(vr.serve)))
        self._session, self._folder, self._study, self._vr = session, folder, study, vr
        self._steering: Page | None = None
        self._pages: list[Page] = []
        self.host = Host(
            lambda: session.meshcat_url,
            script="view.js",
            packages=("vtbdrake.web.live", "vtbdrake.web.vr", "vtbdrake.visualization"),
            serve=self._serve_page,
            routes=routes,
            **address,
        )

    def close(self) -> None:
        """End the server and all its connections."""
        if self._vr is not None:
            self._vr.close()  # First: the robot is released while its session still runs.
        self.host.close()

    def vr_description(self) -> dict[str, Any]:
        """Return the description of virtual reality for a page; empty if there is none."""
        return {} if self._vr is None else self._vr.description()

    async def _serve_page(self, browser: WebSocket) -> None:
        page = Page(self._session, browser, self._folder, self._study)
        self._pages.append(page)
        if self._steering is None:
            self._steering = page
        try:
            await page.serve(self)
        finally:
            self._pages.remove(page)
            with suppress(SessionError):
                if self._steering is page:
                    await page.let_go("the page that drove is closed")
                    self._steering = next(iter(self._pages), None)
                await run_in_threadpool(self._session.watch, page, ())
                await run_in_threadpool(self._session.show, page, ())

    def steers(self, page: Page) -> bool:
        """Return whether a page may change anything: one at a time."""
        return self._steering is page

    async def take_over(self, page: Page) -> None:
        """Let a page steer, instead of the one that does."""
        if self._steering is not None:
            self._steering.drives = False
        self._steering = page
        if isinstance(self._session, PlayedSession):
            await run_in_threadpool(self._session.deflect, {})


async def _camera_image(session: PlayedSession[Any], request: Request) -> Response:
    """Return the present image of a camera as a JPEG."""
    try:
        data = await run_in_threadpool(_encoded_image, session, request.path_params["name"])
    except LayerError as error:
        return PlainTextResponse(one_line(error), status_code=404)
    except FAILURES as error:
        return PlainTextResponse(one_line(error), status_code=503)
    return Response(data, media_type="image/jpeg", headers={"Cache-Control": "no-store"})


def _encoded_image(session: PlayedSession[Any], camera: str) -> bytes:
    data = io.BytesIO()
    Image.fromarray(session.camera_image(camera)).save(data, "JPEG", quality=_JPEG_QUALITY)
    return data.getvalue()


class Page:
    """The connection to one page.

    Args:
        session: The session that is shown.
        browser: The connection to the browser.

    Attributes:
        drives: Whether it holds the sticks of a drive, and says so again and again (``deflect``).
        folder: Where it saves tests.
        study: The file of the study in which it stores drives as trials; None: nowhere.
    """

    def __init__(self, session: Session[Any], browser: WebSocket, folder: Path, study: Path | None) -> None:
        self._session, self.folder, self.study = session, folder, study
        self._browser = browser
        self._watched: tuple[str, ...] = ()
        # Commands that have been carried out, each with the number of the last frame that may be older.
        self._carried_out: deque[tuple[int, int]] = deque()
        self._reflected = 0
        self.drives = False
        self._commands: dict[str, Callable[[Mapping[str, Any]], Any]] = {
            "write": lambda message: session.write(message["values"], **_comparison(session, message)),
            "reset": lambda _: session.reset(),
            "watch": self._watch,
            "layers": lambda message: session.show(self, message["layers"]),
        }
        if isinstance(session, PlayedSession):
            self._commands |= {name: partial(action, self, session) for name, action in _PLAYED.items()}
        if isinstance(session, LogSession):
            self._commands["go_on"] = lambda _: session.go_on()

    async def serve(self, server: Server) -> None:
        """Answer commands, and send frames."""
        await send(self._browser, {"type": "hello", **self._description(), "vr": server.vr_description()})
        await first_of(
            self._send_frames(server),
            answer_commands(
                self._browser, lambda message: self._carry_out(message, server), next_frame=self._next_frame
            ),
        )

    def _description(self) -> dict[str, Any]:
        """Return the description of the session for a page, with the commands that it carries out."""
        session = self._session
        played = session if isinstance(session, PlayedSession) else None
        problem = None if played is None else played.problem
        return {
            "scenario": session.scenario.name(),
            "commands": list(self._commands),
            "variables": dict(session.variables),
            "tints": {**TINTS, "perceived": PERCEIVED_TINT},
            "opening": opening_addresses(session.variables),
            "bodies": list(session.bodies),
            "followed": session.followed,
            "layers": dict(session.layers),
            "cameras": list(session.cameras),
            "handles": [] if played is None else [handle.description() for handle in played.handles.values()],
            "quality": "" if problem is None else problem.objectives[0].name,
            "study": "" if self.study is None else self.study.name,
            "log": session.log_path if isinstance(session, LogSession) else "",
            "loop": session.loop_url if isinstance(session, LoopSession) else "",
        }

    async def _next_frame(self, browser: WebSocket) -> str | bytes:
        """Return the content of the next frame; if the page drives and none comes in time, let go meanwhile.

        The time counts from when the last command has been carried out, so that a slow simulation releases nothing.
        """
        coming = asyncio.create_task(receive(browser))
        try:
            if self.drives:
                await asyncio.wait([coming], timeout=RELEASE_TIME)
                if not coming.done():
                    await self.let_go(f"the page that drove was silent for {RELEASE_TIME:g} s")
            return await coming
        finally:
            coming.cancel()

    async def let_go(self, reason: str) -> None:
        """Release the sticks that this page holds, and let time stand still."""
        if self.drives and isinstance(self._session, PlayedSession):
            self.drives = False
            await run_in_threadpool(self._session.let_go, reason)

    async def _send_frames(self, server: Server) -> None:
        number = 0
        while True:
            frame = await run_in_threadpool(self._session.wait_for_frame, number, _PATIENCE)
            if frame is None:
                continue
            number = frame.number
            while self._carried_out and self._carried_out[0][1] < number:
                self._reflected, _ = self._carried_out.popleft()
            values = {address: frame.values[address] for address in self._watched if address in frame.values}
            shown = {**asdict(frame), "values": values, "speed": _finite(frame.speed), "reflects": self._reflected}
            await send(self._browser, {"type": "frame", "steers": server.steers(self), **shown})
            await asyncio.sleep(_FRAME_PERIOD)

    async def _carry_out(self, message: Mapping[str, Any], server: Server) -> Any:
        try:
            return await self._done(message, server)
        finally:
            if isinstance(number := message.get("id"), int) and (latest := self._session.latest) is not None:
                self._carried_out.append((number, latest.number))

    async def _done(self, message: Mapping[str, Any], server: Server) -> Any:
        if (name := message.get("do")) == "take over":
            return await server.take_over(self)
        if isinstance(name, str) and name in _PLAYED and name not in self._commands:
            raise SessionError(_NOT_PLAYED)
        action = action_of(message, self._commands)
        if name not in _ANYBODY and not server.steers(self):
            raise SessionError("another page steers this session: take over first")
        return await run_in_threadpool(action, message)

    def _watch(self, message: Mapping[str, Any]) -> None:
        self._session.watch(self, message["addresses"])
        self._watched = tuple(message["addresses"])


def _comparison(session: Session[Any], message: Mapping[str, Any]) -> dict[str, bool]:
    """Return whether the course without a change is to go on, for those sessions that can let it."""
    compare = bool(message.get("compare", False))
    if isinstance(session, PlayedSession):
        return {"compare": compare}
    if compare:
        raise SessionError("a running loop has one course: leave the comparison out")
    return {}


def _snapshot(_: Page, session: PlayedSession[Any], message: Mapping[str, Any]) -> str:
    """Return a file with the present and the camera of the page, in base64."""
    camera = Viewpoint(tuple(message["position"]), tuple(message["target"]))
    noted = replace(session.snapshot(), notes=camera.notes)
    return base64.b64encode(noted.to_bytes()).decode()


def _drive(_: Page, session: PlayedSession[Any], message: Mapping[str, Any]) -> bool:
    compare = bool(message.get("compare", False))
    session.drive(message["addresses"], returning=message.get("returning", ()), compare=compare)
    return True


def _deflect(page: Page, session: PlayedSession[Any], message: Mapping[str, Any]) -> None:
    session.deflect(message["deflections"])
    page.drives = True


def _end_drive(page: Page, session: PlayedSession[Any], message: Mapping[str, Any]) -> dict[str, Any]:
    driven = session.end_drive(keep=bool(message["keep"]))
    page.drives = False
    return driven.summary()


def _store_trial(page: Page, session: PlayedSession[Any], _: Mapping[str, Any]) -> str:
    if page.study is None:
        raise SessionError("no study was given: begin the page with one (--study FILE)")
    drive = session.store_trial(page.study)
    return f"stored as the driven trial {drive.number} of {page.study.name}"


def _save_test(page: Page, session: PlayedSession[Any], message: Mapping[str, Any]) -> str:
    name = str(message["name"])
    if not re.fullmatch(r"[a-z0-9_]{1,80}", name):
        raise SessionError(f"the name of a test has small letters, digits and _, not {name!r}")
    path = page.folder / f"test_{name}.py"
    session.save_test(path)
    return str(path)


# Commands of a page whose time is played, and what they do with the message.
_PLAYED: dict[str, Callable[[Page, PlayedSession[Any], Mapping[str, Any]], Any]] = {
    "play": lambda page, session, message: session.play(),
    "pause": lambda page, session, message: session.pause(),
    "step": lambda page, session, message: session.advance(int(message.get("steps", 1))),
    "speed": lambda page, session, message: session.set_speed(float(message["speed"])),
    "seek": lambda page, session, message: session.seek(message["time"], wait=False),
    "switch": lambda page, session, message: session.switch(
        message.get("mode"), sense=message.get("sense"), act=message.get("act")
    ),
    "preview": lambda page, session, message: session.preview(message["values"]),
    "cancel_preview": lambda page, session, message: session.cancel_preview(),
    "cancel_comparison": lambda page, session, message: session.cancel_comparison(),
    "landmarks": lambda page, session, message: session.landmarks(message["near"], int(message["count"])),
    "snapshot": _snapshot,
    "drive": _drive,
    "deflect": _deflect,
    "end_drive": _end_drive,
    "save_test": _save_test,
    "store_trial": _store_trial,
}


def _finite(value: float) -> float | str:
    return value if value < float("inf") else "unlimited"
