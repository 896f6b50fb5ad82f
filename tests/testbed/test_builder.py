"""Tests that parts which do not fit are refused by name when the testbed is built."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource, ConstantVectorSource, PassThrough
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageRgba8U

from tests.testbeds import PoseRelay
from vtbdrake.common.scan import Scan
from vtbdrake.components.environment import Light
from vtbdrake.components.ray_casting import RayCaster
from vtbdrake.components.sensors.camera import Camera
from vtbdrake.components.sensors.laser_scanner import LaserScanner
from vtbdrake.reasoning import Belief, BeliefToStart
from vtbdrake.state import AddressedSystem, Quantity, VariableError
from vtbdrake.testbed import Interface, Signal, VirtualTestbedBuilder
from vtbdrake.testbed.signal import SignalError
from vtbdrake_diagrams.space_climber import SpaceClimberScenario

SENSE = Signal("y", size=2)
ACT = Signal("u", size=2, idle=0.0)


def _relay(input_name="y", output_name="u", size=2):
    builder = DiagramBuilder()
    system = builder.AddNamedSystem("impl", PassThrough(size))
    builder.ExportInput(system.get_input_port(), input_name)
    builder.ExportOutput(system.get_output_port(), output_name)
    return builder.Build()


def _world(builder, sensor=None, actuator=None):
    sensor = sensor or ConstantVectorSource([1.0, 2.0])
    builder.sim_sensor("y", builder.add("sense", "y", sensor).get_output_port())
    builder.sim_actuator("u", builder.add("act", "u", actuator or PassThrough(2)).get_input_port())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Interface([SENSE, SENSE], [ACT]), "these occur twice: y"),
        (lambda: Interface([SENSE], [ACT], [Signal("y", size=1)]), "these occur twice: y"),
        (lambda: Interface([SENSE], [Signal("u", size=2)]), "u has no idle value"),
        (lambda: Interface([SENSE], [ACT], [Signal("mode", model_value="walk")]), "command mode is abstract"),
        (lambda: Signal("y"), "either a vector .give size=. or abstract"),
        (lambda: Signal("y", size=2, model_value=1), "either a vector"),
        (lambda: Signal("y", size=0), "at least one entry, not 0"),
        (lambda: Signal("a.b", size=1), "one word"),
        (lambda: Signal("a[0]", size=1), "one word"),
        (lambda: Signal(3, size=1), "one word .* not 3"),
        (lambda: Signal("y", size=1, unit=3), "its unit is a text, 'm/s', say, not 3"),
        (lambda: Signal("y", size=1, lower="0"), "its lower must be a number or several, not '0'"),
        (lambda: Signal("y", size=1, upper=None), "its upper must be a number or several, not None"),
        (lambda: Signal("y", size=1, idle=np.inf), "its idle must be finite, not inf"),
        (lambda: Interface(None, []), r"sense is a list of Signal\(...\), \[\] for none, not None"),
        (lambda: Signal("y", size=2, lower=[0.0, 0.0, 0.0]), r"2 entries, but its lower has shape \(3,\)"),
        (lambda: Signal("y", size=2, lower=1.0, upper=0.0), "lower limit 1.0 lies above"),
        (lambda: Signal("y", size=2, rate=0.0), "rate limit must be positive"),
        (lambda: Signal("y", size=2, idle=float("nan")), "its idle has a NaN"),
        (lambda: Signal("y", size=2, max_age=0.0), "max_age must be positive"),
        (lambda: Signal("y", size=2, max_age="1 s"), "max_age must be positive, in s, not '1 s'"),
        (
            lambda: Signal("y", size=2, lower=0.0, idle=[1.0, -0.5]),
            r"its idle \[1.0, -0.5\] lies outside its limits, 0.0",
        ),
        (lambda: Signal("y", size=2, upper=[1.0, 2.0], default=1.5), "its default 1.5 lies outside its limits"),
        (lambda: Signal("y", size=2, lower="low"), "its lower must be a number or several, not 'low'"),
        (lambda: Signal("y", size=2.5), "at least one entry, not 2.5"),
        (lambda: Signal("y", size="2"), "at least one entry, not '2'"),
        (lambda: Signal("y", model_value=RigidTransform(), lower=0.0), "y is abstract: only a vector has a lower"),
        (lambda: Signal("y", model_value=RigidTransform(), rate=[1.0]), "y is abstract: only a vector has a rate"),
        (lambda: Signal("y", model_value=RigidTransform(), idle=0.0), "y carries a RigidTransform, not a float"),
        (
            lambda: Signal("y", model_value=ImageRgba8U(4, 3), idle=ImageRgba8U(3, 4)),
            "images of 4 x 3 pixels, not one of",
        ),
        (lambda: Interface(["y"], []), r"an interface's sense is a list of Signal\(...\), but has 'y'"),
    ],
)
def test_an_interface_that_makes_no_sense_is_refused(make, message):
    with pytest.raises(SignalError, match=message):
        make()


@pytest.mark.parametrize(
    ("dps", "message"),
    [
        (lambda: _relay(input_name="x"), "the DPS has no input port y; it has: x"),
        (lambda: _relay(output_name="x"), "the DPS has no output port u; it has: x"),
        (lambda: _relay(size=3), "signal y has 2 entries, but the port y of the DPS has 3"),
        (PoseRelay, "the DPS has no input port y; it has: seen"),
    ],
)
def test_a_dps_that_does_not_fit_is_refused(dps, message):
    builder = VirtualTestbedBuilder(Interface([SENSE], [ACT]))
    with pytest.raises(SignalError, match=message):
        builder.set_dps(dps())


def test_all_inputs_are_named_where_one_is_missing():
    builder = VirtualTestbedBuilder(Interface([Signal("seen", model_value=RigidTransform()), SENSE], []))
    with pytest.raises(SignalError, match="no input port y; it has: seen"):
        builder.set_dps(PoseRelay())


def test_an_input_of_the_dps_that_is_no_signal_is_refused():
    builder = VirtualTestbedBuilder(Interface([Signal("seen", model_value=RigidTransform())], []))
    builder.set_dps(PoseRelay())
    other = VirtualTestbedBuilder(Interface([], []))
    with pytest.raises(SignalError, match="no signal for the DPS's input port seen"):
        other.set_dps(PoseRelay())


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"sensor": ConstantVectorSource([1.0])}, "signal y has 2 entries, but the port y0 of sim.sense.y has 1"),
        ({"sensor": ConstantValueSource(Value("a"))}, "signal y is vector, but the port y0 of sim.sense.y is abstract"),
        ({"sensor": PassThrough(Value(ImageRgba8U(4, 3)))}, "y is vector, but"),
        ({"actuator": PassThrough(4)}, "signal u has 2 entries, but the port u of sim.act.u has 4"),
    ],
)
def test_a_world_that_does_not_fit_is_refused(parts, message):
    builder = VirtualTestbedBuilder(Interface([SENSE], [ACT]))
    with pytest.raises(SignalError, match=message):
        _world(builder, **parts)


def test_an_abstract_signal_of_another_type_is_refused():
    builder = VirtualTestbedBuilder(Interface([Signal("seen", model_value=RigidTransform())], []))
    source = builder.add("sense", "seen", ConstantValueSource(Value("a pose")))
    with pytest.raises(
        SignalError, match="seen carries a RigidTransform, but the port y0 of sim.sense.seen carries a str"
    ):
        builder.sim_sensor("seen", source.get_output_port())


def test_an_image_of_another_size_is_refused():
    for model in (ImageRgba8U(640, 480), ImageRgba8U()):
        builder = VirtualTestbedBuilder(Interface([Signal("seen", model_value=model)], []))
        source = builder.add("sense", "seen", ConstantValueSource(Value(ImageRgba8U(320, 240))))
        if model.width():
            with pytest.raises(SignalError, match="images of 640 x 480 pixels, but the port y0 .* of 320 x 240 pixels"):
                builder.sim_sensor("seen", source.get_output_port())
        else:
            builder.sim_sensor("seen", source.get_output_port())


@pytest.mark.parametrize("nothing", [None, DiagramBuilder(), "a DPS"])
def test_what_is_no_system_is_refused(nothing):
    builder = VirtualTestbedBuilder(Interface([SENSE], [ACT]))
    with pytest.raises(SignalError, match="the DPS is a System, not .*: does make_dps return it, built?"):
        builder.set_dps(nothing)
    with pytest.raises(ValueError, match="sim.sys.part is a System, not "):
        builder.add("sys", "part", nothing)
    with pytest.raises(SignalError, match="the sensor signal y takes an OutputPort of a system, not "):
        builder.sim_sensor("y", nothing)
    with pytest.raises(SignalError, match="the actuator signal u takes an InputPort of a system, not "):
        builder.sim_actuator("u", PassThrough(2).get_output_port())
    with pytest.raises(SignalError, match="has an Interface.sense, act, commands., not None"):
        VirtualTestbedBuilder(None)


def test_a_second_plant_is_refused():
    builder = VirtualTestbedBuilder(Interface([], []))
    builder.add_plant()
    with pytest.raises(ValueError, match="has a plant already"):
        builder.add_plant()


def test_what_is_missing_is_named():
    builder = VirtualTestbedBuilder(Interface([SENSE], [ACT]))
    with pytest.raises(SignalError, match="no DPS"):
        builder.build()
    builder.set_dps(_relay())
    with pytest.raises(SignalError, match="no simulated sensor offers y"):
        builder.build()
    builder.sim_sensor("y", builder.add("sense", "y", ConstantVectorSource([1.0, 2.0])).get_output_port())
    with pytest.raises(SignalError, match="no simulated actuator takes u"):
        builder.build()
    with pytest.raises(SignalError, match="two ports are given for the sensor signal y"):
        builder.sim_sensor("y", builder.add("sense", "y2", ConstantVectorSource([1.0, 2.0])).get_output_port())
    with pytest.raises(SignalError, match="no actuator signal 'v'; it has: u"):
        builder.sim_actuator("v", builder.add("act", "v", PassThrough(2)).get_input_port())
    with pytest.raises(SignalError, match="has a DPS already"):
        builder.set_dps(_relay())
    with pytest.raises(ValueError, match="one of sense, sys, act, env, not 'world'"):
        builder.add("world", "w", PassThrough(2))


def test_a_command_is_a_variable_with_the_signals_limits():
    builder = VirtualTestbedBuilder(
        Interface([], [ACT], [Signal("y", size=2, unit="m", lower=-1.0, upper=1.0, default=[0.1, 0.2])])
    )
    builder.set_dps(_relay())
    builder.sim_actuator("u", builder.add("act", "u", PassThrough(2)).get_input_port())
    testbed = builder.build()
    context = testbed.default_context()
    assert testbed.read(context, "dps.u").tolist() == [0.1, 0.2]
    testbed.write(context, {"u.y": [0.5, -0.5]})
    assert testbed.read(context, "dps.u").tolist() == [0.5, -0.5]
    with pytest.raises(VariableError, match=r"must lie in \[-1, 1\] m"):
        testbed.write(context, {"u.y": [0.5, -1.5]})


def test_a_command_can_come_from_a_system():
    builder = VirtualTestbedBuilder(Interface([], [ACT], [Signal("y", size=2)]))
    builder.set_dps(_relay())
    builder.sim_actuator("u", builder.add("act", "u", PassThrough(2)).get_input_port())
    builder.command(
        "y", builder.diagram_builder.AddNamedSystem("plan", ConstantVectorSource([3.0, 4.0])).get_output_port()
    )
    testbed = builder.build()
    assert testbed.read(testbed.default_context(), "dps.u").tolist() == [3.0, 4.0]
    assert "u.y" not in testbed.variables()


class Estimator(AddressedSystem):
    """A DPS that believes something."""

    def __init__(self):
        super().__init__()
        self.DeclareVectorInputPort("y", 2)
        self.DeclareStateOutputPort("u", self.declare_discrete_state(estimate=Quantity([0.4, 0.6])).index)


def _believing(target="sim.sense.y.value", of=("dps.estimate",), by=None, **options):
    builder = VirtualTestbedBuilder(Interface([SENSE], [ACT]))
    builder.set_dps(Estimator())
    _world(builder)
    builder.believe(target, of=of, by=by, **options)
    return builder


def test_belief_sets_the_simulated_world():
    testbed = _believing(by=lambda estimate: 10.0 * estimate).build()
    context = testbed.default_context()
    testbed.start_from_belief(context)
    assert testbed.read(context, "sim.sense.y.value").tolist() == [4.0, 6.0]


@pytest.mark.parametrize("by", [None, lambda estimate: (estimate.item(0), estimate.item(1))])
def test_a_rule_sets_several_variables(by):
    targets = ["sim.sense.y.value[1]", "sim.sense.y.value[0]"]
    testbed = _believing(targets, by=by).build()
    context = testbed.default_context()
    testbed.start_from_belief(context)
    assert testbed.read(context, "sim.sense.y.value").tolist() == [0.6, 0.4]
    start = BeliefToStart(testbed).start(Belief.of(testbed, context))
    assert [start.values[address] for address in targets] == [0.4, 0.6]


def test_a_rule_has_a_value_for_each_of_its_targets():
    with pytest.raises(ValueError, match="at least one variable"):
        _believing([])
    testbed = _believing([f"sim.sense.y.value[{k}]" for k in range(2)], by=lambda estimate: estimate[:1]).build()
    with pytest.raises(ValueError, match="has 1 values for 2 targets"):
        testbed.start_from_belief(testbed.default_context())


def test_a_rule_with_a_period_is_told_how_late_its_estimates_are():
    testbed = _believing(by=lambda estimate, *, late: late * np.ones(2), age=0.5, period=0.2).build()
    context = testbed.default_context()
    # What is sampled at an instant itself comes later; events come some nanoseconds early.
    for time, late in ((0.0, 0.7), (0.3, 0.6), (0.4, 0.7), (3 * 0.2, 0.7), (0.4 - 1e-8, 0.7 - 1e-8), (0.4001, 0.5001)):
        context.SetTime(time)
        testbed.start_from_belief(context)
        assert testbed.read(context, "sim.sense.y.value") == pytest.approx(late, abs=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"period": -0.1}, "at least 0 s, not -0.1"),
        ({"period": np.inf}, "at least 0 s, not inf"),
        ({"period": 0.1}, "no function that uses it"),
        ({"age": np.nan}, "at least 0 s, not nan"),
        ({"age": "1 s"}, "must be a number, not '1 s'"),
        ({"period": "1 s", "by": abs}, "must be a number, not '1 s'"),
        ({"by": 3}, "is a function of estimates, not 3"),
    ],
)
def test_a_belief_of_impossible_times_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        _believing(**options)


def test_a_belief_goes_from_dps_to_sim():
    with pytest.raises(ValueError, match="not dps.estimate"):
        _believing(target="dps.estimate").build()
    with pytest.raises(ValueError, match="which the DPS does not hold"):
        _believing(of=("sim.sense.y.value",)).build()
    with pytest.raises(ValueError, match="did you mean dps.estimate"):
        _believing(of=("dps.estimates",)).build()
    with pytest.raises(ValueError, match="give the function of them as by="):
        _believing(of=("dps.estimate", "dps.estimate"))
    builder = VirtualTestbedBuilder(Interface([SENSE], [ACT]))
    builder.set_dps(_relay())
    _world(builder)
    testbed = builder.build()
    with pytest.raises(ValueError, match="does not declare"):
        testbed.start_from_belief(testbed.default_context())


def test_a_sensor_is_added_and_connected_to_the_plant():
    testbed = SpaceClimberScenario().build()
    context = testbed.default_context()
    testbed.simulator(context).AdvanceTo(0.1)
    plant = testbed.plant
    joints = plant.GetPositions(plant.GetMyContextFromRoot(context))[7:]
    np.testing.assert_allclose(testbed.read(context, "sim.sense.encoders.joint_encoders"), joints, atol=0.05)


@pytest.fixture
def world():
    """A builder with a plant, a camera with a depth image, a light, and a laser scanner."""
    images = [Signal("image", model_value=ImageRgba8U(8, 6)), Signal("depth", model_value=ImageDepth32F(8, 6))]
    builder = VirtualTestbedBuilder(Interface([*images, Signal("scan", model_value=Scan.empty())], []))
    plant, scene_graph = builder.add_plant()
    plant.Finalize()
    camera = Camera(plant, plant.world_frame(), period=0.1, info=CameraInfo(8, 6, 0.8), depth=True)
    scanner = LaserScanner(plant, plant.world_frame(), RayCaster(plant, scene_graph))
    return builder, camera, builder.add("env", "sun", Light()), scanner


def test_cameras_and_scanners_are_sensors(world):
    builder, camera, sun, scanner = world
    builder.add_sensor("image", camera, name="eye", output="color_image", inputs={"light": sun.GetOutputPort("light")})
    builder.sim_sensor("depth", camera.GetOutputPort("depth_image"))
    builder.add_sensor("scan", scanner)
    connected = {
        (
            source.get_name(),
            source.get_output_port(output).get_name(),
            target.get_name(),
            target.get_input_port(n).get_name(),
        )
        for (target, n), (source, output) in builder.build_diagram("world").connection_map().items()
    }
    assert connected >= {
        ("scene_graph", "query", "sim.sense.eye", "geometry_query"),
        ("sim.env.sun", "light", "sim.sense.eye", "light"),
        ("plant", "body_poses", "sim.sense.scan", "body_poses"),
        ("plant", "body_spatial_velocities", "sim.sense.scan", "body_spatial_velocities"),
    }
    assert builder.sensors["image"].get_name() == "color_image"


def test_a_sensor_whose_ports_are_not_clear_is_rejected(world):
    builder, camera, sun, _ = world
    with pytest.raises(ValueError, match="output= of Camera, for image, is one of color_image, depth_image$"):
        builder.add_sensor("image", camera)
    with pytest.raises(ValueError, match="neither plant nor SceneGraph has an output u, which PassThrough needs: give"):
        builder.add_sensor("depth", PassThrough(2))
    wrong = {"u": sun.GetOutputPort("light"), "lamp": sun.GetOutputPort("light")}
    with pytest.raises(ValueError, match="PassThrough has no input 'lamp'; it has: u"):
        builder.add_sensor("depth", PassThrough(sun.GetOutputPort("light").size()), name="other", inputs=wrong)


def test_a_sensor_without_a_plant_is_rejected():
    builder = VirtualTestbedBuilder(Interface(sense=[Signal("y", size=2)], act=[]))
    with pytest.raises(ValueError, match="call add_plant first"):
        builder.add_sensor("y", PassThrough(2))


def test_model_that_is_anchored_in_part_only_is_of_the_robot():
    arm = """<robot name="arm"><link name="link"><inertial><mass value="1"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="pin" type="continuous"><parent link="world"/><child link="link"/></joint></robot>"""
    parts = """<robot name="{}"><link name="a"/><link name="b"/></robot>"""
    interface = Interface([SENSE], [ACT])
    builder = VirtualTestbedBuilder(interface)
    plant, _ = builder.add_plant(MultibodyPlantConfig())
    (arm_model,) = Parser(plant).AddModelsFromString(arm, "urdf")
    for name in ("tools", "posts"):
        (model,) = Parser(plant).AddModelsFromString(parts.format(name), "urdf")
        # One tool is at the arm, and the other one lies on the ground.
        carrier = plant.GetFrameByName("link", arm_model) if name == "tools" else plant.world_frame()
        plant.WeldFrames(carrier, plant.GetFrameByName("a", model))
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("b", model))
    plant.Finalize()
    roles = builder.plant_roles()
    assert [roles[name] for name in ("arm", "tools", "posts")] == ["sys", "sys", "env"]
