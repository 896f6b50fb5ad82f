"""Tests of who gets into a page, in a browser: tickets, and pages that would show it in a frame."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from shutil import which

import pytest
from playwright.sync_api import Browser, Page

from tests.chromium import PATIENCE, needs_chromium
from vtbdrake.web.serving.host import Host

pytestmark = [pytest.mark.one_python, needs_chromium]

COMMON = Path(__file__).parents[3] / "vtbdrake" / "web" / "serving" / "page" / "common.js"


class Framing(BaseHTTPRequestHandler):
    """A page at another port of this machine, with frames of all that its address names."""

    def do_GET(self) -> None:
        frames = "".join(f'<iframe src="{url}"></iframe>' for url in self.path.partition("?")[2].split(",") if url)
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(f"<!DOCTYPE html><body>this is a page {frames}</body>".encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def other_port() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), Framing)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture(scope="module")
def host(other_port: str) -> Iterator[Host]:
    """A server of a page that draws nothing, which would be slow."""
    running = Host(lambda: other_port)
    yield running
    running.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    opened = browser.new_page()
    opened.set_default_timeout(PATIENCE)
    yield opened
    opened.close()


def entered(page: Page, url: str) -> str:
    """The address of the page into which an address leads."""
    page.goto(url)
    page.wait_for_url(re.compile(r"/[\w-]{22}/$"))
    return page.url


def test_address_leads_one_browser_into_a_session_without_cookies(host: Host, page: Page) -> None:
    url = host.address()
    session = entered(page, url)
    assert "this is a page" in page.inner_text("body") and page.context.cookies() == []
    assert url.split("#")[1] not in session
    page.reload()
    assert "this is a page" in page.inner_text("body")
    page.goto("about:blank")
    page.goto(url)
    page.wait_for_function("document.body.innerText.includes('was used already')")
    # A good address that is typed over it.
    entered(page, host.address())


# Shows a ticket to a server, in a process without anything of ours.
SHOW = """
import sys, urllib.error, urllib.request
try:
    print(urllib.request.urlopen(sys.argv[1], sys.argv[2].encode()).status)
except urllib.error.HTTPError as error:
    print(error.code, error.read().decode())
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be another user")
def test_ticket_on_a_command_line_is_good_for_programs_of_this_user_alone(
    host: Host, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    host.open_browser()
    base, _, ticket = opened[0].partition("#")

    def show(user: int) -> str:
        command = [which("python3", path=os.defpath) or sys.executable, "-I", "-c", SHOW, f"{base}enter", ticket]
        return subprocess.run(command, user=user, cwd="/", capture_output=True, text=True, check=True).stdout

    assert show(65534).startswith("403 this address is for a browser of another user")
    assert show(0) == "200\n"
    assert show(0).startswith("403 this address is not valid, or was used already")


@pytest.mark.slow
def test_page_at_another_port_cannot_show_the_page_in_a_frame(host: Host, page: Page, other_port: str) -> None:
    session = entered(page, host.address())
    notebook = f"{host.address().split('#')[0]}{host.framed_path()}"
    addresses = [
        session,
        host.address().split("#")[0],
        f"{notebook}?in=http://localhost:1",
        f"{notebook}?in={other_port}",  # The notebook itself may.
    ]
    page.goto(f"{other_port}/?{','.join(addresses)}", wait_until="load")
    shown = [frame.evaluate("document.body.innerText") for frame in page.frames[1:]]
    assert ["refused to connect" in text for text in shown] == [True, True, True, False]
    assert "this is a page" in shown[3]


@pytest.mark.slow
def test_what_is_refused_is_told_and_has_no_result(page: Page) -> None:
    told = page.evaluate(
        """async (source) => {
            const { Telling } = await import(`data:text/javascript,${encodeURIComponent(source)}`);
            const page = new Telling();
            const refused = await page.orTell(Promise.reject(new Error("no drive")));
            const done = [await page.orTell(Promise.resolve(null)), await page.orTell(Promise.resolve("a.py"))];
            return [refused === undefined, done, page.say("x") === undefined, page.messages.innerHTML];
        }""",
        COMMON.read_text(),
    )
    assert told == [True, [None, "a.py"], True, '<p class="">x</p><p class="bad">no drive</p>']
