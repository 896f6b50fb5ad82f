"""The drawings name every part and signal, and say where the switches stand."""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import HalfSpace
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction
from pydrake.systems.framework import System
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, PassThrough

from tests.testbeds import AcrobotScenario, PendulumScenario, PoseRelay
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbed, VirtualTestbedBuilder
from vtbdrake.visualization import svg
from vtbdrake.visualization.diagram import structure_of

SVG = "{http://www.w3.org/2000/svg}"


@dataclass
class RelayScenario(Scenario):
    """Abstract signals, a part of each role but sys, and no plant."""

    def interface(self) -> Interface:
        pose = RigidTransform()
        return Interface(
            sense=[Signal("seen", model_value=pose)], act=[Signal("commanded", model_value=pose, idle=pose)]
        )

    def make_dps(self) -> System:
        return PoseRelay()

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        pose = Value(RigidTransform())
        builder.sim_sensor("seen", builder.add("sense", "camera<1>", ConstantValueSource(pose)).get_output_port())
        builder.sim_actuator("commanded", builder.add("act", "arm", PassThrough(pose)).get_input_port())
        builder.diagram_builder.AddNamedSystem("logger", ConstantValueSource(pose))


@pytest.fixture(scope="module")
def pendulum() -> VirtualTestbed:
    return PendulumScenario().build()


def positions(picture: str) -> dict[str, str]:
    groups = ElementTree.fromstring(picture).iter(f"{SVG}g")
    return {g.attrib["id"]: g.get("data-position", "") for g in groups if "id" in g.attrib}


def texts(picture: str) -> set[str]:
    return {element.text or "" for element in ElementTree.fromstring(picture).iter(f"{SVG}text")}


def thrown(testbed: VirtualTestbed, mode: str):
    context = testbed.default_context()
    testbed.diagram.GetInputPort("real.sense.joint_state").FixValue(context, np.zeros(2))
    testbed.switch(context, mode)
    return context


@pytest.mark.parametrize(
    ("mode", "sense", "act"),
    [("sim", "sim", "sim"), ("shadow", "real", "sim"), ("real", "real", "real"), ("twin", "real", "twin")],
)
def test_switches_are_drawn_where_they_stand(pendulum: VirtualTestbed, mode: str, sense: str, act: str) -> None:
    context = thrown(pendulum, mode)
    picture = svg(pendulum, context)
    assert positions(picture) == {"T_sense.joint_state": sense, "T_act.torque": act, "u.angle": ""}
    assert {sense, act} <= texts(picture)


def test_without_a_context_switches_stand_as_built() -> None:
    assert positions(svg(PendulumScenario().build(mode="twin")))["T_act.torque"] == "twin"


def test_levers_lead_to_the_branches_in_use(pendulum: VirtualTestbed) -> None:
    def used(mode: str, signal: str) -> list[str]:
        root = ElementTree.fromstring(svg(pendulum, thrown(pendulum, mode)))
        (group,) = [g for g in root.iter(f"{SVG}g") if g.get("id") == signal]
        lines = [line for line in group.iter(f"{SVG}polyline") if line.get("stroke-width") == "2.4"]
        return [line.attrib["stroke"] for line in lines]

    sim, real, dps = "#1d6fb8", "#c8501e", "#2f6f4f"
    assert used("sim", "T_act.torque") == [sim, sim, dps]
    assert used("real", "T_act.torque") == [real, real, dps]
    assert used("twin", "T_act.torque") == [real, real, sim, sim, dps]


def test_parts_are_named(pendulum: VirtualTestbed) -> None:
    found = texts(svg(pendulum))
    assert {"plant: Pendulum", "spring", "damper", "joint_state", "torque", "u.angle", "PendulumScenario"} <= found
    assert {"real.sense.joint_state", "real.act.torque"} <= found


def test_simulated_sensor_is_the_one_that_feeds_the_switch() -> None:
    testbed = AcrobotScenario().build()
    assert "sim.sense.joints" in texts(svg(testbed))


def test_ground_belongs_to_the_environment() -> None:
    builder = VirtualTestbedBuilder(Interface(sense=[], act=[]))
    plant, _ = builder.add_plant()
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", CoulombFriction(1, 1))
    builder.set_dps(ConstantVectorSource([0.0]))
    drawn = structure_of(builder.build())
    assert drawn.world["env"] == ("plant: world",)


def test_names_are_escaped_and_every_role_is_drawn() -> None:
    testbed = RelayScenario().build()
    found = texts(svg(testbed))
    assert {"camera<1>", "arm", "RigidTransform", "PoseRelay"} <= found
    assert any("further systems: logger" in text for text in found)


@pytest.mark.parametrize("mode", ["sim", "real"])
def test_the_side_of_the_actuators_mirrors_that_of_the_sensors(mode: str) -> None:
    picture = ElementTree.fromstring(svg(RelayScenario().build(mode=mode)))
    width = float(picture.attrib["width"])
    dots = {(float(dot.attrib["cx"]), float(dot.attrib["cy"])) for dot in picture.iter(f"{SVG}circle")}
    assert dots == {(width - x, y) for x, y in dots}
    levels = {y for _, y in dots}
    # Each world is connected with the contacts of its own colour.
    colors = [(dot.get("stroke"), dot.attrib["fill"], dot.attrib["cy"]) for dot in picture.iter(f"{SVG}circle")]
    assert {(fill, y) for stroke, fill, y in colors if not stroke} <= {(stroke, y) for stroke, _, y in colors}
    lines: dict[str, set[tuple[str, frozenset[tuple[float, float]]]]] = {"left": set(), "right": set()}
    for line in picture.iter(f"{SVG}polyline"):
        ends = [tuple(map(float, point.split(","))) for point in line.attrib["points"].split()]
        if not levels & {y for _, y in ends}:  # within a world
            continue
        is_left = ends[0][0] < width / 2.0
        points = frozenset((x if is_left else width - x, y) for x, y in ends)
        lines["left" if is_left else "right"].add((line.attrib["stroke"], points))
        # Commands arrive at the worlds, measurements at the DPS.
        if "marker-end" in line.attrib:
            assert ends[-1][0] == ends[0][0] if not is_left else ends[-1][0] > ends[0][0]
    assert lines["left"] == lines["right"]
    assert len(lines["left"]) == 8
