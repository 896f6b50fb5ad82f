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
from vtbdrake.visualization import mermaid, svg

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
        builder.builder.AddNamedSystem("logger", ConstantValueSource(pose))


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
    picture, chart = svg(pendulum, context), mermaid(pendulum, context)
    assert positions(picture) == {"T_sense.joint_state": sense, "T_act.torque": act, "u.angle": ""}
    assert {sense, act} <= texts(picture)
    assert f'"T_sense.joint_state: {sense}"' in chart
    assert f'"T_act.torque: {act}"' in chart


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


def test_mermaid_arrows_follow_the_switches(pendulum: VirtualTestbed) -> None:
    lines = [line.strip() for line in mermaid(pendulum, thrown(pendulum, "shadow")).splitlines()]
    assert {"sim_sys_0 -.-> T_sense_0", "real_sense_0 ==> T_sense_0"} <= set(lines)
    assert {"T_act_0 ==> sim_sys_0", "T_act_0 -.-> real_act_0"} <= set(lines)
    assert 'T_sense_0 ==>|"2 [rad, rad/s]"| dps' in lines
    assert 'u_0(["u.angle"]) ==>|"1 [rad]"| dps' in lines


def test_parts_are_named(pendulum: VirtualTestbed) -> None:
    found = texts(svg(pendulum))
    assert {"plant: Pendulum", "spring", "damper", "joint_state", "torque", "u.angle", "PendulumScenario"} <= found
    assert {"real.sense.joint_state", "real.act.torque"} <= found
    assert {'dps_2["spring"]:::dps', 'sim_sys_0["plant: Pendulum"]:::sim'} <= {
        line.strip() for line in mermaid(pendulum).splitlines()
    }


def test_simulated_sensor_is_the_one_that_feeds_the_switch() -> None:
    testbed = AcrobotScenario().build()
    assert "sim.sense.joints" in texts(svg(testbed))
    assert "sim_sense_0 ==> T_sense_0" in mermaid(testbed)


def test_ground_belongs_to_the_environment() -> None:
    builder = VirtualTestbedBuilder(Interface(sense=[], act=[]))
    plant, _ = builder.add_plant()
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", CoulombFriction(1, 1))
    builder.set_dps(ConstantVectorSource([0.0]))
    assert 'sim_env_0["plant: world"]:::sim' in mermaid(builder.build())


def test_names_are_escaped_and_every_role_is_drawn() -> None:
    testbed = RelayScenario().build()
    found = texts(svg(testbed))
    assert {"camera<1>", "arm", "RigidTransform", "PoseRelay"} <= found
    assert any("further systems: logger" in text for text in found)
    chart = mermaid(testbed)
    assert '["camera&lt;1&gt;"]' in chart
    assert 'subgraph dps["DPS: PoseRelay"]' in chart
    assert chart.count("subgraph") == chart.count("\n    end") + chart.count("\n        end")
