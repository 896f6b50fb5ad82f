"""The web server of a session: its pages, one of which steers."""

from __future__ import annotations

import asyncio
import base64
import io
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from PIL import Image
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from vtbdrake.failures import FAILURES, one_line
from vtbdrake.visualization.camera import Camera
from vtbdrake.web.host import Host, answer_commands, first_of, send, until_closed
from vtbdrake.web.layers import LayerError
from vtbdrake.web.session import Session, SessionError
from vtbdrake.web.vr import VirtualReality

_FRAME_PERIOD = 0.05  # s of wall time between two frames for a page
_PATIENCE = 1.0  # s, for a frame
_JPEG_QUALITY = 80
_ANYBODY = ("watch", "layers", "landmarks", "snapshot")  # commands of pages that do not steer


class Server:
    """Serves a session from a thread of its own.

    Args:
        session: The session.
        folder: Where tests are saved.
        study: The file of the study in which drives are stored as trials; None: nowhere.
        vr: Lets headsets that open it lead a robot; None if none may. It is closed with the server.
        **address: Port, hosts and tls, see `Host`.

    Attributes:
        url: The address of the page, with its token.

    Raises:
        PortError: The port is taken.
        TlsError: The certificate cannot be used, or this machine has no such address.
    """

    def __init__(
        self,
        session: Session,
        *,
        folder: Path = Path(),
        study: Path | None = None,
        vr: VirtualReality | None = None,
        **address: Any,
    ) -> None:
        routes: list[BaseRoute] = [Route("/camera/{name}", self._camera_image)]
        if vr is not None:
            routes.append(WebSocketRoute("/vr", until_closed(vr.serve)))
        self._session, self._folder, self._study, self._vr = session, folder, study, vr
        self._steering: Page | None = None
        self._pages: list[Page] = []
        self._host = Host(
            session.meshcat_url,
            script="view.js",
            serve=self._serve_page,
            routes=routes,
            **address,
        )
        self.url = self._host.url

    def close(self) -> None:
        """End the server and all its connections."""
        if self._vr is not None:
            self._vr.close()  # First: the robot is released while its session still runs.
        self._host.close()

    def vr_description(self) -> dict[str, Any]:
        """Return what a page has to know of virtual reality; empty if there is none."""
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
                    await run_in_threadpool(self._session.deflect, {})  # Its keys are released.
                    self._steering = next(iter(self._pages), None)
                await run_in_threadpool(self._session.watch, page, ())
                await run_in_threadpool(self._session.show, page, ())

    async def _camera_image(self, request: Request) -> Response:
        """Return the present image of a camera as a JPEG."""
        try:
            data = await run_in_threadpool(self._encoded_image, request.path_params["name"])
        except LayerError as error:
            return PlainTextResponse(one_line(error), status_code=404)
        except FAILURES as error:
            return PlainTextResponse(one_line(error), status_code=503)
        return Response(data, media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    def _encoded_image(self, camera: str) -> bytes:
        data = io.BytesIO()
        Image.fromarray(self._session.camera_image(camera)).save(data, "JPEG", quality=_JPEG_QUALITY)
        return data.getvalue()

    def steers(self, page: Page) -> bool:
        """Return whether a page may change anything: one at a time."""
        return self._steering is page

    async def take_over(self, page: Page) -> None:
        """Let a page steer, instead of the one that does."""
        self._steering = page
        await run_in_threadpool(self._session.deflect, {})


class Page:
    """The connection to one page."""

    def __init__(self, session: Session, browser: WebSocket, folder: Path, study: Path | None) -> None:
        self._session, self._folder, self._study = session, folder, study
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
            "snapshot": self._snapshot,
            "drive": self._drive,
            "deflect": lambda message: session.deflect(message["deflections"]),
            "end_drive": self._end_drive,
            "layers": lambda message: session.show(self, message["layers"]),
            "landmarks": lambda message: session.landmarks(message["near"], int(message["count"])),
            "save_test": self._save_test,
            "go_on": lambda _: session.go_on(),
            "store_trial": self._store_trial,
        }

    async def serve(self, server: Server) -> None:
        """Answer commands, and send frames."""
        problem = self._session.problem
        hello = {
            "type": "hello",
            "scenario": self._session.scenario.name(),
            "variables": dict(self._session.variables),
            "bodies": list(self._session.bodies),
            "followed": self._session.followed,
            "vr": server.vr_description(),
            "log": self._session.log_path,
            "study": "" if self._study is None else self._study.name,
            "quality": "" if problem is None else problem.objectives[0].name,
            "handles": [handle.description() for handle in self._session.handles.values()],
            "layers": dict(self._session.layers),
            "cameras": list(self._session.cameras),
            "loop": self._session.loop_url,
        }
        await send(self._browser, hello)
        await first_of(
            self._send_frames(server), answer_commands(self._browser, lambda message: self._carry_out(message, server))
        )

    async def _send_frames(self, server: Server) -> None:
        number = 0
        while True:
            frame = await run_in_threadpool(self._session.wait_for_frame, number, _PATIENCE)
            if frame is None:
                continue
            number = frame.number
            values = {address: frame.values[address] for address in self._watched if address in frame.values}
            shown = {**asdict(frame), "values": values, "speed": _finite(frame.speed)}
            await send(self._browser, {"type": "frame", "steers": server.steers(self), **shown})
            await asyncio.sleep(_FRAME_PERIOD)

    async def _carry_out(self, message: Mapping[str, Any], server: Server) -> Any:
        name = message.get("do")
        if name == "take over":
            return await server.take_over(self)
        if name not in self._commands:
            raise SessionError(f"there is no command {name!r}; there are: {', '.join(self._commands)}")
        if name not in _ANYBODY and not server.steers(self):
            raise SessionError("another page steers this session: take over first")
        return await run_in_threadpool(self._commands[name], message)

    def _snapshot(self, message: Mapping[str, Any]) -> str:
        """Return a file with the present and the camera of the page, in base64."""
        camera = Camera(tuple(message["position"]), tuple(message["target"]))
        noted = replace(self._session.snapshot(), notes=camera.notes)
        return base64.b64encode(noted.to_bytes()).decode()

    def _drive(self, message: Mapping[str, Any]) -> bool:
        compare = bool(message.get("compare", False))
        self._session.drive(message["addresses"], returning=message.get("returning", ()), compare=compare)
        return True

    def _end_drive(self, message: Mapping[str, Any]) -> dict[str, Any]:
        return self._session.end_drive(keep=bool(message["keep"])).summary()

    def _store_trial(self, _: Mapping[str, Any]) -> str:
        if self._study is None:
            raise SessionError("no study was given: begin the page with one (--study FILE)")
        drive = self._session.store_trial(self._study)
        return f"stored as the driven trial {drive.number} of {self._study.name}"

    def _save_test(self, message: Mapping[str, Any]) -> str:
        name = str(message["name"])
        if not re.fullmatch(r"[a-z0-9_]{1,80}", name):
            raise SessionError(f"the name of a test has small letters, digits and _, not {name!r}")
        path = self._folder / f"test_{name}.py"
        self._session.save_test(path)
        return str(path)

    def _watch(self, message: Mapping[str, Any]) -> None:
        self._session.watch(self, message["addresses"])
        self._watched = tuple(message["addresses"])


def _finite(value: float) -> float | str:
    return value if value < float("inf") else "unlimited"
