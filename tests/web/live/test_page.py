"""Tests of the page in a real browser: what is in the picture, what the controls do."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from tests.chromium import PATIENCE, in_time, needs_chromium, new_page, opened_page, screenshot
from tests.control.scripted import ScriptedBridge
from tests.web.live.test_drive import LimitedPendulumScenario, problem
from tests.web.live.test_session import ANGLE, MASS, START, angle, angle_by_hand, frame
from vtbdrake.control.clock import SimulatedClock
from vtbdrake.control.runtime import Runtime
from vtbdrake.recording.recorder import Recorder
from vtbdrake.state import Snapshot
from vtbdrake.web import View, view
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cube_toss import CubeTossScenario

# Tints of the ghosts.
GREEN, BLUE, YELLOW = np.array([0, 158, 115]), np.array([0, 114, 178]), np.array([230, 159, 0])

ANGLE_OF_DRIVE = "parseFloat(document.querySelector('#vtb-drive-status').textContent.match(/u.angle +(\\S+)/)?.[1])"

PURPLE = np.array([156, 0, 200])  # the recorded course

READY = "body[data-session=open][data-frame]"

# One Python for what does not look at the scene: Meshcat is another one in another Drake.
pytestmark = [pytest.mark.slow, needs_chromium]


@pytest.fixture
def running() -> Iterator[View]:
    with view(CartPoleScenario(), values=START) as opened:
        yield opened


@pytest.fixture
def page(browser: Browser, running: View) -> Iterator[Page]:
    with opened_page(browser, running.url, ready=READY) as opened:
        yield opened


def picture(page: Page) -> np.ndarray:
    """The scene, between panel and bar, when all that has been sent is drawn; shape (height, width, 3)."""
    return screenshot(page, clip={"x": 345, "y": 110, "width": 650, "height": 480})


def share(image: np.ndarray, color: np.ndarray) -> float:
    """The share of pixels with the hue of a colour."""
    chroma = image - image.mean(axis=2, keepdims=True)
    wanted = (color - color.mean()) / np.linalg.norm(color - color.mean())
    length = np.linalg.norm(chroma, axis=2)
    return float(np.mean((length > 40) & (chroma @ wanted > 0.95 * length)))


def drawn(page: Page, until: str) -> None:
    page.wait_for_function(until)


def settle(page: Page) -> None:
    """Wait for a few frames of the session from now on."""
    frames = int(page.evaluate("vtb.frames"))
    drawn(page, f"vtb.frames >= {frames + 4}")


def watch(page: Page, address: str) -> None:
    page.fill("#vtb-panel input[type=search]", address)
    page.click(f"#vtb-matches li >> text='{address}'")
    drawn(page, f"vtb.watched.get('{address}').values.length > 0")


def watched(address: str) -> str:
    """The selector of a watched variable."""
    return f".vtb-watched[data-address='{address}']"


def text_of(address: str) -> str:
    """The text in the field of a watched number, in JavaScript."""
    return f"vtb.watched.get('{address}').entries[0].text.value"


def drag(page: Page, to: float) -> None:
    """Press the slider of the watched variable and move it, without a release."""
    box = page.locator(f"{watched(ANGLE)} input[type=range]").bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.5 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + to * box["width"], y, steps=4)


def test_time_runs_and_the_robot_moves(page: Page, running: View) -> None:
    assert page.url.endswith("/")  # The ticket is not in the address any more.
    assert page.title() == "CartPoleScenario"
    settle(page)
    before = picture(page)
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 100  # not a black canvas
    page.keyboard.press(".")
    drawn(page, "vtb.clock.textContent === '0.008 s'")
    page.keyboard.press("Space")
    drawn(page, "parseFloat(vtb.clock.textContent) > 0.3 && vtb.rate.textContent.endsWith('×')")
    page.keyboard.press("Space")
    drawn(page, "vtb.rate.textContent === 'paused'")
    settle(page)
    assert in_time(lambda: np.mean(np.abs(picture(page) - before).max(axis=2) > 30) > 0.002)  # the pole
    steps = round(running.session.snapshot().time / running.session.config.step)
    assert angle(running.session) == angle_by_hand(steps)
    page.keyboard.press("r")
    drawn(page, "vtb.clock.textContent === '0.000 s'")
    settle(page)
    assert in_time(lambda: np.mean(np.abs(picture(page) - before).max(axis=2) > 30) < 0.0005)


def test_dragged_slider_previews_and_its_release_commits(page: Page, running: View) -> None:
    page.click("#vtb-step")
    watch(page, ANGLE)
    settle(page)
    assert in_time(lambda: share(picture(page), GREEN) < 1e-4)
    drag(page, 0.7)
    page.wait_for_selector("[data-kind=preview]")
    drawn(page, "vtb.messages.textContent.includes('preview until 2.01 s')")
    settle(page)
    assert in_time(lambda: share(picture(page), GREEN) > 0.002)
    page.keyboard.press("Escape")
    page.wait_for_selector("[data-kind=preview]", state="detached")
    page.mouse.up()
    settle(page)
    assert in_time(lambda: share(picture(page), GREEN) < 1e-4)
    assert angle(running.session) == angle_by_hand(1)  # Esc does nothing.
    drag(page, 0.7)
    drawn(page, f"vtb.watched.get('{ANGLE}').draft === 'open'")
    page.mouse.up()
    drawn(page, f"Math.abs(vtb.watched.get('{ANGLE}').values[0] - 2.0) > 0.2")
    value = float(page.evaluate(f"vtb.watched.get('{ANGLE}').values[0]"))
    assert angle(running.session) == value


@pytest.mark.one_python
def test_dragged_dial_previews_and_its_release_commits(browser: Browser) -> None:
    with view(LimitedPendulumScenario()) as running, opened_page(browser, running.url, ready=READY) as opened:
        opened.click(f"{watched('u.angle')} >> text=dial")
        box = opened.locator(".vtb-pad.dial >> visible=true").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        for cancelled in (True, False):
            opened.mouse.move(x + 40.0, y)
            opened.mouse.down()
            opened.mouse.move(x + 40.0, y - 20.0, steps=4)  # counter-clockwise
            opened.wait_for_selector("[data-kind=preview]")
            if cancelled:
                opened.keyboard.press("Escape")
                opened.wait_for_selector("[data-kind=preview]", state="detached")
            opened.mouse.up()
            settle(opened)
            expected = 0.0 if cancelled else np.arctan2(20.0, 40.0)
            assert running.session.snapshot()["u.angle"] == pytest.approx(expected, abs=0.03)


@pytest.mark.one_python
def test_text_that_is_refused_gives_way_to_the_present_value(browser: Browser) -> None:
    scenario = LimitedPendulumScenario()
    with view(scenario, values={"u.angle": 0.5}) as running, opened_page(browser, running.url, ready=READY) as page:
        for text, reason in (("999", "u.angle must lie in [-1, 1] rad"), (" ", "u.angle takes a number")):
            page.fill(f"{watched('u.angle')} input[type=text]", text)
            page.keyboard.press("Enter")
            drawn(page, f"vtb.messages.textContent.includes('{reason}')")
            drawn(page, f"{text_of('u.angle')} === '0.5'")
        assert running.session.snapshot()["u.angle"] == 0.5


def test_place_dragged_in_the_scene_previews_and_its_release_commits(browser: Browser) -> None:
    pose, handle = "sim.sys.cube.pose", ".vtb-place"
    # Where the viewer draws the body, which the server has placed.
    where = """() => {
        const { object } = viewer.scene_tree.find(["drake", "now", "cube", "cube"]);
        const [x, y] = viewer.camera.position.clone().setFromMatrixPosition(object.matrixWorld).project(viewer.camera);
        const { left, top, width, height } = viewer.renderer.domElement.getBoundingClientRect();
        return [left + 0.5 * (1 + x) * width, top + 0.5 * (1 - y) * height];
    }"""
    with view(CubeTossScenario()) as running, opened_page(browser, running.url, ready=READY) as page:
        page.select_option("#vtb-follow", "")
        watch(page, pose)
        start = np.array(running.session.snapshot().values[pose])
        place = np.array(page.evaluate(where))
        aside, above = place + np.array([60.0, 25.0]), place + np.array([60.0, -35.0])
        page.wait_for_selector(handle)
        box = page.locator(handle).bounding_box()
        assert box is not None
        np.testing.assert_allclose([box["x"] + 9, box["y"] + 9], place, atol=1.0)
        knob = "document.querySelector('.vtb-pad .vtb-knob').style.left"
        knob_at_start = page.evaluate(knob)
        for cancelled in (True, False):
            page.mouse.move(*place)
            page.mouse.down()
            page.mouse.move(*aside, steps=4)
            page.wait_for_selector("[data-kind=preview]")
            settle(page)
            assert in_time(lambda: share(picture(page), GREEN) > 0.0005)
            assert page.evaluate(knob) != knob_at_start  # The pad shows the draft, too.
            if cancelled:
                page.keyboard.press("Escape")
                page.wait_for_selector("[data-kind=preview]", state="detached")
            page.mouse.up()
            settle(page)
            if cancelled:
                np.testing.assert_array_equal(running.session.snapshot().values[pose], start)
        moved = np.array(running.session.snapshot().values[pose])
        assert np.abs(moved[:2] - start[:2]).min() > 0.005
        np.testing.assert_allclose(moved[2:], start[2:], atol=1e-9)
        drawn(page, f"Math.hypot(...({where})().map((v, i) => v - {aside.tolist()}[i])) < 2")
        page.keyboard.down("Shift")
        page.mouse.move(*aside)
        page.mouse.down()
        page.mouse.move(*above, steps=4)
        page.mouse.up()
        page.keyboard.up("Shift")
        settle(page)
        lifted = np.array(running.session.snapshot().values[pose])
        assert lifted[2] > moved[2] + 0.005
        np.testing.assert_allclose(np.delete(lifted, 2), np.delete(moved, 2), atol=1e-9)
        page.click(f"{watched(pose)} button[title=remove]")
        assert page.locator(handle).count() == 0


def test_course_without_the_change_is_a_ghost_with_a_table(page: Page, running: View) -> None:
    watch(page, MASS)
    page.check("#vtb-compare")
    page.fill(f"{watched(MASS)} input[type=text]", "0.9")
    page.keyboard.press("Enter")
    drawn(page, f"vtb.watched.get('{MASS}').values[0] === 0.9")
    page.click("#vtb-play")
    drawn(page, "parseFloat(vtb.clock.textContent) > 0.8 && vtb.differences.rows.length > 2")
    page.click("#vtb-play")
    settle(page)
    assert MASS in page.inner_text("#vtb-differences")
    assert in_time(lambda: share(picture(page), BLUE) > 0.002)
    assert float(running.session.snapshot().values[MASS]) == 0.9


@pytest.mark.one_python
def test_scrubbed_history_goes_back(page: Page, running: View) -> None:
    page.click("#vtb-play")
    drawn(page, "Number(vtb.history.max) > 0.6")
    page.click("#vtb-play")
    box = page.locator("#vtb-history").bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.4 * box["width"], box["y"] + box["height"] / 2)
    drawn(page, "parseFloat(vtb.clock.textContent) < 0.6 * Number(vtb.history.max)")
    settle(page)
    steps = round(running.session.snapshot().time / running.session.config.step)
    assert angle(running.session) == angle_by_hand(steps)
    before = picture(page)
    running.session.write({ANGLE: 1.0})
    running.session.advance(10)
    drawn(page, f"vtb.differences.textContent.includes('{ANGLE}')")
    assert page.inner_text("#vtb-differences").startswith("differs first from the other branch (orange):")
    settle(page)
    # Where the pole was, there is the ghost of the other branch.
    assert in_time(lambda: share(picture(page), YELLOW) > share(before, YELLOW) + 0.002)


def test_camera_follows_a_body(page: Page) -> None:
    offset = """() => {
        const { object } = viewer.scene_tree.find(["drake", "now", "cart_pole", "cart"]);
        const place = object.matrixWorld.elements.slice(12, 15);
        return [place, viewer.camera.position.toArray().map((x, i) => x - place[i])];
    }"""
    page.select_option("#vtb-follow", "now/cart_pole/cart")
    drawn(page, "vtb.camera.followed === 'now/cart_pole/cart'")
    place, before = page.evaluate(offset)
    page.click("#vtb-play")
    # The scene comes over another socket than the clock, and the camera follows in the next picture.
    drawn(page, f"Math.abs(({offset})()[0][0] - {place[0]}) > 0.005")
    page.click("#vtb-play")
    drawn(page, "vtb.rate.textContent === 'paused'")
    drawn(page, f"({offset})()[1].every((x, i) => Math.abs(x - {before}[i]) < 1e-6)")
    moved, after = page.evaluate(offset)
    assert abs(moved[0] - place[0]) > 0.005
    np.testing.assert_allclose(after, before, atol=1e-6)


def test_robot_that_has_moved_away_is_in_view(browser: Browser) -> None:
    # A tossed cube: a page that opens after a second shows it, and follows it.
    velocity = [0.0, 0.0, 0.0, 4.0, 0.0, 4.9]
    with view(CubeTossScenario(), values={"sim.sys.cube.velocity": velocity}) as opened:
        opened.session.advance(round(1.0 / opened.session.config.step))
        with opened_page(browser, opened.url, ready=READY) as page:
            page.wait_for_function("window.vtb && vtb.camera.followed")
            target, place, distance = page.evaluate("""() => {
                const { camera, controls } = viewer;
                return [controls.target.toArray(), vtb.camera.place, camera.position.distanceTo(controls.target)];
            }""")
            assert place[0] > 3.0 and distance < 2.0
            assert np.linalg.norm(np.subtract(target, place)) < 0.3 * distance


@pytest.mark.one_python
def test_refused_switch_and_a_second_browser_are_told(page: Page, running: View, browser: Browser) -> None:
    page.select_option("#vtb-sense-joint_position", "real")
    drawn(page, "vtb.switches.list.textContent.includes('nothing feeds real.sense.joint_position')")
    drawn(page, "document.querySelector('#vtb-sense-joint_position').value === 'sim'")
    page.select_option("#vtb-sense", "real")  # all signals of the side
    drawn(page, "document.querySelector('#vtb-sense').parentElement.textContent.includes('nothing feeds real.sense')")
    drawn(page, "document.querySelector('#vtb-sense').value === 'sim' && vtb.switches.mode.textContent === 'sim'")
    page.select_option("#vtb-act-force", "twin")
    drawn(page, "vtb.switches.mode.textContent === 'mixed'")
    assert running.session.latest.positions["act"] == {"force": "twin"}
    second = new_page(browser)
    second.goto(running.url)
    second.wait_for_selector("#vtb-take")
    second.click("#vtb-take")
    page.wait_for_selector("#vtb-take")
    second.keyboard.press(".")
    drawn(page, "vtb.clock.textContent === '0.008 s'")
    second.close()
    page.wait_for_selector("#vtb-take", state="detached")


@pytest.mark.one_python
def test_page_of_another_origin_cannot_use_the_server(page: Page, running: View, browser: Browser) -> None:
    hostile = new_page(browser)
    hostile.goto("data:text/html,<title>hostile</title>")
    url = page.url.replace("http", "ws", 1)
    closed = f"""(path) => new Promise((done) => {{
        const socket = new WebSocket("{url}" + path);
        socket.onopen = () => done("open");
        socket.onerror = () => done("refused");
    }})"""
    assert [hostile.evaluate(closed, path) for path in ("", "session")] == ["refused", "refused"]
    assert page.evaluate(closed, "session") == "open"
    hostile.close()


def test_saved_snapshot_opens_with_the_same_camera(page: Page, running: View, browser: Browser, tmp_path: Path) -> None:
    page.click("#vtb-step")
    drawn(page, "vtb.clock.textContent === '0.008 s'")
    page.evaluate("viewer.camera.position.set(0.9, 1.1, 1.3); viewer.controls.target.set(0.1, 0.2, -0.3)")
    page.click("#vtb-keep summary")
    with page.expect_download() as downloads:
        page.click("#vtb-save")
    assert downloads.value.suggested_filename == "CartPoleScenario-0.008s.vtb"
    downloads.value.save_as(tmp_path / "saved.vtb")
    snapshot = Snapshot.load(tmp_path / "saved.vtb")
    assert snapshot == running.session.snapshot()
    with view(CartPoleScenario(), start=snapshot) as again:
        second = new_page(browser)
        second.goto(again.url)
        drawn(second, "window.viewer")
        drawn(second, "Math.abs(viewer.camera.position.x - 0.9) < 1e-6 && viewer.controls.target.x === 0.1")
        camera = "[...viewer.camera.position.toArray(), ...viewer.controls.target.toArray()]"
        np.testing.assert_allclose(second.evaluate(camera), page.evaluate(camera), atol=1e-6)
        assert again.session.snapshot() == snapshot
        second.close()


@pytest.mark.one_python
def test_tab_that_stands_still_catches_up_and_holds_nobody_up(page: Page, running: View, browser: Browser) -> None:
    page.click("#vtb-play")
    drawn(page, "parseFloat(vtb.clock.textContent) > 0.1")
    browser_side = page.context.new_cdp_session(page)
    browser_side.send("Debugger.enable")
    browser_side.send("Debugger.pause")  # Neither timers nor messages run.
    number = running.session.latest.number if running.session.latest is not None else 0
    other = new_page(browser)
    other.goto(running.url)
    other.wait_for_selector("body[data-session=open][data-frame]", state="attached")
    drawn(other, "vtb.frames > 3")
    other.close()
    assert running.session.wait_for_frame(number + 30, PATIENCE / 1e3) is not None
    running.session.pause()
    browser_side.send("Debugger.resume")
    time = running.session.snapshot().time
    # Not by text: at a tie, JavaScript rounds up, and Python to even.
    drawn(page, f"vtb.clock.textContent === ({time!r}).toFixed(3) + ' s' && vtb.rate.textContent === 'paused'")


def hold(page: Page, key: str, until: str) -> None:
    """Hold a key, which repeats, until something is shown; if the computer is too busy for the page, drive on."""
    while not page.evaluate(until):
        if key:
            page.keyboard.down(key)
        if page.evaluate("vtb.told('drive') !== null"):
            page.evaluate("vtb.ask('play')")


@pytest.mark.one_python
def test_testbed_is_driven_by_keys_and_gamepad(browser: Browser, tmp_path: Path) -> None:
    study = tmp_path / "tilt.db"
    # A gamepad that the test holds: Chromium asks for it in each poll.
    gamepad = (
        "window.axes = [0, 0, 0, 0];"
        "navigator.getGamepads = () => [{connected: true, axes: window.axes, buttons: []}, null];"
    )
    with (
        view(LimitedPendulumScenario(), problem=problem(horizon=600.0), study=study, folder=tmp_path) as running,
        opened_page(browser, running.url, ready=READY, size=(1280, 800), script=gamepad) as opened,
    ):
        opened.click("#vtb-drive summary")
        opened.click("#vtb-drive-begin")
        opened.wait_for_selector("#vtb-drive-keep")
        hold(opened, "ArrowRight", f"{ANGLE_OF_DRIVE} > 0.1")
        opened.keyboard.up("ArrowRight")
        assert 0.1 < running.session.snapshot()["u.angle"] <= 1.0
        opened.click("#vtb-drive-drop")
        opened.wait_for_selector("#vtb-drive-begin")
        assert "magnitude" in opened.locator("#vtb-messages").inner_text()
        assert running.session.snapshot()["u.angle"] == 0.0
        opened.click("#vtb-drive-begin")
        opened.evaluate("window.axes = [-0.5, 0, 0, 0]")
        hold(opened, "", f"{ANGLE_OF_DRIVE} < -0.1")
        opened.click("#vtb-drive-keep")
        opened.wait_for_selector("#vtb-drive-begin")
        assert -1.0 <= running.session.snapshot()["u.angle"] < -0.1
        opened.click("#vtb-keep summary")
        opened.click("text=store the drive as a trial of tilt.db")
        drawn(opened, "vtb.messages.textContent.includes('stored as the driven trial 1 of tilt.db')")
        opened.fill("#vtb-test-name", "to_the_left")
        opened.click("#vtb-save-test")
        drawn(opened, "vtb.messages.textContent.includes('test_to_the_left.py')")
        assert sorted(file.suffix for file in tmp_path.glob("test_to_the_left.*")) == [".py", ".vtb"]


def told(page: Page, text: str) -> None:
    """Wait for a message that something was refused."""
    drawn(page, f"[...document.querySelectorAll('#vtb-messages p.bad')].some(p => p.textContent.includes('{text}'))")


@pytest.mark.one_python
def test_refusals_are_told_and_followed_by_nothing(browser: Browser, tmp_path: Path) -> None:
    with (
        view(LimitedPendulumScenario(), problem=problem(horizon=600.0), folder=tmp_path) as running,
        opened_page(browser, running.url, ready=READY, size=(1280, 800)) as page,
    ):
        page.evaluate(
            """() => {
                const ask = vtb.session.ask.bind(vtb.session);
                window.asked = [];
                vtb.session.ask = (command, fields) => { asked.push(command); return ask(command, fields); };
            }"""
        )
        page.click("#vtb-keep summary")
        page.fill("#vtb-test-name", "nothing")
        page.click("#vtb-save-test")
        told(page, "there is nothing to save")
        assert "saved:" not in page.inner_text("#vtb-messages") and page.locator("#vtb-messages p.draft").count() == 0
        # `r` in a drive.
        page.click("#vtb-drive summary")
        page.click("#vtb-drive-begin")
        page.wait_for_selector("#vtb-drive-keep")
        page.keyboard.press("r")
        told(page, "beginning again has to wait until the drive has ended")
        assert running.session.latest is not None and running.session.latest.drive is not None
        page.click("#vtb-drive-drop")
        page.wait_for_selector("#vtb-drive-begin")
        # After a failure: what only now is watched is shown, and a drive that is refused does not play.
        running.session.write({"sim.sys.Pendulum.theta.velocity": 1e308})
        running.session.play()
        told(page, "the simulation has failed")
        watch(page, "sim.sys.Pendulum.arm.mass")
        drawn(page, f"{text_of('sim.sys.Pendulum.arm.mass')} !== ''")
        assert page.evaluate(text_of("u.angle")) == "0"
        page.evaluate("window.asked.length = 0")
        page.click("#vtb-drive-begin")
        told(page, "go back, or reset")
        settle(page)
        assert page.evaluate("window.asked") == ["drive"]


@pytest.mark.one_python
def test_frozen_page_lets_go_of_what_it_drives(browser: Browser) -> None:
    with (
        view(LimitedPendulumScenario(), problem=problem(horizon=600.0)) as running,
        opened_page(browser, running.url, ready=READY, size=(1280, 800)) as page,
    ):
        page.click("#vtb-drive summary")
        page.check("#vtb-drive [data-address='T_act.torque.idle'] input >> nth=0")
        page.uncheck("#vtb-drive [data-address='u.angle'] input >> nth=0")
        page.click("#vtb-drive-begin")
        page.wait_for_selector("#vtb-drive-keep")
        hold(page, "ArrowRight", f"{ANGLE_OF_DRIVE.replace('u.angle', 'torque')} > 0.5")
        browser_side = page.context.new_cdp_session(page)
        browser_side.send("Debugger.enable")
        browser_side.send("Debugger.pause")  # Neither timers nor messages run.
        shown = frame(running.session, lambda shown: not shown.playing)
        assert shown.drive is not None and shown.drive["notice"] == "the page that drove was silent for 1 s"
        running.session.advance(500)
        frame(running.session, lambda later: later.time > shown.time)
        assert driven_torque(running) == 0.0
        browser_side.send("Debugger.resume")
        told(page, "the sticks are released, and time stands still")
        drawn(page, "vtb.rate.textContent === 'paused'")


def driven_torque(running: View) -> float:
    latest = running.session.latest
    assert latest is not None and latest.drive is not None
    return float(latest.drive["values"]["T_act.torque.idle"][0])


def record_swing(path: Path) -> None:
    """Record a simulated run of the pendulum, which follows a command."""
    scenario, clock = LimitedPendulumScenario(), SimulatedClock()
    bridge = ScriptedBridge(scenario.interface(), clock, lambda time: {})
    with Runtime(scenario.build(), bridge, period=0.01, clock=clock) as runtime, Recorder(runtime, path):
        runtime.write({"u.angle": 0.9})
        runtime.run(cycles=400)


def test_log_is_replayed_and_left_with_its_course_as_a_ghost(browser: Browser, tmp_path: Path) -> None:
    record_swing(tmp_path / "swing.lcm")
    with (
        view(log=tmp_path / "swing.lcm") as running,
        opened_page(browser, running.url, ready="body[data-log=recorded][data-frame]") as opened,
    ):
        assert "swing.lcm: what was recorded" in opened.locator("#vtb-log").inner_text()
        opened.keyboard.press("Space")
        drawn(opened, "parseFloat(vtb.clock.textContent) > 0.5")
        opened.keyboard.press("Space")
        drawn(opened, "vtb.rate.textContent === 'paused'")
        assert in_time(lambda: share(picture(opened), PURPLE) < 1e-4)
        watch(opened, "u.angle")
        assert opened.evaluate(text_of("u.angle")) == "0.9"
        opened.fill(f"{watched('u.angle')} input[type=text]", "-0.9")
        opened.keyboard.press("Enter")
        opened.wait_for_selector("body[data-log=simulated]", state="attached")
        left = running.session.snapshot().time
        running.session.advance(40)
        drawn(opened, f"parseFloat(vtb.clock.textContent) > {left + 0.3}")
        settle(opened)
        assert in_time(lambda: share(picture(opened), PURPLE) > 0.001)
        opened.click("#vtb-back-to-log")
        opened.wait_for_selector("body[data-log=recorded]", state="attached")
        settle(opened)
        assert in_time(lambda: share(picture(opened), PURPLE) < 1e-4)
