"""Tests of the panel and the bar of the live page in a real browser; all but the last share one page."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.axe import axe, serious_violations
from tests.chromium import PHONE, WIDE, needs_chromium, opened_page
from tests.web.live.test_drive import LimitedPendulumScenario
from vtbdrake.web import View, view
from vtbdrake_diagrams.manipulator import ManipulatorScenario

__all__ = ["axe"]

READY = "body[data-session=open][data-frame]"

MOTION = "u.motion"
JOINT = "sim.sys.arm.joint_2.position"
TOOL = "dps.env.tool_center"
STIFFNESS = "dps.impl.stiffness"
TORQUE = "sim.act.drives.torque"

# What can be used: controls that are shown and not in a dialog.
CONTROLS = "button:visible, input:visible, select:visible, summary:visible"

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


@pytest.fixture(scope="module")
def running() -> Iterator[View]:
    with view(ManipulatorScenario()) as opened:
        yield opened


@pytest.fixture(scope="module")
def shared(browser: Browser, running: View) -> Iterator[Page]:
    with opened_page(browser, running.url, ready=READY, size=(WIDE["width"], WIDE["height"])) as opened:
        yield opened


@pytest.fixture
def page(shared: Page) -> Page:
    """The shared page as it opens: without what an earlier test has left."""
    shared.set_viewport_size(WIDE)
    shared.evaluate("localStorage.clear(); vtb.layoutKey = ''")
    reload(shared)
    return shared


def reload(page: Page) -> None:
    page.reload()
    page.wait_for_selector(READY, state="attached")
    # The server may still be taking leave of the page before, which steered.
    page.wait_for_function("!vtb.messages.textContent.includes('another page steers')")


def watched(page: Page) -> list[str]:
    return list(page.evaluate("[...document.querySelectorAll('.vtb-watched')].map(({ dataset }) => dataset.address)"))


def section(address: str) -> str:
    return f".vtb-watched[data-address='{address}']"


def watch(page: Page, address: str) -> None:
    page.fill("#vtb-search", address)
    page.click(f"#vtb-matches li >> text='{address}'")
    page.wait_for_function(f"vtb.watched.get('{address}').values.length > 0")


def value(running: View, address: str) -> np.ndarray:
    return np.array(running.session.snapshot().values[address])


def test_page_opens_with_commands_and_joints_and_an_enumeration_is_a_choice(page: Page, running: View) -> None:
    assert watched(page) == [MOTION, *(f"sim.sys.arm.joint_{joint}.position" for joint in range(1, 8))]
    choice = page.locator(f"{section(MOTION)} select")
    assert choice.locator("option").all_inner_texts() == ["follow", "home", "swing", "press", "circle"]
    assert page.locator(f"{section(MOTION)} input").count() == 0
    choice.select_option("swing")
    page.wait_for_function(f"vtb.watched.get('{MOTION}').values[0] === 2")
    assert value(running, MOTION) == 2.0
    assert page.locator(".dg.main >> visible=true").count() == 0  # Meshcat's own controls


def test_search_walks_with_arrows_and_counts_the_rest(page: Page, running: View) -> None:
    addresses = [address for address in running.session.variables if "arm" in address.lower()]
    page.keyboard.press("/")
    page.keyboard.type("arm")
    assert page.locator("#vtb-matches li").count() == 60
    assert page.inner_text("#vtb-more") == f"and {len(addresses) - 60} more: type another word"
    for key in ("ArrowDown", "ArrowDown", "ArrowDown", "ArrowUp"):
        page.keyboard.press(key)
    assert page.get_attribute("#vtb-search", "aria-activedescendant") == "vtb-match-2"
    page.keyboard.press("Enter")
    assert addresses[2] in watched(page)
    page.keyboard.press("Escape")
    assert page.locator("#vtb-matches li").count() == 0


def test_vector_has_names_and_units_and_refuses_what_is_out_of_bounds(page: Page, running: View) -> None:
    watch(page, TORQUE)
    labels = page.locator(f"{section(TORQUE)} .vtb-label").all_inner_texts()
    assert labels == [f"joint_{joint} N m" for joint in range(1, 8)]
    watch(page, STIFFNESS)
    units = page.locator(f"{section(STIFFNESS)} .vtb-label small").all_inner_texts()
    assert units == ["N m/rad"] * 3 + ["N/m"] * 3
    watch(page, TOOL)
    assert "±1 m" in page.inner_text(f"{section(TOOL)} header")
    before = value(running, TOOL)
    text = page.locator(f"{section(TOOL)} input[type=text] >> nth=1")
    text.fill("1.5")
    text.press("Enter")
    page.wait_for_function("vtb.messages.textContent.includes('dps.env.tool_center[1] must lie in [-1, 1] m')")
    page.wait_for_function(f"document.querySelectorAll(\"{section(TOOL)} input[type=text]\")[1].value === '0'")
    np.testing.assert_array_equal(value(running, TOOL), before)


def test_undo_sets_what_was_changed_last_as_before(page: Page, running: View) -> None:
    before = value(running, TOOL)
    assert page.is_disabled("#vtb-undo")
    watch(page, TOOL)
    for entry, number in ((0, "0.25"), (2, "-0.5")):
        text = page.locator(f"{section(TOOL)} input[type=text] >> nth={entry}")
        text.fill(number)
        text.press("Enter")
        page.wait_for_function(f"vtb.watched.get('{TOOL}').values[{entry}] === {number}")
    page.locator("#vtb-panel").focus()
    page.keyboard.press("Control+z")
    page.wait_for_function(f"vtb.watched.get('{TOOL}').values[2] === {before[2]}")
    np.testing.assert_array_equal(value(running, TOOL), [0.25, *before[1:]])
    page.click("#vtb-undo")
    page.wait_for_function(f"vtb.watched.get('{TOOL}').values[0] === {before[0]} && vtb.undoButton.disabled")
    np.testing.assert_array_equal(value(running, TOOL), before)


def test_plot_has_unit_legend_zoom_and_is_saved(page: Page, running: View, tmp_path: Path) -> None:
    plot = f"vtb.watched.get('{JOINT}').plot"
    page.click(f"{section(JOINT)} >> text=plot")
    session = running.session
    session.reset()
    for _ in range(4):
        session.advance(32)
        page.wait_for_function(f"{plot}.data[0].at(-1) === {session.snapshot().time}")
    last = value(running, JOINT)
    assert page.evaluate(f"{plot}.plot.axes.map(({{ label }}) => label)") == ["s", "rad"]
    shown = f'document.querySelector("{section(JOINT)} .u-legend").textContent'
    page.wait_for_function(f"{shown}.includes('1 s') && {shown}.includes(String(Number({last}.toPrecision(5))))")
    with page.expect_download() as download:
        page.click(f"{section(JOINT)} >> text=CSV")
    head, *rows = csv.reader(Path(download.value.path()).read_text(encoding="utf-8").splitlines())
    assert head == ["t [s]", "joint_2.position [rad]"]
    assert [float(number) for number in rows[-1]] == [1.0, last]
    with page.expect_download() as download:
        page.click(f"{section(JOINT)} >> text=PNG")
    assert Path(download.value.path()).read_bytes().startswith(b"\x89PNG")
    page.locator(f"{section(JOINT)} .u-over").scroll_into_view_if_needed()
    box = page.locator(f"{section(JOINT)} .u-over").bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.25 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], y, steps=4)
    page.mouse.up()
    page.wait_for_function(f"{plot}.zoomed && {plot}.plot.scales.x.max < 0.8")
    session.advance(32)
    page.wait_for_function(f"{plot}.data[0].at(-1) === 1.25")
    assert page.evaluate(f"{plot}.plot.scales.x.max") < 0.8  # The zoom stays.
    page.click(f"{section(JOINT)} >> text=follow")
    page.wait_for_function(f"{plot}.plot.scales.x.max === 1.25")


def test_ghosts_have_a_legend(page: Page, running: View) -> None:
    assert page.locator("#vtb-ghosts li").count() == 0
    running.session.preview({JOINT: 0.5})
    page.wait_for_function("vtb.ghosts.root.textContent === 'preview of the draft'")
    assert page.evaluate("getComputedStyle(document.querySelector('#vtb-ghosts i')).backgroundColor") == (
        "rgb(0, 158, 115)"
    )
    page.keyboard.press("Escape")
    page.wait_for_function("vtb.ghosts.root.textContent === ''")


def test_views_turn_the_camera_and_show_all_that_moves(page: Page) -> None:
    # The direction from the target to the camera, in Drake's world, and where the bodies are in the picture.
    away = "viewer.camera.position.clone().sub(viewer.controls.target).normalize()"
    seen = """vtb.camera.bodies.map((path) => {
        const { object } = viewer.scene_tree.find(["drake", ...path.split("/")]);
        const place = viewer.camera.position.clone().setFromMatrixPosition(object.matrixWorld);
        return place.project(viewer.camera).toArray();
    })"""
    page.wait_for_function("viewer.scene_tree.find(['drake', ...vtb.camera.bodies.at(-1).split('/')]).object.children")
    for name, key, direction in (("front", "2", [1, 0, 0]), ("side", "3", [0, -1, 0]), ("top", "4", [0, 0, 1])):
        page.keyboard.press(key)
        x, z, minus_y = page.evaluate(f"{away}.toArray()")
        np.testing.assert_allclose([x, -minus_y, z], direction, atol=0.01, err_msg=name)
    page.evaluate("viewer.camera.position.multiplyScalar(40)")
    page.click("#vtb-fit")
    page.wait_for_function(f"({seen}).every(([x, y, z]) => Math.max(Math.abs(x), Math.abs(y), Math.abs(z)) < 1)")
    extent = np.ptp(np.array(page.evaluate(seen))[:, :2], axis=0)
    assert extent.max() > 0.2  # not from far away


def test_keys_are_listed_and_space_presses_the_control_that_has_the_focus(page: Page, running: View) -> None:
    page.keyboard.press("?")
    assert "undo the last change" in page.inner_text("#vtb-keys")
    page.keyboard.press("Space")  # It closes the sheet by its button, and time does not run.
    page.wait_for_selector("#vtb-keys", state="hidden")
    time = running.session.snapshot().time
    page.locator("#vtb-step").focus()
    page.keyboard.press("Space")
    after = time + running.session.config.step
    page.wait_for_function(f"vtb.clock.textContent === ({after}).toFixed(3) + ' s'")
    assert not page.evaluate("vtb.playing")
    page.keyboard.press("m")
    assert not page.is_visible("#vtb-panel")


def test_colours_follow_the_system_until_one_chooses(page: Page) -> None:
    paper = "getComputedStyle(document.querySelector('#vtb-panel')).backgroundColor"
    light, dark = "rgb(251, 252, 253)", "rgb(22, 27, 31)"
    page.emulate_media(color_scheme="dark")
    page.wait_for_function(f"{paper} === '{dark}'")
    page.click("#vtb-theme")  # from the system's to light
    assert page.evaluate(paper) == light
    page.click("#vtb-theme")
    page.emulate_media(color_scheme="light")
    reload(page)
    assert page.evaluate(paper) == dark


def test_reload_keeps_the_layout_and_no_token(page: Page) -> None:
    page.click(f"{section(JOINT)} >> text=plot")
    page.click(f"{section(MOTION)} button[title=remove]")
    page.check("#vtb-layer-names")
    page.check("#vtb-compare")
    layout = watched(page)
    page.keyboard.press("m")
    reload(page)
    assert watched(page) == layout and MOTION not in layout
    assert page.evaluate(f"vtb.watched.get('{JOINT}').plot !== null")
    assert page.evaluate("vtb.isFolded && vtb.compare.checked && vtb.layers.isOn('names')")
    token = page.url.rstrip("/").rsplit("/", 1)[-1]
    assert len(token) > 16 and token not in json.dumps(page.evaluate("({ ...localStorage })"))


def test_phone_reaches_everything(page: Page) -> None:
    page.set_viewport_size(PHONE)
    reload(page)
    assert not page.is_visible("#vtb-panel")  # The scene is seen first.
    page.click("#vtb-fold")
    controls = page.locator(CONTROLS)
    assert controls.count() > 30
    unreachable = page.evaluate(
        """(selector) => [...document.querySelectorAll(selector)].filter((control) => {
            if (!control.checkVisibility()) return false;
            control.scrollIntoView({ block: "nearest" });
            const { left, right, top, bottom } = control.getBoundingClientRect();
            const reached = document.elementFromPoint((left + right) / 2, (top + bottom) / 2);
            return left < 0 || right > innerWidth || top < 0 || bottom > innerHeight || !control.contains(reached);
        }).map(({ id, outerHTML }) => id || outerHTML)""",
        CONTROLS.replace(":visible", ""),
    )
    assert unreachable == []
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    page.click("#vtb-fold")
    assert not page.is_visible("#vtb-panel")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_no_serious_violation(page: Page, axe: str, scheme: str) -> None:
    page.emulate_media(color_scheme=scheme)
    page.click(f"{section(JOINT)} >> text=plot")
    page.click("#vtb-drive summary")
    page.click("#vtb-keep summary")
    page.fill("#vtb-search", "joint")
    page.evaluate(
        "vtb.say('a refusal', 'bad', 'one'); vtb.say('a draft', 'draft', 'two'); vtb.say('a note', '', 'three')"
    )
    assert serious_violations(page, axe) == []
    page.evaluate("vtb.keySheet.root.showModal()")
    assert serious_violations(page, axe) == []
    page.emulate_media(color_scheme="light")


# Keeps the sockets of the page, so that a test can cut one.
KEEP_SOCKETS = """{
  const Socket = window.WebSocket;
  window.sockets = [];
  window.WebSocket = class extends Socket {
    constructor(...settings) {
      super(...settings);
      window.sockets.push(this);
    }
  };
}
"""
CUT = "sockets.find(({ url }) => url.endsWith('/session')).close()"


def test_lost_connection_comes_back_and_a_server_that_is_gone_is_told(browser: Browser) -> None:
    with view(LimitedPendulumScenario()) as running:
        port = int(running.url.split(":")[2].split("/")[0])
        with opened_page(browser, running.url, ready=READY, script=KEEP_SOCKETS) as page:
            page.click(f"{section('u.angle')} >> text=plot")
            away: list[str] = []
            page.route("**/", lambda route: (away.append("asked"), route.abort())[-1])
            page.evaluate(CUT)
            page.wait_for_selector("body[data-session=lost]", state="attached")
            assert page.evaluate("vtb.panel.inert && vtb.bar.inert")  # Nothing can be set meanwhile.
            page.wait_for_function("vtb.messages.textContent.includes('or the server has ended: looking for it')")
            page.evaluate("window.isOld = true")
            page.unroute("**/")
            page.wait_for_function("!window.isOld && window.vtb?.watched.get('u.angle')?.plot")
            page.wait_for_selector(READY, state="attached")
            running.close()
            with view(LimitedPendulumScenario(), port=port):
                page.wait_for_function("vtb.messages.textContent.includes('open the address that it has printed')")
