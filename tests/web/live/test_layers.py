"""Tests of the layers of the live page: what is drawn, against computations of its own."""

from __future__ import annotations

import io
import json
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import Context
from pydrake.systems.sensors import CameraInfo

from tests.station.test_hardware_sim import load
from tests.visualization.meshcat_page import messages
from tests.web.live.test_session import frame
from tests.web.live.test_session_server import PATIENCE, command, page, receive
from tests.web.serving.entrance import entered
from vtbdrake.optimization import Motion
from vtbdrake.testbed import Scenario, VirtualTestbed
from vtbdrake.visualization import make_meshcat
from vtbdrake.web import SimulationSession, view
from vtbdrake.web.live.layers import LayerError, Layers, body_paths, frustum
from vtbdrake_diagrams.cart_pole import CartPoleScenario
from vtbdrake_diagrams.cart_pole.dps import PERCEIVED
from vtbdrake_diagrams.cube_toss import CubeTossScenario
from vtbdrake_diagrams.double_pendulum import DoublePendulumScenario
from vtbdrake_diagrams.forest.scenario import ForestScenario
from vtbdrake_diagrams.satellite import SatelliteScenario
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

CUBE = "sim.sys.cube.pose"


@pytest.fixture(scope="module")
def meshcat() -> Meshcat:
    return make_meshcat()


def drawn(meshcat: Meshcat, kind: str, layer: str) -> dict[str, dict]:
    """Path below a layer -> message of a kind."""
    start = f"/drake/layers/{layer}/"
    matches = [m for m in messages(meshcat.StaticHtml()) if m["type"] == kind and m["path"].startswith(start)]
    return {m["path"].removeprefix(start): m for m in matches}


def started(scenario: Scenario, until: float, **values: object) -> tuple[VirtualTestbed, Context]:
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, values)
    simulator = testbed.simulator(context)
    simulator.Initialize()
    simulator.AdvanceTo(until)
    return testbed, context


@pytest.mark.slow_cases
@pytest.mark.parametrize(
    ("scenario", "names"),
    [
        (DoublePendulumScenario(), set()),
        (CartPoleScenario(), {"perceived"}),
        (CartPoleScenario(onboard=True), {"perceived", "decisions"}),
        (SpaceClimberScenario(), {"forces", "perceived"}),
        (SatelliteScenario(), {"forces", "cameras", "laser", "perceived"}),
        (ForestScenario(length=40.0, width=40.0), {"laser", "perceived", "landmarks"}),
    ],
    ids=lambda value: type(value).__name__,
)
def test_layers_without_a_source_are_not_offered(meshcat: Meshcat, scenario: Scenario, names: set[str]) -> None:
    layers = Layers(meshcat, scenario.build(), 1.0)
    assert set(layers.titles) >= names and set(layers.titles) - names <= {"forces"}
    with pytest.raises(LayerError, match="this testbed has no layer 'dreams'"):
        layers.show(["dreams"])


@pytest.mark.parametrize("model", ["point", "hydroelastic"])
def test_arrows_of_a_resting_cube_carry_its_weight(meshcat: Meshcat, model: str) -> None:
    config = MultibodyPlantConfig(time_step=1e-3, contact_model=model, discrete_contact_approximation="sap")
    scenario = CubeTossScenario(plant_config=config)
    height = 0.5 * scenario.edge
    testbed, context = started(scenario, 1.0, **{CUBE: [0.0, 0.0, height, 0.0, 0.0, 0.0]})
    layers = Layers(meshcat, testbed, 2.0)
    layers.show(["forces"])
    layers.draw(context)
    assert layers.notes["forces"] == "3.63 N reach 1 m to both sides of a contact"
    scales = {
        path: message["value"][2]
        for path, message in drawn(meshcat, "set_property", "forces").items()
        if path.endswith("cylinder") and "moment" not in path and message["property"] == "scale"
    }
    assert scales and sum(scales.values()) == pytest.approx(1.0, rel=0.02)  # 0.37 kg at 9.81 m/s^2
    layers.show([])
    assert not drawn(meshcat, "set_object", "forces")


