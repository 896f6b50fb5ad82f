"""A Chromium without a window for tests of pages, and pictures of what it shows."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
FLAGS = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-background-networking",
    "--disable-component-update",
)
PATIENCE = 120_000  # ms

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs a Chromium: apt-get install chromium")


@contextmanager
def running_browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS])
        yield running
        running.close()


@contextmanager
def opened_page(
    browser: Browser, url: str, *, ready: str, size: tuple[int, int] = (1000, 650), script: str = ""
) -> Iterator[Page]:
    """A page, which must raise no error, from when it has an element that a selector finds.

    A script runs before those of the page.
    """
    width, height = size
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(PATIENCE)
    failures: list[str] = []
    page.on("pageerror", lambda error: failures.append(str(error)))
    if script:
        page.add_init_script(script)
    page.goto(url)
    page.wait_for_selector(ready, state="attached")
    yield page
    page.close()
    assert not failures


def screenshot(page: Page, **options: Any) -> np.ndarray:
    """What a page shows when all that has been sent to it is drawn, shape (height, width, 3)."""
    page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    image = Image.open(io.BytesIO(page.screenshot(timeout=PATIENCE, **options)))
    return np.asarray(image.convert("RGB")).astype(int)
