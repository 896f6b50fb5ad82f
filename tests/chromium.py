"""A Chromium without a window for tests of pages, and pictures of what it shows."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = (
    "--no-sandbox",
    # For WebGL alone: the rest of a page takes a third of the time to draw without it.
    "--use-angle=swiftshader-webgl",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
)
PATIENCE = 120_000  # ms
# Sizes of a page, in pixels: of a small screen and of a phone.
WIDE: ViewportSize = {"width": 1280, "height": 720}
PHONE: ViewportSize = {"width": 390, "height": 844}

# Ten pictures a second instead of sixty: each is drawn without a graphics card, which costs more than all else.
SLOW_PICTURES = """{
  const draw = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (callback) => setTimeout(() => draw(callback), 90);
  window.cancelAnimationFrame = clearTimeout.bind(window);
}
"""

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium: apt-get install chromium")


@contextmanager
def running_browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS])
        yield running
        running.close()


def new_page(browser: Browser, *, size: tuple[int, int] = (1000, 650), script: str = "") -> Page:
    """Return an empty page, which draws a few pictures a second; a script runs before the page's own."""
    width, height = size
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(PATIENCE)
    page.add_init_script(SLOW_PICTURES + script)
    return page


@contextmanager
def opened_page(
    browser: Browser, url: str, *, ready: str, size: tuple[int, int] = (1000, 650), script: str = ""
) -> Iterator[Page]:
    """A page, which must raise no error, from when it has an element that a selector finds.

    A script runs before the page's own.
    """
    page = new_page(browser, size=size, script=script)
    failures: list[str] = []
    page.on("pageerror", lambda error: failures.append(str(error)))
    page.goto(url)
    page.wait_for_selector(ready, state="attached")
    yield page
    page.close()
    assert not failures


def screenshot(page: Page, **options: Any) -> np.ndarray:
    """Return the picture of a page when all that has been sent to it is drawn, shape (height, width, 3)."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    image = Image.open(io.BytesIO(page.screenshot(timeout=PATIENCE, **options)))
    return np.asarray(image.convert("RGB")).astype(int)


def until(take: Callable[[], np.ndarray], shows: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Take pictures until one shows what it should, and return it; after a while the last one, which does not.

    The page knows from its own socket what it shows; the scene comes over Meshcat's, and may come later.
    """
    end = time.monotonic() + PATIENCE / 1e3
    while not shows(picture := take()) and time.monotonic() < end:
        pass
    return picture


def in_time(shows: Callable[[], Any]) -> bool:
    """Return whether pictures that are taken one after the other come to show what they should, see `until`."""
    end = time.monotonic() + PATIENCE / 1e3
    while not (shown := shows()) and time.monotonic() < end:
        pass
    return bool(shown)
