"""Tests of the layers in a real browser: what is in the picture while they are shown, and not otherwise."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page

from tests.chromium import in_time, needs_chromium, opened_page
from tests.web.live.test_page import READY, drawn, picture, settle, share
from tests.web.live.test_session import ANGLE
from vtbdrake.testbed import Scenario
from vtbdrake.web import View, view
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cube_toss import CubeTossScenario
from vtbdrake_diagrams.satellite import SatelliteScenario

ORANGE, RED = np.array([214, 94, 0]), np.array([214, 0, 0])

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


@contextmanager
def shown(browser: Browser, scenario: Scenario, **values: object) -> Iterator[tuple[Page, View]]:
    """The page of a scenario."""
    with view(scenario, values=values) as running, opened_page(browser, running.url, ready=READY) as page:
        yield page, running


def toggle(page: Page, layer: str) -> None:
    page.click(f"[id='vtb-layer-{layer}']")
    settle(page)


def changed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return np.abs(after - before).max(axis=2) > 20


def test_contact_forces_and_names_come_and_go(browser: Browser) -> None:
    scenario = CubeTossScenario()
    at_rest = {"sim.sys.cube.pose": [0.0, 0.0, 0.5 * scenario.edge, 0.0, 0.0, 0.0]}
    with shown(browser, scenario, **at_rest) as (page, running):
        running.session.advance(20)
        settle(page)
        without = picture(page)
        toggle(page, "forces")
        with_forces = picture(page)
        new = changed(without, with_forces)
        assert new.mean() > 0.002
        assert share(with_forces[new][np.newaxis], ORANGE) > 0.5
        assert "3.63 N reach" in page.inner_text("#vtb-layers")  # 0.37 kg
        page.check("#vtb-layer-names")
        toggle(page, "forces")
        box = page.locator("#vtb-names span:text-is('cube')").bounding_box()
        assert box is not None and box["x"] > 340.0
        page.uncheck("#vtb-layer-names")
        drawn(page, "document.querySelectorAll('#vtb-names span').length === 0")
        assert in_time(lambda: changed(without, picture(page)).mean() < 1e-4)


def test_perceived_ghost_and_candidates_come_and_go(browser: Browser) -> None:
    with shown(browser, CartPoleScenario(onboard=True, rollouts=4)) as (page, running):
        running.session.advance(30)
        running.session.write({ANGLE: 1.0})  # The DPS has not perceived it yet.
        settle(page)
        without = picture(page)
        toggle(page, "perceived")
        new = changed(without, picture(page))
        assert new.mean() > 0.01
        red, green, blue = picture(page)[new].mean(axis=0)
        assert red > green + 5.0 and blue > green + 5.0  # purple
        toggle(page, "perceived")
        assert in_time(lambda: changed(without, picture(page)).mean() < 1e-4)
        toggle(page, "decisions")
        running.session.advance(20)
        drawn(page, "document.querySelector('#vtb-layers').textContent.includes('plan in use black')")
        settle(page)
        with_paths = picture(page)
        toggle(page, "decisions")
        assert in_time(lambda: changed(picture(page), with_paths).mean() > 0.001)


def test_laser_points_frustum_and_image_of_a_satellite(browser: Browser) -> None:
    with shown(browser, SatelliteScenario()) as (page, running):
        running.session.advance(135)  # The first scan ends at 1 s.
        settle(page)
        without = picture(page)
        toggle(page, "laser")
        assert in_time(lambda: share(picture(page), RED) > share(without, RED) + 2e-4)
        page.uncheck("#vtb-layer-laser")
        toggle(page, "cameras")
        new = changed(without, picture(page))
        assert 2e-4 < new.mean() < 0.02
        toggle(page, "cameras")
        assert in_time(lambda: changed(without, picture(page)).mean() < 1e-4)
        image = "sim.sense.docking_camera"
        page.check(f"[id='vtb-layer-image-{image}']")
        drawn(page, "document.querySelector('#vtb-images figure')?.dataset.images >= 2")
        inset = Image.open(io.BytesIO(page.locator("#vtb-images img").screenshot())).convert("RGB")
        expected = running.session.camera_image(image).astype(float)
        pixels = np.asarray(inset.resize(expected.shape[1::-1])).astype(float)
        assert np.corrcoef(pixels.ravel(), expected.ravel())[0, 1] > 0.95
        page.uncheck(f"[id='vtb-layer-image-{image}']")
        assert page.locator("#vtb-images figure").count() == 0
