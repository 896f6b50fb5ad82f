"""Tests of the watching of a loop that runs elsewhere, against what the loop does."""

from __future__ import annotations

from collections.abc import Iterator

import msgpack
import numpy as np
import pytest
from websockets.sync.client import connect

from tests.web.live.loops import cart_pole_loop
from tests.web.live.test_session import frame
from tests.web.live.test_session_server import PATIENCE, command, page
from vtbdrake.lcm.hub import Hub
from vtbdrake.monitoring import LiveClient
from vtbdrake.state import AddressError
from vtbdrake.web import LoopSession, SessionError, View
from vtbdrake.web.live.layers import LayerError
from vtbdrake.web.live.session_server import Server
from vtbdrake.web.live.viewer import view_loop
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.dps import PERCEIVED
from vtbdrake_diagrams.satellite import SatelliteScenario

CART = 0.3  # m


@pytest.fixture(scope="module")
def hub() -> Iterator[Hub]:
    with Hub(port=0) as running:
        yield running


def still(_: float) -> dict[str, list[float]]:
    return {"joint_position": [CART, 0.0], "joint_velocity": [0.0, 0.0]}


def test_poses_values_and_switches_are_those_of_the_loop(hub: Hub) -> None:
    with cart_pole_loop(hub.url, still) as runtime, LoopSession(CartPoleScenario(), hub.url) as session:
        session.watch("me", [PERCEIVED, "dps.force"])
        shown = frame(session, lambda shown: shown.playing and bool(shown.positions) and len(shown.values) == 2)
        assert shown.positions["act"] == {"force": "real"}
        np.testing.assert_allclose(shown.values[PERCEIVED], [CART, 0.0, 0.0, 0.0], atol=1e-9)
        assert all(0.0 <= age < PATIENCE for age in shown.loop["ages"].values())
        assert (shown.failure, shown.warnings, shown.loop["reasons"]) == ("", (), [])
        assert 0.0 < shown.time <= runtime.time
        now = frame(session, lambda now: now.time > shown.time + 1.5 and now.rate > 0.0)
        assert 0.5 * now.rate <= now.time  # It is measured over half a second at least.
        with connect(session.meshcat_url.replace("http", "ws"), max_size=None) as meshcat:
            place = None
            while place is None or abs(place - CART) > 1e-6:  # first the default pose, then the loop's
                message = msgpack.unpackb(meshcat.recv(PATIENCE))
                if message["type"] == "set_transform" and message["path"] == "/drake/now/cart_pole/cart":
                    place = message["matrix"][12]


@pytest.mark.slow
def test_layers_of_a_loop_are_those_that_poses_tell(hub: Hub) -> None:
    with LoopSession(SatelliteScenario(), hub.url) as session:
        assert dict(session.layers) == {"cameras": "camera frusta"}
        assert session.cameras == () and session.latest.history == (0.0, 0.0)
        with pytest.raises(LayerError, match="no layer 'forces'"):
            session.show("me", ["forces"])
        session.show("me", ["cameras"])
        frame(session, lambda shown: "cameras" in shown.layers)
        with connect(session.meshcat_url.replace("http", "ws"), max_size=None) as meshcat:
            path = ""
            while not path.startswith("/drake/layers/cameras/"):
                message = msgpack.unpackb(meshcat.recv(PATIENCE))
                path = message.get("path", "") if message["type"] == "set_object" else ""
        session.show("me", [])
        frame(session, lambda shown: not shown.layers)


def test_loop_in_a_notebook_is_its_page_without_a_picture(hub: Hub) -> None:
    with view_loop(CartPoleScenario(), hub.url) as running:
        bundle = running._repr_mimebundle_()
        assert bundle["text/plain"].startswith("<View of vtbdrake_diagrams.cart_pole.scenario:CartPoleScenario>")
        assert "show(place" in bundle["text/html"] and "image/png" not in bundle


def test_page_sets_and_resets_only_what_the_loop_accepts(hub: Hub) -> None:
    with cart_pole_loop(hub.url, still) as runtime, LoopSession(CartPoleScenario(), hub.url) as session:
        frame(session, lambda shown: shown.playing)
        plan = [0.0, *np.arange(10.0)]
        session.write({"u.plan": plan})
        with LiveClient(hub.url, timeout=PATIENCE) as client:
            np.testing.assert_array_equal(client.get(["u.plan"])["u.plan"], plan)
        session.reset()
        with pytest.raises(SessionError, match="no variable 'sim.sys.cart_pole.pole.mass' of the DPS"):
            session.write({"sim.sys.cart_pole.pole.mass": 1.0})
        with pytest.raises(AddressError, match="no variable and no port 'nothing'"):
            session.watch("me", ["nothing"])
        with View(session, Server(session)) as view, page(view) as socket:
            for refused in ({"do": "play"}, {"do": "step"}, {"do": "switch", "mode": "sim"}, {"do": "seek", "time": 0}):
                assert "keeps its own time and switches" in command(socket, refused.pop("do"), **refused)
        assert not runtime.guards.latched


def test_reason_against_commands_and_a_latched_fault_are_told(hub: Hub) -> None:
    reasons: list[str] = ["the brakes are on"]
    values = {"now": still(0.0)}
    with (
        cart_pole_loop(hub.url, lambda _: values["now"], blocked_by=lambda: reasons[-1] if reasons else None),
        LoopSession(CartPoleScenario(), hub.url) as session,
    ):
        shown = frame(session, lambda shown: bool(shown.positions))
        assert shown.positions["act"] == {"force": "idle"}
        assert any("the brakes are on" in reason for reason in shown.loop["reasons"])
        reasons.clear()
        frame(session, lambda shown: shown.positions.get("act") == {"force": "real"})
        values["now"] = {}
        shown = frame(session, lambda shown: bool(shown.warnings))
        assert shown.warnings[0].startswith("the fallbacks command: ") and "joint_" in shown.warnings[0]
        with pytest.raises(SessionError, match="joint_"):
            session.reset()
        values["now"] = still(0.0)

        def is_over(_: object) -> bool:
            try:
                session.reset()
            except SessionError:
                return False
            return True

        frame(session, is_over)
        frame(session, lambda shown: not shown.warnings)


def test_end_of_the_loop_is_told_and_a_new_one_is_found(hub: Hub) -> None:
    with LoopSession(CartPoleScenario(), hub.url) as session:
        shown = frame(session, lambda shown: bool(shown.failure))
        assert "does a DPS run there" in shown.failure and not shown.playing
        for _ in range(2):
            with cart_pole_loop(hub.url, still):
                frame(session, lambda shown: shown.playing and not shown.failure)
            shown = frame(session, lambda shown: bool(shown.failure))
            assert shown.failure == "the loop has ended" and shown.loop == {}
        session.watch("me", [PERCEIVED])
        assert frame(session, lambda now: now.number > shown.number).values == {}


def test_lost_bus_is_told() -> None:
    with Hub(port=0) as bus:
        url = bus.url
    with LoopSession(CartPoleScenario(), url) as session:
        assert frame(session, lambda shown: bool(shown.failure)).failure
        with pytest.raises(SessionError):
            session.reset()
