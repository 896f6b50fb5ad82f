"""Tests of exported recordings in a real browser: the first view, the quality curve and its clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.chromium import needs_chromium, new_page, screenshot
from tests.testbeds import AcrobotScenario
from vtbdrake.optimization import Motion
from vtbdrake.visualization import make_meshcat, show_motions

pytestmark = [pytest.mark.slow, needs_chromium]

END = 2.0  # s
SIZE = (800, 600)


def motion(speed: float, t_star: float) -> Motion:
    """An acrobot that turns at a speed about its shoulder, with a quality that falls linearly from 1 to 0."""
    times = np.linspace(0.0, END, 41)
    states = np.zeros((times.size, 4))
    states[:, 0] = speed * times
    return Motion(AcrobotScenario(), times, states, 1.0 - times / END, t_star)


@pytest.fixture
def page(browser: Browser, tmp_path: Path) -> Iterator[Page]:
    motions = {"fast": motion(1.0, 0.5), "<slow>": motion(0.0, 1.5)}
    scene = show_motions(
        make_meshcat(), motions, spacing=(0.0, 2.0, 0.0), colors={"fast": "#ff0000", "<slow>": "#0000ff"}
    )
    replace(scene, title="Moon & Mars").save(tmp_path / "recording.html", shared=True)
    opened = new_page(browser, size=SIZE)
    failures: list[str] = []
    opened.on("pageerror", lambda error: failures.append(str(error)))
    opened.goto((tmp_path / "recording.html").as_uri())
    opened.wait_for_function("document.body.dataset.time > 0")
    yield opened
    opened.close()
    assert not failures


def seek(page: Page, time: float) -> None:
    """Click into the quality curve at a time."""
    box = page.locator("#vtb-curves .u-over").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + box["width"] * time / END, box["y"] + 5)
    page.wait_for_function(f"Math.abs(document.body.dataset.time - {time}) < 0.02")


def pixels(image: np.ndarray, channel: int) -> np.ndarray:
    """Rows and columns of the pixels in which a channel is the strongest by far, outside of the overlays."""
    rest = np.delete(image, channel, axis=2).max(axis=2)
    strong = image[..., channel] > 1.5 * rest + 30
    strong[:130, :250] = strong[400:, :380] = False
    return np.argwhere(strong)


def test_recording_begins_with_all_in_view_and_its_curve_moves_it(page: Page) -> None:
    seek(page, 0.0)
    begin = screenshot(page)
    both = np.vstack([pixels(begin, 0), pixels(begin, 2)])
    assert min(len(pixels(begin, 0)), len(pixels(begin, 2))) > 200
    assert both.min() > 0 and np.all(both.max(axis=0) < np.array(begin.shape[:2]) - 1)
    assert (np.ptp(both, axis=0) / begin.shape[:2]).max() > 0.4
    # Only the fast one moves.
    seek(page, 1.9)
    end = screenshot(page)
    moved = np.abs(pixels(end, 0).mean(axis=0) - pixels(begin, 0).mean(axis=0)).max()
    rested = np.abs(pixels(end, 2).mean(axis=0) - pixels(begin, 2).mean(axis=0)).max()
    assert moved > 10.0 > 1.0 > rested
    turn = """() => {
        const { object } = viewer.scene_tree.find(["drake", "rollout", "fast", "Acrobot", "upper_link"]);
        return 2 * Math.asin(object.quaternion.y);
    }"""
    assert page.evaluate(turn) == pytest.approx(float(page.evaluate("Number(document.body.dataset.time)")), abs=1e-3)
    assert page.inner_text("#vtb-clock").startswith("t = 1.9")
    assert page.inner_text("#vtb-caption").splitlines()[:3] == ["Moon & Mars", "■ fast", "■ <slow>"]


def test_stars_lie_on_the_curves_at_t_star(page: Page) -> None:
    box = page.locator("#vtb-curves .u-over").bounding_box()
    assert box is not None
    seek(page, 1.0)  # It plays until then, and the line of its time must not lie on a star.
    image = screenshot(page)
    for time, channel in ((0.5, 0), (1.5, 2)):
        x = round(box["x"] + box["width"] * time / END)
        y = round(box["y"] + box["height"] * time / END)  # The quality falls from 1 to 0 over the range of the plot.
        assert np.all(image[y - 1 : y + 2, x - 1 : x + 2] > 230)  # the inside of the ring
        ring = image[y - 7 : y + 8, x - 7 : x + 8]
        assert np.count_nonzero(ring[..., channel] > np.delete(ring, channel, axis=2).max(axis=2) + 100) > 30
