"""Tests of views in notebooks: a cell that is really run, its output in a browser, and readers without a kernel."""

from __future__ import annotations

import json
import re
import urllib.error
import urllib.request
from base64 import b64decode
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from threading import Thread

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image
from playwright.sync_api import Browser, Page
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from tests.chromium import needs_chromium, new_page
from vtbdrake.web import View, view
from vtbdrake.web.serving.notebook_frame import page_bundle
from vtbdrake_diagrams.cart_pole import CartPoleScenario

pytestmark = pytest.mark.one_python

ROOT = Path(__file__).parents[3]
SCRIPT = ROOT / "vtbdrake" / "web" / "serving" / "page" / "notebook.js"
ANGLE = "sim.sys.cart_pole.pole_pin.position"
CODE = f"""
from vtbdrake_diagrams.cart_pole import CartPoleScenario
testbed = CartPoleScenario().build()
view = testbed.view(values={{"{ANGLE}": 2.0}})
view
"""

BUSY = """
from time import sleep
view.session.set_speed(2.0)
while view.session.snapshot().time == 0.0:
    sleep(0.01)
view.session.snapshot().time
"""


@pytest.fixture(scope="module")
def running() -> Iterator[View]:
    with view(CartPoleScenario()) as opened:
        yield opened


def framed(running: View) -> str:
    """The address of the frame in a notebook's output."""
    settings = re.search(r"show\(place, ({.*?})\);", running._repr_mimebundle_()["text/html"])
    assert settings is not None
    place = json.loads(settings[1])
    return f"http://127.0.0.1:{place['port']}/{place['path']}"


# -- the session in the path


def status(url: str, headers: dict[str, str] | None = None) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers or {}), timeout=60) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


PROXY = {"Host": "hub.example", "Origin": "https://hub.example"}


@pytest.mark.slow
def test_page_of_a_notebook_works_behind_a_proxy(running: View) -> None:
    url, base = framed(running), running.url.split("#")[0]
    with urllib.request.urlopen(url) as answer:
        viewer = re.findall(r'<script[^>]* src="([^"]*)"', answer.read().decode())
    assert len(viewer) == 2  # Meshcat's and ours
    for path in ("", *viewer, "page/vendor/uPlot.min.css"):
        assert status(f"{url}{path}", PROXY) == 200, path
        assert status(f"{base}{path}", PROXY) == 403
        assert status(f"{url[:-2]}/{path}", PROXY) == 403
    assert status(url[:-1]) == 403  # Without a slash, relative addresses would miss the session.


def test_sockets_of_a_notebook_work_behind_a_proxy(running: View) -> None:
    url, base = (text.replace("http", "ws", 1) for text in (framed(running), running.url.split("#")[0]))
    for path in ("session", ""):
        with connect(f"{url}{path}", origin="https://hub.example", max_size=None) as socket:
            assert socket.recv(timeout=60)
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"{base}wrong/{path}", origin="https://hub.example")


# -- the bundle


def pixels(bundle: dict[str, str]) -> np.ndarray:
    """The picture in a bundle, shape (height, width, 3)."""
    return np.asarray(Image.open(BytesIO(b64decode(bundle["image/png"]))).convert("RGB")).astype(int)


def test_bundle_has_a_picture_of_the_present_for_readers_without_a_kernel(running: View) -> None:
    bundle = running._repr_mimebundle_()
    image = pixels(bundle)
    assert image.shape == (400, 640, 3)
    orange = np.argwhere((image[..., 0] > 150) & (image[..., 2] < 80))  # the mass at the pole's tip
    assert len(orange) > 100
    running.session.write({ANGLE: 3.0})
    turned = np.asarray(Image.open(BytesIO(b64decode(running._repr_mimebundle_()["image/png"]))).convert("RGB")).astype(
        int
    )
    # It hung, and stands now.
    assert np.argwhere((turned[..., 0] > 150) & (turned[..., 2] < 80))[:, 0].mean() < orange[:, 0].mean() - 100
    running.session.reset()
    assert bundle["text/plain"] == "<View of vtbdrake_diagrams.cart_pole.scenario:CartPoleScenario>"


@pytest.fixture
def empty_page(browser: Browser) -> Iterator[Page]:
    page = new_page(browser)
    yield page
    page.close()