def test_what_a_log_has_not_measured_is_not_shown(meshcat: Meshcat) -> None:
    testbed, context = started(SatelliteScenario(), 0.1)
    world = testbed.default_context()
    testbed.write(world, {"sim.sys.servicer.base.pose": [1.0, 2.0, 3.0, 0.0, 0.0, 0.0]})
    layers = Layers(meshcat, testbed, 1.0)
    layers.show(["forces", "cameras", "laser"])
    layers.draw(context, world)
    (place,) = (np.array(m["matrix"])[12:15] for m in drawn(meshcat, "set_transform", "cameras").values())
    assert np.linalg.norm(place - [1.0, 2.0, 3.0]) < 2.0  # on the servicer of the world that is shown
    layers.draw(context, context)
    (other,) = (np.array(m["matrix"])[12:15] for m in drawn(meshcat, "set_transform", "cameras").values())
    assert np.linalg.norm(other - [1.0, 2.0, 3.0]) > 2.0
    assert "not simulated" not in layers.notes["forces"]
    layers.draw(context, world)
    assert "it was not simulated" in layers.notes["forces"] and "it was not simulated" in layers.notes["laser"]
    with pytest.raises(LayerError, match="it was not simulated"):
        layers.image("sim.sense.docking_camera", context, world)


def test_ghost_is_where_the_dps_believes_the_robot_to_be(meshcat: Meshcat) -> None:
    testbed, context = started(CartPoleScenario(), 0.1)
    state = np.array(testbed.read(context, PERCEIVED))
    state[0] = 1.25
    testbed.write(context, {PERCEIVED: state})
    layers = Layers(meshcat, testbed, 1.0)
    layers.show(["perceived"])
    layers.draw(context)
    matrix = np.array(drawn(meshcat, "set_transform", "perceived")["ghost/cart_pole/cart"]["matrix"])
    assert matrix.reshape(4, 4).T[0, 3] == pytest.approx(1.25)
    assert testbed.read(context, "sim.sys.cart_pole.cart_slider.position") == 0.0  # The world is as it was.


def test_ellipsoid_is_the_covariance_of_the_tracker(meshcat: Meshcat) -> None:
    testbed, context = started(SatelliteScenario(perception="pose_sensor"), 1.0)
    layers = Layers(meshcat, testbed, 1.0)
    layers.show(["perceived"])
    layers.draw(context)
    matrix = np.array(drawn(meshcat, "set_transform", "perceived")["covariance/dps.env.target"]["matrix"])
    X = matrix.reshape(4, 4).T
    numbers = np.asarray(testbed.read(context, "dps.env.target.track"))
    np.testing.assert_allclose(X[:3, 3], numbers[10:13])
    # Points of an ellipsoid of two standard deviations: M M' = 4 P.
    P = numbers[19:].reshape(12, 12)[3:6, 3:6]
    np.testing.assert_allclose(X[:3, :3] @ X[:3, :3].T, 4.0 * P, rtol=0.05, atol=1e-6)


def test_edges_of_a_frustum_are_seen_in_the_corners_of_the_image() -> None:
    info = CameraInfo(320, 200, 250.0, 260.0, 150.0, 110.0)
    _, end = frustum(info, 2.5)
    corners = end[:, :4]
    assert np.all(corners[2] == 2.5)
    pixels = info.intrinsic_matrix() @ corners
    expected = np.array([[0.0, 0.0], [320.0, 0.0], [320.0, 200.0], [0.0, 200.0]])
    np.testing.assert_allclose((pixels[:2] / pixels[2]).T, expected, atol=1e-9)


def test_paths_of_candidates_are_those_of_the_centres_of_mass() -> None:
    scenario = CartPoleScenario()
    testbed = scenario.build()
    angle = np.linspace(0.0, 1.0, 7)
    states = np.stack([0.1 * angle, angle, 0.0 * angle, 0.0 * angle], axis=1)
    paths = body_paths(testbed, Motion(scenario, np.arange(7.0), states))
    np.testing.assert_allclose(paths["cart_pole/cart"][0], 0.1 * angle)
    x, _, z = paths["cart_pole/pole"]
    length = -z[0]
    assert length > 0.1
    np.testing.assert_allclose(np.abs(x - 0.1 * angle), length * np.sin(angle), atol=1e-9)
    np.testing.assert_allclose(z, -length * np.cos(angle), atol=1e-9)


