"""Test of the page in a headset, which IWER emulates: what is tracked, sent and drawn, and what the arm does."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from tests.chromium import PATIENCE, needs_chromium, screenshot
from tests.web.test_page import GREEN, share
from tests.web.test_vr import Headset, PatientArm, becomes, tip
from vtbdrake.web import view

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

pytestmark = [pytest.mark.slow, pytest.mark.one_python, needs_chromium]


def pose(numbers: list[float]) -> RigidTransform:
    return RigidTransform(Quaternion(np.array(numbers[:4])), numbers[4:])


def state(page: Page, attribute: str) -> None:
    page.wait_for_selector(f"body[{attribute}]", state="attached")


def test_controller_in_a_headset_leads_the_arm(browser: Browser) -> None:
    # Where the wearer stands: behind the arm, at x = -0.7 m, and looks along x.
    placed = RigidTransform(RotationMatrix(np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])), [-0.7, 0, 0])
    sent: list[dict[str, Any]] = []
    failures: list[str] = []

    def note(data: str) -> None:
        message = json.loads(data)
        if "time" in message:
            sent.append(message)

    with view(PatientArm(), vr=True) as running:
        # Small: two pictures per frame are drawn without a graphics card.
        page = browser.new_page(viewport={"width": 380, "height": 240})
        page.set_default_timeout(PATIENCE)
        page.on("pageerror", lambda error: failures.append(str(error)))
        page.on("websocket", lambda socket: socket.on("framesent", note) if socket.url.endswith("/vr") else None)
        page.add_init_script(IWER.read_text() + INSTALL)
        page.goto(running.url)
        state(page, "data-session=open")
        page.click("#vtb-vr-arm")
        state(page, "data-vr=armed")
        page.evaluate("window.grips = [0, 1].map((k) => viewer.renderer.xr.getControllerGrip(k))")
        page.click("text=ENTER VR")
        state(page, "data-headset=entered")
        page.evaluate("document.body.classList.add('vtb-folded')")
        page.evaluate("quest.position.set(0, 1.6, 0); quest.controllers.right.position.set(0.1, 1.5, -0.4)")
        page.evaluate("quest.controllers.right.quaternion.set(0.6, 0, 0, 0.8)")

        def shown() -> dict[str, Any]:
            """Return what is sent a few frames later."""
            poses = int(page.evaluate("document.body.dataset.poses ?? 0"))
            page.wait_for_function(f"Number(document.body.dataset.poses) > {poses + 4}")
            return sent[-1]

        message = shown()
        assert message["right"]["grip"] is False and len(message["right"]["buttons"]) > 1
        assert pose(message["head"]).IsNearlyEqualTo(placed @ RigidTransform([0, 1.6, 0]), 1e-5)
        # Where the viewer's own library sees the grip, which lies within the controller.
        y_up = RigidTransform(RollPitchYaw(np.pi / 2, 0, 0), np.zeros(3))
        grips = np.reshape(page.evaluate("grips.map((grip) => grip.matrix.toArray())"), (2, 4, 4)).transpose(0, 2, 1)
        right = pose(message["right"]["pose"])
        assert sum(right.IsNearlyEqualTo(y_up @ RigidTransform(grip), 1e-5) for grip in grips) == 1
        hand = placed @ RigidTransform(Quaternion([0.8, 0.6, 0, 0]), [0.1, 1.5, -0.4])
        assert np.linalg.norm(right.translation() - hand.translation()) < 0.1
        start = tip(running.session.snapshot().values)
        before = share(screenshot(page), GREEN)
        page.evaluate("quest.controllers.right.updateButtonValue('squeeze', 1)")
        state(page, "data-vr=leading")
        assert shown()["right"]["grip"] is True
        assert share(screenshot(page), GREEN) > before + 5e-4  # the hand that leads
        page.evaluate("quest.controllers.right.position.set(0.1, 1.5, -0.45)")  # 5 cm ahead
        becomes(lambda: np.allclose(tip(running.session.snapshot().values), start + np.array([0.05, 0, 0]), atol=1e-3))
        page.evaluate("quest.controllers.right.updateButtonValue('squeeze', 0)")
        state(page, "data-vr=armed")
        watcher = Headset(running)
        page.close()
        assert "page of the headset is gone" in watcher.until(lambda status: status["armed"] is False)["notice"]
        watcher.close()
    assert not failures
