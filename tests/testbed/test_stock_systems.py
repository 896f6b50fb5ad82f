"""Drake's own systems and composites in a testbed: copies continue alike, or the testbed is refused with a remedy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pydrake.examples as examples
import pydrake.lcm
import pytest
from drake import lcmt_iiwa_command
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
    SceneGraph,
)
from pydrake.manipulation import (
    SchunkWsgController,
    SchunkWsgPositionController,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.perception import BaseField, Fields, PointCloud
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController, PidControlledSystem, PidController
from pydrake.systems.framework import DiagramBuilder, LeafSystem, PortDataType
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.primitives import (
    ConstantValueSource,
    DiscreteDerivative,
    DiscreteTimeDelay,
    DiscreteTimeIntegrator,
    FirstOrderLowPassFilter,
    Integrator,
    LinearSystem,
    StateInterpolatorWithDiscreteDerivative,
    ZeroOrderHold,
)
from pydrake.systems.sensors import (
    CameraInfo,
    ImageDepth32F,
    ImageRgba8U,
    RgbdSensor,
    RgbdSensorAsync,
    RgbdSensorDiscrete,
)

from vtbdrake.state import Codec, Snapshot
from vtbdrake.testbed import Interface, VirtualTestbedBuilder

PERIOD = 0.1


def _cameras():
    core = RenderCameraCore("renderer", CameraInfo(8, 6, 1.0), ClippingRange(0.1, 10.0), RigidTransform())
    return ColorRenderCamera(core), DepthRenderCamera(core, DepthRange(0.1, 9.0))


def _double_pendulum() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    parent = plant.world_body()
    for name in ("upper", "lower"):
        body = plant.AddRigidBody(name, SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
        joint = RevoluteJoint(name, parent.body_frame(), body.body_frame(), [0.0, 1.0, 0.0])
        plant.AddJointActuator(name, plant.AddJoint(joint))
        parent = body
    plant.Finalize()
    return plant


def _image(t: float, kind: type = ImageRgba8U) -> Any:
    image = kind(4, 3)
    image.mutable_data[:] = np.random.default_rng(round(t / 0.03)).integers(0, 255, image.data.shape)
    return image


def _pose(t: float) -> RigidTransform:
    return RigidTransform(RollPitchYaw(t, 0.3 * t, -t), [np.sin(t), t, 1.0 / 3.0])


def _cloud(t: float) -> PointCloud:
    cloud = PointCloud(2 + round(10 * t) % 3, Fields(BaseField.kXYZs | BaseField.kRGBs))
    cloud.mutable_xyzs()[:] = np.sin(t + np.arange(cloud.xyzs().size)).reshape(3, -1)
    cloud.mutable_rgbs()[:] = round(100 * t) % 255
    return cloud


class Source(LeafSystem):
    """Feeds one port with what changes all the time."""

    def __init__(self, model: Any, value: Callable[[float], Any]) -> None:
        super().__init__()
        if isinstance(model, int):
            self.DeclareVectorOutputPort("y", model, lambda context, y: y.SetFromVector(value(context.get_time())))
        else:
            self.DeclareAbstractOutputPort(
                "y", lambda: Value(model), lambda context, y: y.set_value(value(context.get_time()))
            )


def _testbed(make, value=None):
    """A testbed with the system, which nobody has named, and something on each of its inputs."""
    parts = VirtualTestbedBuilder(Interface([], []))
    parts.set_dps(LeafSystem())
    system = parts.diagram_builder.AddSystem(make())
    for i in range(system.num_input_ports()):
        port = system.get_input_port(i)
        if port.get_data_type() == PortDataType.kVectorValued:
            waves = np.arange(1, port.size() + 1) + 0.3 * i
            source = Source(port.size(), lambda t, waves=waves: 0.05 * np.sin(3.0 * waves * t))
        elif value is not None:
            source = Source(value(0.0), value)
        else:
            source = ConstantValueSource(port.Allocate())
        parts.diagram_builder.Connect(parts.diagram_builder.AddSystem(source).get_output_port(), port)
    return parts.build()


WORKING = {
    "pose hold": (lambda: ZeroOrderHold(PERIOD, Value(RigidTransform())), _pose),
    "rotation hold": (lambda: ZeroOrderHold(PERIOD, Value(RotationMatrix())), lambda t: _pose(t).rotation()),
    "image hold": (lambda: ZeroOrderHold(PERIOD, Value(ImageRgba8U(4, 3))), _image),
    "hold of an image of another size": (lambda: ZeroOrderHold(PERIOD, Value(ImageRgba8U())), _image),
    "depth hold": (
        lambda: ZeroOrderHold(PERIOD, Value(ImageDepth32F(4, 3))),
        lambda t: _image(t, ImageDepth32F),
    ),
    "cloud hold": (lambda: ZeroOrderHold(PERIOD, Value(_cloud(0.0))), _cloud),
    "text hold": (lambda: ZeroOrderHold(PERIOD, Value("")), lambda t: f"at {t:g} s, ü"),
    "array hold": (lambda: ZeroOrderHold(PERIOD, Value(np.zeros(2))), lambda t: np.full(1 + round(t / 0.1) % 3, t)),
    "number hold": (lambda: ZeroOrderHold(PERIOD, Value(0.0)), lambda t: t / 3.0),
    "pose delay": (lambda: DiscreteTimeDelay(PERIOD, 3, Value(RigidTransform())), _pose),
    "image delay": (lambda: DiscreteTimeDelay(PERIOD, 2, Value(ImageRgba8U(4, 3))), _image),
    "vector delay": (lambda: DiscreteTimeDelay(PERIOD, 3, 2), None),
    "derivative": (lambda: DiscreteDerivative(2, PERIOD), None),
    "discrete integrator": (lambda: DiscreteTimeIntegrator(2, PERIOD), None),
    "integrator": (lambda: Integrator(2), None),
    "low pass": (lambda: FirstOrderLowPassFilter(0.3, 2), None),
    "pid": (lambda: PidController([1.0], [2.0], [3.0]), None),
    "interpolator": (lambda: StateInterpolatorWithDiscreteDerivative(2, PERIOD), None),
    "pid-controlled system": (
        lambda: PidControlledSystem(
            LinearSystem(-np.eye(2), np.ones((2, 1)), np.eye(2), np.zeros((2, 1))), [1.0], [1.0], [1.0]
        ),
        None,
    ),
    "inverse dynamics": (
        lambda: InverseDynamicsController(_double_pendulum(), [1.0] * 2, [1.0] * 2, [1.0] * 2, False),
        None,
    ),
    "gripper position": (lambda: SchunkWsgPositionController(), None),
    "rimless wheel": (lambda: examples.RimlessWheel(), None),
    "pendulum": (lambda: examples.PendulumPlant(), None),
    "van der Pol": (lambda: examples.VanDerPolOscillator(), None),
    "quadrotor": (lambda: examples.QuadrotorPlant(), None),
}


@pytest.mark.parametrize("kind", WORKING)
def test_original_and_copy_continue_alike(kind, tmp_path):
    original, copy = _testbed(*WORKING[kind]), _testbed(*WORKING[kind])
    context = original.default_context()
    moving = [v for v in original.variables().values() if v.address.endswith(".continuous_state")]
    original.write(context, {v.address: np.linspace(0.1, 0.2, v.shape[0]) for v in moving})
    original.simulator(context).AdvanceTo(0.73)
    at_fork = original.snapshot(context)
    at_fork.save(tmp_path / "fork.vtb")
    copied = copy.default_context()
    copy.restore(copied, Snapshot.load(tmp_path / "fork.vtb"))
    assert not copy.snapshot(copied).compare(at_fork)
    # Both with an integrator that remembers no step, see `StateCopier` for copies of another kind.
    original.simulator(context, restored=True).AdvanceTo(1.9)
    copy.simulator(copied, restored=True).AdvanceTo(1.9)
    after = original.snapshot(context)
    assert not copy.snapshot(copied).compare(after)
    assert after.compare(at_fork).keys() - {"time"}


@pytest.mark.parametrize("kind", ["pose delay", "image delay"])
def test_what_is_delayed_comes_out_at_its_time(kind, tmp_path):
    """The copy does not only agree with the original: both show what went in three (two) samples before."""
    testbed = _testbed(*WORKING[kind])
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(0.75)
    copied = testbed.default_context()
    testbed.restore(copied, testbed.snapshot(context))
    value, steps = WORKING[kind][1], {"pose delay": 3, "image delay": 2}[kind]
    simulator = testbed.simulator(copied, restored=True)
    for sample in range(8, 14):
        simulator.AdvanceTo(sample * PERIOD + 0.05)
        shown = testbed.read(copied, "DiscreteTimeDelay.delayed_u")
        expected = value((sample - steps) * PERIOD)
        if kind == "pose delay":
            np.testing.assert_allclose(shown.GetAsMatrix34(), expected.GetAsMatrix34(), atol=1e-12)
        else:
            np.testing.assert_array_equal(shown.data, expected.data)


def test_cameras_that_are_sampled_by_a_composite_come_back():
    def build():
        parts = VirtualTestbedBuilder(Interface([], []))
        parts.set_dps(LeafSystem())
        _, scene_graph = parts.add_plant()
        sensor = RgbdSensor(SceneGraph.world_frame_id(), RigidTransform([0.0, 0.0, 1.0]), *_cameras())
        camera = parts.diagram_builder.AddSystem(RgbdSensorDiscrete(sensor, PERIOD))
        parts.diagram_builder.Connect(scene_graph.get_query_output_port(), camera.get_input_port())
        return parts.build()

    original, copy = build(), build()
    assert list(original.variables()) == list(copy.variables())
    context = original.default_context()
    original.write(context, {"RgbdSensorDiscrete.RgbdSensor.pose": [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]})
    copied = copy.default_context()
    copy.restore(copied, original.snapshot(context))
    assert not copy.snapshot(copied).compare(original.snapshot(context))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: RgbdSensorAsync(
                SceneGraph(), SceneGraph.world_frame_id(), RigidTransform(), 10.0, 0.0, 0.05, *_cameras()
            ),
            "RgbdSensorAsync is a RgbdSensorAsync, .*: use an RgbdSensorDiscrete",
        ),
        (
            SchunkWsgController,
            "SchunkWsgController.SchunkWsgTrajectoryGenerator is a .*: use a SchunkWsgPositionController",
        ),
        (
            lambda: LcmSubscriberSystem.Make("X", lcmt_iiwa_command, pydrake.lcm.DrakeLcm("memq://")),
            "LcmSubscriberSystem, which receives data from outside the Diagram: feed the DPS by a real port",
        ),
        (
            lambda: LcmPublisherSystem.Make("X", lcmt_iiwa_command, pydrake.lcm.DrakeLcm("memq://"), PERIOD),
            "LcmPublisherSystem, which sends data out of the Diagram, from every copy of it, too: let a bridge send it",
        ),
        (
            lambda: LcmInterfaceSystem(pydrake.lcm.DrakeLcm("memq://")),
            "LcmInterfaceSystem, which receives data from outside",
        ),
        (
            lambda: ZeroOrderHold(PERIOD, Value([1, 2])),
            "ZeroOrderHold keeps abstract state 0 and declares no codec for it.*there is no codec for a list",
        ),
    ],
)
def test_what_cannot_be_copied_is_refused_when_the_testbed_is_built(make, message):
    with pytest.raises(ValueError, match=message):
        _testbed(make)


def test_systems_without_names_are_called_by_their_class_in_order():
    def build():
        parts = VirtualTestbedBuilder(Interface([], []))
        parts.set_dps(LeafSystem())
        parts.diagram_builder.AddNamedSystem("Integrator_2", Integrator(1))
        inner = DiagramBuilder()
        for size in (1, 2, 3):
            inner.AddSystem(Integrator(size))
            parts.diagram_builder.AddSystem(Integrator(size))
        inner.AddSystem(Source(1, lambda t: [t]))
        parts.diagram_builder.AddSystem(inner.Build())
        return parts.build()

    shapes = {a: v.shape for a, v in build().variables().items() if "Integrator" in a}
    assert shapes == {
        "Integrator_2.continuous_state": (1,),
        "Integrator.continuous_state": (1,),
        "Integrator_3.continuous_state": (2,),
        "Integrator_4.continuous_state": (3,),
        "Diagram.Integrator.continuous_state": (1,),
        "Diagram.Integrator_2.continuous_state": (2,),
        "Diagram.Integrator_3.continuous_state": (3,),
    }
    assert "Diagram.Source.y" in build().addresses()


def test_a_plants_friction_is_that_of_its_own_scene_graph():
    """A DPS may hold a model of the world with a SceneGraph of its own, and comes first."""

    def boxed(builder, size):
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        body = plant.AddRigidBody("box", SpatialInertia.SolidBoxWithMass(1.0, 1.0, 1.0, 1.0))
        plant.RegisterCollisionGeometry(
            body, RigidTransform(), Box(size, size, size), "box", CoulombFriction(size, size)
        )
        plant.Finalize()
        return plant, scene_graph

    parts = VirtualTestbedBuilder(Interface([], []))
    mental = DiagramBuilder()
    boxed(mental, 0.25)
    parts.set_dps(mental.Build())
    boxed(parts.diagram_builder, 0.75)
    testbed = parts.build()
    context = testbed.default_context()
    frictions = {a: testbed.read(context, a) for a in testbed.variables() if a.endswith(".friction")}
    assert frictions == {"dps.plant.box.friction": 0.25, "sim.sys.box.friction": 0.75}
    assert testbed.plant is not None
    testbed.write(context, {"sim.sys.box.friction": 0.5})
    assert testbed.read(context, "dps.plant.box.friction") == 0.25
    copied = testbed.default_context()
    testbed.restore(copied, testbed.snapshot(context))
    assert testbed.read(copied, "sim.sys.box.friction") == 0.5


def test_two_systems_of_one_name_are_refused_by_name():
    parts = VirtualTestbedBuilder(Interface([], []))
    parts.set_dps(LeafSystem())
    for _ in range(2):
        AddMultibodyPlantSceneGraph(parts.diagram_builder, 0.0)[0].Finalize()
    with pytest.raises(ValueError, match="two systems of the testbed are called plant: rename one of them"):
        parts.build()


def test_two_systems_of_one_path_are_refused_by_path():
    parts = VirtualTestbedBuilder(Interface([], []))
    parts.set_dps(LeafSystem())
    parts.diagram_builder.AddNamedSystem("a.b", Integrator(1))
    inner = DiagramBuilder()
    inner.AddNamedSystem("b", Integrator(1))
    parts.diagram_builder.AddNamedSystem("a", inner.Build())
    with pytest.raises(ValueError, match="two systems of the testbed have the path a.b"):
        parts.build()


def test_a_codec_can_be_given_to_a_system_of_drake():
    def make():
        hold = ZeroOrderHold(PERIOD, Value([0.0]))
        hold.codecs = {0: Codec(lambda v: {"": np.array(v)}, lambda a: a[""].tolist())}
        return hold

    testbed = _testbed(make, lambda t: [t, 2.0 * t])
    context = testbed.default_context()
    Simulator(testbed.diagram, context).AdvanceTo(0.35)
    copied = testbed.default_context()
    testbed.restore(copied, testbed.snapshot(context))
    assert testbed.read(copied, "ZeroOrderHold.y") == pytest.approx([0.3, 0.6])
