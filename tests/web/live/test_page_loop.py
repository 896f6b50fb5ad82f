"""A test of the page of a loop that runs elsewhere, in a real browser."""

from __future__ import annotations

import numpy as np
import pytest
from playwright.sync_api import Browser

from tests.chromium import in_time, needs_chromium, new_page
from tests.web.live.loops import cart_pole_loop
from tests.web.live.test_page import drawn, picture, settle, watch
from vtbdrake.lcm.hub import Hub
from vtbdrake.monitoring import LiveClient
from vtbdrake.web.live.viewer import view_loop
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.dps import PERCEIVED

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


def test_loop_is_watched_until_it_ends(browser: Browser) -> None:
    sensors = {"joint_position": [0.0, 0.0], "joint_velocity": [0.0, 0.0]}
    with Hub(port=0) as bus, view_loop(CartPoleScenario(), bus.url) as running:
        page = new_page(browser)
        with cart_pole_loop(bus.url, lambda _: sensors):
            page.goto(running.url)
            page.wait_for_selector("body[data-loop=running]", state="attached")
            drawn(page, "document.querySelector('#vtb-mode').textContent === 'real'")
            settle(page)
            before = picture(page)
            sensors["joint_position"] = [0.3, 1.0]
            watch(page, PERCEIVED)
            drawn(page, f"vtb.watched.get('{PERCEIVED}').values[1] === 1.0")
            settle(page)
            assert in_time(lambda: np.mean(np.abs(picture(page) - before).max(axis=2) > 30) > 0.01)  # cart and pole
            assert page.is_disabled("#vtb-act-force") and page.input_value("#vtb-act-force") == "real"
            assert not page.is_visible("#vtb-play") and not page.is_visible("#vtb-history")
            assert "joint_position" in page.inner_text("#vtb-loop") and page.inner_text("#vtb-age").endswith("ms ago")
            page.fill("#vtb-panel input[type=search]", "u.plan")
            page.press("#vtb-panel input[type=search]", "Enter")  # a single match
            drawn(page, "vtb.watched.get('u.plan').values.length > 0")
            page.fill("[data-address='u.plan'] input[type=text][aria-label='u.plan force 1 in N']", "7")
            page.keyboard.press("Enter")
            drawn(page, "vtb.watched.get('u.plan').values[1] === 7")
            # Esc ends a drag: the release tells the loop nothing.
            page.click("[data-address='u.plan'] >> text=pad")
            page.locator("[data-address='u.plan'] .vtb-pad").scroll_into_view_if_needed()
            box = page.locator("[data-address='u.plan'] .vtb-pad").bounding_box()
            assert box is not None
            page.mouse.move(box["x"] + 20, box["y"] + 20)
            page.mouse.down()
            page.mouse.move(box["x"] + 70, box["y"] + 70, steps=3)
            drawn(page, "vtb.watched.get('u.plan').draft === 'open'")
            page.keyboard.press("Escape")
            page.mouse.up()
            settle(page)
            with LiveClient(bus.url) as client:
                assert client.get(["u.plan"])["u.plan"][1] == 7.0
            page.check("#vtb-layer-names")
            page.wait_for_selector("#vtb-names span:text-is('cart')", state="attached")
        page.wait_for_selector("body[data-loop=silent]", state="attached")
        assert "the loop has ended" in page.inner_text("#vtb-messages")
        assert page.inner_text("#vtb-mode") == "unknown"
        page.click("#vtb-reset")
        drawn(page, "document.querySelector('#vtb-messages').textContent.includes('no answer')")
        page.close()
