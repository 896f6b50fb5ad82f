"""The browser's end of the live page, in a process of its own: a client that reads all that it is sent, and clicks."""

from __future__ import annotations

import json
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager, suppress
from multiprocessing import get_context
from typing import Any, TypeVar

import msgpack  # type: ignore[import-untyped]
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from tests.web.serving.entrance import entered

STAMP = "/drake/stamp"
"""A path whose transform has the time on the monotonic clock, in s, at which the state was drawn."""

_PATIENCE = 120.0
_T = TypeVar("_T")


@contextmanager
def client(function: Callable[..., _T], *arguments: Any):  # type: ignore[no-untyped-def]
    """Run a function of this module in another process; yield a function that waits for its result."""
    with get_context("spawn").Pool(1) as pool:
        result = pool.apply_async(function, arguments)
        yield lambda: result.get(_PATIENCE)


def open_socket(url: str, path: str = "session") -> ClientConnection:
    """Connect as a page at this address, see `entered`, does: to the session, or with an empty path to Meshcat."""
    return connect(f"{url.replace('http', 'ws', 1)}{path}", max_size=None, open_timeout=_PATIENCE, compression=None)


def read_states(url: str, seconds: float) -> dict[str, Any]:
    """Read both sockets for a time; return the times at which states came in, their ages and the messages, in s."""
    arrivals: list[float] = []
    ages: list[float] = []
    counts = {"messages": 0, "frames": 0}
    url = entered(url)
    threading.Thread(target=_read_frames, args=(url, counts), daemon=True).start()
    with open_socket(url, "") as meshcat:
        end = time.monotonic() + seconds
        with suppress(TimeoutError, ConnectionClosed):
            while (left := end - time.monotonic()) > 0.0:
                message = msgpack.unpackb(meshcat.recv(left))
                counts["messages"] += 1
                if message.get("path") == STAMP and message["type"] == "set_transform":
                    now = time.monotonic()
                    arrivals.append(now)
                    ages.append(now - message["matrix"][12])
    return {"arrivals": arrivals, "ages": ages, **counts}


def read_states_in_chromium(url: str, seconds: float) -> dict[str, Any]:
    """Do the same in a page in Chromium without a graphics card; ``drawn`` is the number of frames that it draws."""
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(1e3 * _PATIENCE)
        page.goto(url)
        page.wait_for_selector("body[data-session=open][data-frame]", state="attached")
        page.evaluate(_COUNT, [STAMP, time.time() - time.monotonic()])
        page.wait_for_timeout(1e3 * seconds)
        drawn = "viewer.renderer.info.render.frame - counted.first"
        counted: dict[str, Any] = page.evaluate(f"({{...counted, drawn: {drawn}}})")
        browser.close()
    return counted


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
_COUNT = """([path, offset]) => {
    window.counted = { arrivals: [], ages: [], first: viewer.renderer.info.render.frame };
    const handle = viewer.handle_command.bind(viewer);
    viewer.handle_command = (command) => {
        handle(command);
        if (command.path !== path || command.type !== "set_transform") return;
        const now = (performance.timeOrigin + performance.now()) / 1000 - offset;
        counted.arrivals.push(now);
        counted.ages.push(now - command.matrix[12]);
    };
}"""


def _read_frames(url: str, counts: dict[str, int]) -> None:
    with open_socket(url) as session, suppress(ConnectionClosed):
        while True:
            counts["frames"] += json.loads(session.recv(_PATIENCE))["type"] == "frame"


class _Steering:
    """A page that steers, and reads the frames meanwhile."""

    def __init__(self, url: str) -> None:
        self._socket = open_socket(url)
        self._number = 0

    def command(self, do: str, **fields: Any) -> float:
        """Carry out a command, and return the time in s until its answer."""
        self._number += 1
        begin = time.monotonic()
        self._socket.send(json.dumps({"id": self._number, "do": do, **fields}))
        while True:
            message = json.loads(self._socket.recv(_PATIENCE))
            if message["type"] == "answer" and message["id"] == self._number:
                if message["error"]:
                    raise RuntimeError(message["error"])
                return time.monotonic() - begin


def click(url: str, address: str, count: int, pause: float) -> list[float]:
    """Set a variable again and again, with a pause in s; return the times in s until each was confirmed."""
    page = _Steering(entered(url))
    page.command("play")
    times = []
    for k in range(count):
        times.append(page.command("write", values={address: 1.0 + 1e-3 * (k % 2)}))
        time.sleep(pause)
    return times


def preview(url: str, address: str, count: int, pause: float) -> list[float]:
    """Drag a slider again and again; return the times in s from each draft to the first pose of its ghost."""
    url = entered(url)
    page, shown = _Steering(url), threading.Event()

    def watch() -> None:
        with open_socket(url, "") as meshcat, suppress(ConnectionClosed):
            while True:
                message = msgpack.unpackb(meshcat.recv(_PATIENCE))
                if message["type"] == "set_transform" and message["path"].startswith("/drake/ghosts/preview/"):
                    shown.set()

    threading.Thread(target=watch, daemon=True).start()
    page.command("play")
    times = []
    for k in range(count):
        page.command("cancel_preview")
        time.sleep(pause)
        shown.clear()
        begin = time.monotonic()
        page.command("preview", values={address: 1.0 + 1e-3 * k})
        if not shown.wait(_PATIENCE):
            raise RuntimeError("no ghost has come")
        times.append(time.monotonic() - begin)
    return times
