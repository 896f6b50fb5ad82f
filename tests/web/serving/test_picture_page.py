"""Tests in a real browser: pages of other origins reach no Meshcat; what a page and a headset see if one does."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.chromium import PATIENCE, needs_chromium, opened_page
from tests.meshcats import listening
from tests.web.live.test_page import READY, picture, settle
from tests.web.live.test_session import ANGLE, START
from tests.web.vr.test_virtual_reality import becomes
from tests.web.vr.test_vr_page import state, worn
from vtbdrake.web import view
from vtbdrake_diagrams.cart_pole import CartPoleScenario

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]

# Tries to reach a WebSocket server, and sends a message without content to it; resolves to whether it was connected.
ATTACK = """(url) => new Promise((resolve) => {
  const socket = new WebSocket(url);
  socket.onopen = () => { socket.send(new Uint8Array(0)); socket.reached = true; };
  socket.onclose = () => resolve(Boolean(socket.reached));
})"""


class Silent(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing."""


@contextmanager
def foreign_page(browser: Browser, folder: Path) -> Iterator[Page]:
    """A page of another origin, in a browser that knows nothing of ours."""
    (folder / "index.html").write_text("<!doctype html><title>evil</title>")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    page = browser.new_page()
    page.set_default_timeout(PATIENCE)
    page.goto(f"http://127.0.0.1:{server.server_port}/")
    try:
        yield page
    finally:
        page.close()
        server.shutdown()
        thread.join()
        server.server_close()


def test_page_of_another_origin_finds_no_meshcat(browser: Browser, tmp_path: Path) -> None:
    before = listening(os.getpid())  # A Meshcat of an earlier test, which is not collected yet.
    with view(CartPoleScenario()) as running, foreign_page(browser, tmp_path) as evil:
        address = running.session.meshcat_url
        others = [each for each in listening(os.getpid()) if each not in {*before, address}]
        assert running.url.startswith(tuple(others)) and all("//127.0.0.1:" in each for each in others)
        # All that it could guess: what this process serves at the names of this machine.
        for port in {urlsplit(each).port for each in (address, *others)} - {urlsplit(evil.url).port}:
            for host in ("127.0.0.1", "localhost"):
                assert evil.evaluate(ATTACK, f"ws://{host}:{port}/") is False
        running.session.advance()
        assert running.session.meshcat_url == address


def test_page_tells_that_its_meshcat_has_died_and_goes_on_with_the_next(browser: Browser, tmp_path: Path) -> None:
    with (
        view(CartPoleScenario(), values=START) as running,
        foreign_page(browser, tmp_path) as evil,
        opened_page(browser, running.url, ready=READY) as page,
    ):
        session = running.session
        settle(page)
        before, url = picture(page), session.meshcat_url
        page.evaluate("window.isTheSame = true")
        page.keyboard.press("Space")
        page.wait_for_function("vtb.playing")
        assert evil.evaluate(ATTACK, url.replace("http", "ws")) is True  # It knows the address.
        page.wait_for_selector("[data-kind=picture]")
        assert "the server of the picture (Meshcat) has died" in page.inner_text("[data-kind=picture]")
        page.wait_for_function("parseFloat(vtb.clock.textContent) > 0.3")
        page.keyboard.press("Space")
        page.wait_for_function("!vtb.playing")
        session.reset()
        session.write({ANGLE: START[ANGLE] + 1.0})
        becomes(lambda: session.meshcat_url not in ("", url))
        settle(page)
        assert np.mean(np.abs(picture(page) - before).max(axis=2) > 30) > 0.002  # The pole is seen elsewhere.
        session.reset()
        settle(page)
        assert np.mean(np.abs(picture(page) - before).max(axis=2) > 30) < 0.0005  # All is where it was.
        assert page.evaluate("window.isTheSame") is True  # It was not loaded anew.
        assert session.meshcat_url not in ("", url)


def test_headset_is_disarmed_and_stays_in_virtual_reality(browser: Browser, tmp_path: Path) -> None:
    with worn(browser, "0") as headset, foreign_page(browser, tmp_path) as evil:
        page, session = headset.page, headset.running.session
        page.evaluate("quest.controllers.right.position.set(0.1, 1.5, -0.4)")
        headset.shown()
        page.evaluate("quest.controllers.right.updateButtonValue('squeeze', 1)")
        state(page, "data-vr=leading")
        url, when = session.meshcat_url, session.latest.time
        assert evil.evaluate(ATTACK, url.replace("http", "ws")) is True
        state(page, "data-vr=idle")
        assert "the picture of the robot was lost" in page.inner_text("#vtb-vr-state")
        becomes(lambda: session.meshcat_url not in ("", url) and session.latest.time > when + 0.1)
        assert page.evaluate("document.body.dataset.headset") == "entered"
        # The grip is still held: armed again, the robot is not led before it was let go.
        page.evaluate("document.querySelector('#vtb-vr-arm').click()")
        state(page, "data-vr=armed")
        headset.shown()
        assert page.evaluate("document.body.dataset.vr") == "armed"
        page.evaluate("quest.controllers.right.updateButtonValue('squeeze', 0)")
        headset.shown()
        page.evaluate("quest.controllers.right.updateButtonValue('squeeze', 1)")
        state(page, "data-vr=leading")
        start = headset.tip()
        page.evaluate("quest.controllers.right.position.set(0.1, 1.5, -0.45)")  # 5 cm ahead
        becomes(lambda: np.allclose(headset.tip(), start + np.array([0.05, 0, 0]), atol=1e-3))
        page.close()
