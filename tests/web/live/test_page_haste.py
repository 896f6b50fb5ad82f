"""Nothing that somebody does on the live page is lost, however early or fast it is beside the server."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.chromium import needs_chromium, opened_page
from tests.web.live.test_drive import LimitedPendulumScenario
from vtbdrake.web import View, view

READY = "body[data-session=open][data-frame]"

ANGLE = "u.angle"
SWITCH = "T_act.torque"
CENTER = "sim.sys.Pendulum.arm.center_of_mass"

# What the server says comes as a test wants it: `blind` frames have no values, `withheld` ones wait. `sent` has the
# commands of the page.
SOCKET = """{
  const Socket = window.WebSocket;
  Object.assign(window, { blind: true, withheld: false, waiting: [], sent: [] });
  window.WebSocket = class extends Socket {
    set onmessage(handler) {
      super.onmessage = (event) => {
        if (typeof event.data !== "string") return handler(event);
        const message = JSON.parse(event.data);
        if (message.type !== "frame") return handler(event);
        if (window.blind) message.values = {};
        const show = () => handler({ data: JSON.stringify(message) });
        if (window.withheld) window.waiting.push(show);
        else show();
      };
    }
    send(data) {
      if (typeof data === "string") window.sent.push(JSON.parse(data));
      super.send(data);
    }
  };
}
"""
# Shows the frames that wait; the others come as they are.
RELEASE = "window.withheld = false; for (const show of window.waiting.splice(0)) show()"

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


@pytest.fixture(scope="module")
def running() -> Iterator[View]:
    with view(LimitedPendulumScenario()) as opened:
        yield opened


@pytest.fixture(scope="module")
def page(browser: Browser, running: View) -> Iterator[Page]:
    """A page that has no value of any variable yet."""
    with opened_page(browser, running.url, ready=READY, script=SOCKET) as opened:
        opened.evaluate(f"for (const address of ['{SWITCH}', '{CENTER}']) vtb.watch(address)")
        yield opened


def section(address: str) -> str:
    return f".vtb-watched[data-address='{address}']"


def value(running: View, address: str) -> Any:
    return running.session.snapshot().values[address]


def has(page: Page, address: str, entry: int, expected: float) -> None:
    page.wait_for_function(f"vtb.watched.get('{address}').values[{entry}] === {expected}")


def commands(page: Page) -> list[str]:
    return [message["do"] for message in page.evaluate("window.sent.splice(0)")]


def test_what_is_set_before_the_first_values_arrives(page: Page, running: View) -> None:
    before = value(running, CENTER)
    assert page.locator(f"{section(ANGLE)} input[type=range]").is_disabled()  # Its range comes with its value.
    page.locator(f"{section(SWITCH)} select").select_option("twin")
    page.locator(f"{section(CENTER)} input[type=text] >> nth=1").fill("0.25")
    page.keyboard.press("Enter")
    page.evaluate("window.blind = false")
    has(page, SWITCH, 0, 2.0)
    has(page, CENTER, 1, 0.25)
    assert value(running, SWITCH) == 2.0
    np.testing.assert_array_equal(value(running, CENTER), [before[0], 0.25, before[2]])
    page.locator(f"{section(SWITCH)} select").select_option("sim")
    has(page, SWITCH, 0, 0.0)


def test_entries_that_are_set_between_two_frames_are_both_set(page: Page, running: View) -> None:
    has(page, CENTER, 1, 0.25)
    page.evaluate("window.withheld = true")
    for entry, number in ((0, "0.5"), (2, "-0.5")):
        page.locator(f"{section(CENTER)} input[type=text] >> nth={entry}").fill(number)
        page.keyboard.press("Enter")
    page.evaluate(RELEASE)
    has(page, CENTER, 2, -0.5)
    np.testing.assert_array_equal(value(running, CENTER), [0.5, 0.25, -0.5])


def test_frame_from_before_a_choice_does_not_take_it_back(page: Page, running: View) -> None:
    chosen = f'document.querySelector("{section(SWITCH)} select").value'
    page.evaluate("window.withheld = true")
    page.wait_for_function("window.waiting.length > 0")
    page.locator(f"{section(SWITCH)} select").select_option("real")
    page.locator("#vtb-act-torque").select_option("twin")
    page.evaluate("window.waiting[0]()")
    assert page.evaluate(chosen) == "1"
    assert page.input_value("#vtb-act-torque") == "twin"
    page.evaluate(RELEASE)
    has(page, SWITCH, 0, 2.0)  # the later of the two
    page.wait_for_function(f"{chosen} === '2'")
    page.locator("#vtb-act-torque").select_option("sim")
    has(page, SWITCH, 0, 0.0)


def test_keys_that_are_pressed_twice_between_two_frames_count_twice(page: Page, running: View) -> None:
    page.locator("#vtb-panel").focus()
    page.evaluate("window.withheld = true; window.sent = []")
    page.wait_for_function("window.waiting.length > 0")
    for key in ("Space", "+", "+", "Space"):
        page.keyboard.press(key)
    assert commands(page) == ["play", "speed", "speed", "pause"]
    page.evaluate(RELEASE)
    page.wait_for_function("vtb.reflects(vtb.session.asked)")
    assert page.evaluate("[vtb.speed.value, vtb.playButton.textContent]") == ["4", "play"]
    assert running.session.latest is not None
    assert (running.session.latest.speed, running.session.latest.playing) == (4.0, False)


def test_text_counts_after_a_drag_that_was_cancelled(page: Page, running: View) -> None:
    slider = page.locator(f"{section(ANGLE)} input[type=range]")
    box = slider.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.5 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.7 * box["width"], y, steps=3)
    page.keyboard.press("Escape")
    page.mouse.up()
    page.locator(f"{section(ANGLE)} input[type=text]").fill("0.5")
    page.keyboard.press("Enter")
    has(page, ANGLE, 0, 0.5)
    assert value(running, ANGLE) == 0.5
    page.locator(f"{section(ANGLE)} input[type=range]").press("Home")
    has(page, ANGLE, 0, -1.0)


def test_search_that_began_before_the_variables_came_finds_them(page: Page) -> None:
    page.evaluate("vtb.search.variables = {}")
    page.fill("#vtb-search", "center_of_mass")
    assert page.locator("#vtb-matches li").count() == 0
    page.evaluate("vtb.search.hello(vtb.variables)")
    assert page.locator("#vtb-matches li").count() == 3
    page.fill("#vtb-search", "")