@pytest.mark.slow
@needs_chromium
def test_address_is_that_of_the_front_end(empty_page: Page) -> None:
    def address(prefix: str = "", google: str = "undefined", **location: str) -> str:
        settings = json.dumps({"port": 4321, "path": "TOKEN/", "prefix": prefix})
        place = json.dumps({"hostname": "", "protocol": "http:", "href": "about:blank", **location})
        config = 'getElementById: () => ({ textContent: \'{"baseUrl": "/lab/user/"}\' })'
        window = f"{{ location: {place}, google: {google}, document: {{ {config} }} }}"
        return str(empty_page.evaluate(f"() => {{ {SCRIPT.read_text()}; return addressOf({settings}, {window}); }}"))

    assert address(hostname="localhost") == "http://localhost:4321/TOKEN/"
    assert address(hostname="127.0.0.1") == "http://127.0.0.1:4321/TOKEN/"
    hub = {"hostname": "hub.example", "href": "https://hub.example/user/ada/lab/tree/a.ipynb"}
    assert address(prefix="/user/ada/", **hub) == "https://hub.example/user/ada/proxy/4321/TOKEN/"
    assert address(**hub) == "https://hub.example/lab/user/proxy/4321/TOKEN/"
    local = {"hostname": "localhost", "href": "http://localhost:8000/user/ada/lab"}
    assert address(prefix="/user/ada/", **local) == "http://localhost:8000/user/ada/proxy/4321/TOKEN/"
    assert address(protocol="vscode-webview:", hostname="0abc") == "http://localhost:4321/TOKEN/"
    colab = "{ colab: { kernel: { proxyPort: async (port) => `https://${port}-colab.example/` } } }"
    assert address(google=colab, hostname="x.googleusercontent.com") == "https://4321-colab.example/TOKEN/"


# -- a notebook that is run


class FrontEnd(BaseHTTPRequestHandler):
    """A notebook's front end: an empty page at another port of this machine."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!DOCTYPE html><title>notebook</title><main></main>")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def front_end() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), FrontEnd)
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield f"http://localhost:{server.server_port}/lab/tree/a.ipynb"
    server.shutdown()
    thread.join()
    server.server_close()


def show(page: Page, url: str, html: str) -> None:
    """Open a notebook with an output, as a front end does it: scripts of a cell are made anew."""
    page.goto(url)
    page.evaluate(
        """(html) => {
            const host = document.querySelector("main");
            host.innerHTML = html;
            for (const inert of host.querySelectorAll("script")) {
                const script = document.createElement("script");
                script.textContent = inert.textContent;
                inert.replaceWith(script);
            }
        }""",
        html,
    )


@pytest.mark.slow
@needs_chromium
def test_view_in_a_notebook_is_steered_while_its_kernel_computes(empty_page: Page, front_end: str) -> None:
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code) for code in (CODE, BUSY)])
    client = NotebookClient(notebook, timeout=300)
    with client.setup_kernel():
        cell = client.execute_cell(notebook.cells[0], 0)
        data = cell.outputs[-1]["data"]
        assert {"text/plain", "text/html", "image/png"} <= data.keys()
        show(empty_page, front_end, data["text/html"])
        empty_page.wait_for_selector("[data-state=open] iframe")
        frame = empty_page.frame_locator("iframe")
        frame.locator("body[data-session=open][data-frame]").wait_for(state="attached")
        assert not empty_page.context.cookies()
        # The next cell keeps the kernel busy until the page, which notices the speed, has made a step.
        frame.locator("body").evaluate(
            """() => {
                const timer = setInterval(() => {
                    if (vtb.speed.value !== "2") return;
                    clearInterval(timer);
                    document.getElementById("vtb-step").click();
                }, 20);
            }"""
        )
        busy = client.execute_cell(notebook.cells[1], 1)
        assert busy.outputs[-1]["data"]["text/plain"] == "0.0078125"
    # The kernel has ended: another opening of the stored output keeps the picture.
    show(empty_page, front_end, data["text/html"])
    empty_page.wait_for_selector("[data-state=unreachable]")
    assert empty_page.locator("iframe").count() == 0
    assert empty_page.evaluate("document.querySelector('img').naturalWidth") == 640


@pytest.mark.slow
@needs_chromium
def test_study_that_blocks_its_kernel_is_stopped_by_its_page(empty_page: Page, front_end: str, tmp_path: Path) -> None:
    begin = f"""
from tests.web.study.studies import cart_pole_problem
study = cart_pole_problem().study({str(tmp_path / "a.db")!r}, solver="random")
study.run(rollouts=4, executor="serial", progress=False)
study.view()
"""
    go_on = 'study.run(rollouts=1_000_000, executor="serial", progress=False).interventions[-1].kind'
    cells = [nbformat.v4.new_code_cell(code) for code in (begin, go_on)]
    client = NotebookClient(nbformat.v4.new_notebook(cells=cells), timeout=300, resources={"metadata": {"path": ROOT}})
    with client.setup_kernel():
        data = client.execute_cell(cells[0], 0).outputs[-1]["data"]
        assert pixels(data).shape[1] == 800  # the history
        show(empty_page, front_end, data["text/html"])
        frame = empty_page.frame_locator("iframe")
        frame.locator("body[data-session=open][data-trials]").wait_for(state="attached")
        frame.locator("body").evaluate(
            """(body) => {
                const timer = setInterval(() => {
                    if (Number(body.dataset.trials) < 8) return;
                    clearInterval(timer);
                    document.getElementById("vtb-stop").click();
                }, 20);
            }"""
        )
        assert client.execute_cell(cells[1], 1).outputs[-1]["data"]["text/plain"] == "'stop'"


def test_page_without_a_picture_has_its_text_only() -> None:
    bundle = page_bundle(1234, "abc/", {"text/plain": "<a study>"})
    assert bundle.keys() == {"text/plain", "text/html"}
    assert bundle["text/html"].startswith("<div>&lt;a study&gt;<script>")
