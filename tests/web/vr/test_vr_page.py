"""Test of the page in a headset, which IWER emulates: what is tracked, sent and drawn, and what the arm does."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.chromium import needs_chromium, new_page, screenshot
from tests.web.live.test_page import GREEN, share
from tests.web.vr.test_virtual_reality import Headset, PatientArm, becomes, tip
from vtbdrake.web import View, view

IWER = Path(__file__).with_name("vendor") / "iwer.min.js"
INSTALL = """
window.quest = new IWER.XRDevice(IWER.metaQuest3);
quest.installRuntime({ forceInstall: true });
// IWER 2.5.0 takes the offset for a matrix, and so for none.
const { getOffsetReferenceSpace } = XRReferenceSpace.prototype;
XRReferenceSpace.prototype.getOffsetReferenceSpace = function (offset) {
  return getOffsetReferenceSpace.call(this, offset.matrix);
};
"""

# Where the wearer stands: behind the arm, at x = -0.7 m, and looks along x.
PLACED = RigidTransform(RotationMatrix(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])), [-0.7, 0, 0])

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


def pose(numbers: list[float]) -> RigidTransform:
    return RigidTransform(Quaternion(np.array(numbers[:4])), numbers[4:])


def state(page: Page, attribute: str) -> None:
    page.wait_for_selector(f"body[{attribute}]", state="attached")


@dataclass
class Worn:
    """A headset in virtual reality, whose page has armed the robot."""

    running: View
    page: Page
    sent: list[dict[str, Any]] = field(default_factory=list)

    def shown(self) -> dict[str, Any]:
        """Return what is sent a few frames later."""
        poses = int(self.page.evaluate("document.body.dataset.poses ?? 0"))
        self.page.wait_for_function(f"Number(document.body.dataset.poses) > {poses + 4}")
        return self.sent[-1]

    def tip(self) -> np.ndarray:
        return tip(self.running.session.snapshot().values)


@contextmanager
def worn(browser: Browser, prepare: str) -> Iterator[Worn]:
    """A headset in virtual reality; the script prepares the emulator before."""
    failures: list[str] = []
    with view(PatientArm(), vr=True) as running:
        # Small: two pictures per frame are drawn without a graphics card.
        page = new_page(browser, size=(380, 240), script=IWER.read_text() + INSTALL)
        headset = Worn(running, page)

        def note(data: str) -> None:
            message = json.loads(data)
            if "time" in message:
                headset.sent.append(message)

        page.on("pageerror", lambda error: failures.append(str(error)))
        page.on("websocket", lambda socket: socket.on("framesent", note) if socket.url.endswith("/vr") else None)
        page.goto(running.url)
        state(page, "data-session=open")
        page.click("#vtb-vr-arm")
        state(page, "data-vr=armed")
        page.evaluate(prepare)
        page.click("text=ENTER VR")
        state(page, "data-headset=entered")
        page.evaluate("document.body.classList.add('vtb-folded')")
        page.evaluate("quest.position.set(0, 1.6, 0)")
        yield headset
    assert not failures


def test_controller_in_a_headset_leads_the_arm(browser: Browser) -> None:
    with worn(browser, "window.grips = [0, 1].map((k) => viewer.renderer.xr.getControllerGrip(k))") as headset:
        page = headset.page
        page.evaluate("quest.controllers.right.position.set(0.1, 1.5, -0.4)")
        page.evaluate("quest.controllers.right.quaternion.set(0.6, 0, 0, 0.8)")
        message = headset.shown()
        assert message["right"]["grip"] is False and len(message["right"]["buttons"]) > 1
        assert pose(message["head"]).IsNearlyEqualTo(PLACED @ RigidTransform([0, 1.6, 0]), 1e-5)
        # Where the viewer's own library sees the grip, which lies within the controller.
        y_up = RigidTransform(RollPitchYaw(np.pi / 2, 0, 0), np.zeros(3))
        grips = np.reshape(page.evaluate("grips.map((grip) => grip.matrix.toArray())"), (2, 4, 4)).transpose(0, 2, 1)
        right = pose(message["right"]["pose"])
        assert sum(right.IsNearlyEqualTo(y_up @ RigidTransform(grip), 1e-5) for grip in grips) == 1
        hand = PLACED @ RigidTransform(Quaternion([0.8, 0.6, 0, 0]), [0.1, 1.5, -0.4])
        assert np.linalg.norm(right.translation() - hand.translation()) < 0.1
        start = headset.tip()
        before = share(screenshot(page), GREEN)
        page.evaluate("quest.controllers.right.updateButtonValue('squeeze', 1)")
        state(page, "data-vr=leading")
        assert headset.shown()["right"]["grip"] is True
        assert share(screenshot(page), GREEN) > before + 5e-4  # the hand that leads
        page.evaluate("quest.controllers.right.position.set(0.1, 1.5, -0.45)")  # 5 cm ahead
        becomes(lambda: np.allclose(headset.tip(), start + np.array([0.05, 0, 0]), atol=1e-3))
        page.evaluate("quest.controllers.right.updateButtonValue('squeeze', 0)")
        state(page, "data-vr=armed")
        watcher = Headset(headset.running)
        page.close()
        assert "page of the headset is gone" in watcher.until(lambda status: status["armed"] is False)["notice"]
        watcher.close()


def test_pinch_of_a_tracked_hand_leads_the_arm(browser: Browser) -> None:
    with worn(browser, "quest.primaryInputMode = 'hand'") as headset:
        page = headset.page
        page.evaluate("quest.hands.right.position.set(0.1, 1.5, -0.4)")
        message = headset.shown()
        assert message["right"]["grip"] is False
        wrist = pose(message["right"]["pose"])
        # The wrist lies behind the point of the hand that the emulator places.
        assert np.linalg.norm(wrist.translation() - PLACED @ np.array([0.1, 1.5, -0.4])) < 0.2
        start = headset.tip()
        page.evaluate("quest.hands.right.updatePinchValue(1)")
        state(page, "data-vr=leading")
        message = headset.shown()
        assert message["right"]["grip"] is True
        pinched = pose(message["right"]["pose"])
        page.evaluate("quest.hands.right.position.set(0.1, 1.5, -0.45)")  # 5 cm ahead
        becomes(lambda: np.allclose(headset.tip(), start + np.array([0.05, 0, 0]), atol=1e-3))
        moved = pose(headset.shown()["right"]["pose"])
        np.testing.assert_allclose(moved.translation() - pinched.translation(), [0.05, 0, 0], atol=1e-4)
        page.evaluate("quest.hands.right.updatePinchValue(0)")
        state(page, "data-vr=armed")
        # A hand that is not seen any more lets go, too.
        page.evaluate("quest.hands.right.updatePinchValue(1)")
        state(page, "data-vr=leading")
        page.evaluate("quest.hands.right.connected = false")
        state(page, "data-vr=armed")
        assert "the hand is not tracked" in page.inner_text("#vtb-vr-state")
        page.close()