def test_candidates_of_the_decision_in_use_are_shown() -> None:
    with SimulationSession(CartPoleScenario(onboard=True, rollouts=4)) as session:
        session.show("me", ["decisions"])
        assert (
            frame(session, lambda shown: bool(shown.layers)).layers["decisions"].endswith("since this layer is shown")
        )
        session.watch("me", ["dps.planner.quality"])
        session.advance(40)
        shown = frame(session, lambda shown: shown.time > 0.3)
        cost = shown.values["dps.planner.quality"]
        assert shown.layers["decisions"].startswith(f"dps.planner, cost = {cost:.4g}: ")
        session.show("me", [])
        assert frame(session, lambda now: now.number > shown.number).layers == {}


def test_layer_that_cannot_be_drawn_says_why_and_nothing_stops() -> None:
    with SimulationSession(ForestScenario(length=40.0, width=40.0)) as session:
        session.show("me", ["perceived"])
        shown = frame(session, lambda shown: bool(shown.layers))
        assert "the carrier is not localized" in shown.layers["perceived"]
        assert not shown.failure
        session.advance(2)


def test_layers_are_shown_as_long_as_somebody_looks() -> None:
    with SimulationSession(CartPoleScenario()) as session:
        session.show("a", ["perceived"])
        session.show("b", ["perceived"])
        session.show("a", [])
        number = session.latest.number
        assert frame(session, lambda shown: shown.number > number).layers == {"perceived": ""}
        session.show("b", [])
        number = session.latest.number
        assert frame(session, lambda shown: shown.number > number).layers == {}
        with pytest.raises(LayerError, match="there is no camera 'eye'; there are: none"):
            session.camera_image("eye")


def test_server_gives_images_and_layers_to_pages_that_watch() -> None:
    scenario = SatelliteScenario(perception="camera")
    with view(scenario) as running, page(running) as first, page(running) as second:
        hello = receive(second, "hello")
        assert hello["cameras"] == ["sim.sense.docking_camera"]
        receive(first, "frame")
        assert command(second, "layers", layers=["cameras"]) == ""
        while "cameras" not in receive(second, "frame")["layers"]:
            pass
        assert "no layer 'dreams'" in command(second, "layers", layers=["dreams"])
        second.send(json.dumps({"id": 2, "do": "landmarks", "near": [0.0, 0.0, 0.0], "count": 3}))
        assert receive(second, "answer")["result"] == []
        assert "near a point (3,)" in command(second, "landmarks", near=[0.0], count=3)
        url = f"{entered(running.url)}camera/sim.sense.docking_camera"
        with urllib.request.urlopen(url, timeout=PATIENCE) as answer:
            data = answer.read()
        testbed = scenario.build()
        context = testbed.default_context()
        simulator = testbed.simulator(context)
        simulator.Initialize()
        camera = testbed.simulated_sensors["image"]
        pixels = camera.GetOutputPort("color_image").Eval(camera.GetMyContextFromRoot(context)).data[..., :3]
        error = np.abs(np.asarray(Image.open(io.BytesIO(data))).astype(float) - pixels)
        assert pixels.std() > 10.0 and error.mean() < 3.0


def test_frustum_and_image_of_a_camera_of_drake(meshcat: Meshcat, tmp_path: Path) -> None:
    testbed, context = started(load(tmp_path), 0.1)
    layers = Layers(meshcat, testbed, 1.0)
    (camera,) = layers.cameras
    layers.show(["cameras"])
    layers.draw(context)
    matrix = np.array(drawn(meshcat, "set_transform", "cameras")[camera]["matrix"]).reshape(4, 4).T
    expected = RigidTransform(RollPitchYaw(np.radians([-120.0, 5.0, 125.0])), [1.5, 0.8, 1.25])
    np.testing.assert_allclose(matrix, expected.GetAsMatrix4(), atol=1e-12)
    held = testbed.diagram.GetSubsystemByName("sim.sense.camera_0")
    image = held.GetOutputPort("color_image").Eval(held.GetMyContextFromRoot(context)).data[..., :3]
    shown = layers.image(camera, context)
    assert shown.shape == (48, 64, 3) and shown.std() > 1.0
    assert np.abs(shown.astype(float) - image).mean() < 2.0  # The held one is 0.1 s old at most.
