"""Compiled plants with several model instances, a floating base, and forces."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    SpatialInertia,
    WeldJoint,
)
from pydrake.symbolic import Variable, exp, sin
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import (
    ConstantValueSource,
    ConstantVectorSource,
    MatrixGain,
    Sine,
    SymbolicVectorSystem,
    ZeroOrderHold,
)

from vtbdrake.compiled import EQUATIONS, At, CompiledRollouts, Equations, UnsupportedTestbedError
from vtbdrake.compiled.agreement import compare
from vtbdrake.state.declarations import DISCRETE
from vtbdrake.state.systems import collect

BOX = SpatialInertia.SolidBoxWithMass(1.5, 0.2, 0.3, 0.4)


def rollouts_of(
    diagram: Diagram, outputs: tuple[str, ...] = (), parameters: tuple[str, ...] = (), **values: float
) -> CompiledRollouts:
    context = diagram.CreateDefaultContext()
    for name, value in values.items():
        plant = diagram.GetSubsystemByName("plant")
        plant.GetJointByName(name).set_translation(plant.GetMyContextFromRoot(context), value)
    return CompiledRollouts(
        diagram,
        collect(diagram),
        context,
        horizon=0.3,
        sample_period=0.05,
        outputs=outputs,
        parameters=parameters,
        compile=False,
    )


def two_carts(
    plant: MultibodyPlant,
    *,
    stop: float = np.inf,
    effort_limit: float = np.inf,
    gains: PdControllerGains | None = None,
) -> None:
    for name, axis in (("left", [1, 0, 0]), ("right", [0, 1, 0])):
        instance = plant.AddModelInstance(name)
        body = plant.AddRigidBody("cart", instance, BOX)
        joint = PrismaticJoint(f"{name}_slider", plant.world_frame(), body.body_frame(), axis, -stop, stop)
        motor = plant.AddJointActuator(f"{name}_motor", plant.AddJoint(joint), effort_limit)
        if gains is not None:
            motor.set_controller_gains(gains)
    plant.Finalize()


@pytest.mark.parametrize("sampled", [False, True])
def test_ports_of_model_instances(sampled: bool) -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    plant.SetUseSampledOutputPorts(sampled)
    two_carts(plant)
    builder.AddNamedSystem("plant", plant)
    left, right = (plant.GetModelInstanceByName(name) for name in ("left", "right"))
    gain = builder.AddNamedSystem("gain", MatrixGain(np.array([[-30.0, -2.0]])))
    hold = builder.AddNamedSystem("hold", ZeroOrderHold(0.02, 1))
    sine = builder.AddNamedSystem("sine", Sine(3.0, 7.0, 0.1, 1))
    builder.Connect(plant.get_state_output_port(right), gain.get_input_port())
    builder.Connect(gain.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_actuation_input_port(left))
    builder.Connect(sine.get_output_port(0), plant.get_actuation_input_port(right))
    rollouts = rollouts_of(builder.Build(), ("plant.right_state", "hold.y"), left_slider=0.1, right_slider=-0.2)
    assert compare(rollouts, rollouts.walker.context) <= Equations.agreement
    moved = rollouts().outputs
    assert np.ptp(moved["plant.right_state"]) > 0.1
    assert np.ptp(moved["hold.y"]) > 0.1


def test_an_actuator_without_input_rests_and_generalized_forces_act() -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    two_carts(plant)
    builder.AddNamedSystem("plant", plant)
    source = builder.AddNamedSystem("force", ConstantVectorSource([1.0, -2.0]))
    builder.Connect(source.get_output_port(), plant.get_applied_generalized_force_input_port())
    rollouts = rollouts_of(builder.Build(), ("plant.state",))
    assert compare(rollouts, rollouts.walker.context) <= Equations.agreement
    end = rollouts().outputs["plant.state"][0, -1]
    np.testing.assert_allclose(end[2:], 0.3 * np.array([1.0, -2.0]) / 1.5, rtol=1e-12)


def test_actuation_ports_add_up() -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    two_carts(plant)
    builder.AddNamedSystem("plant", plant)
    whole = builder.AddNamedSystem("whole", ConstantVectorSource([1.0, -2.0]))
    part = builder.AddNamedSystem("part", ConstantVectorSource([3.0]))
    builder.Connect(whole.get_output_port(), plant.get_actuation_input_port())
    left = plant.GetModelInstanceByName("left")
    builder.Connect(part.get_output_port(), plant.get_actuation_input_port(left))
    rollouts = rollouts_of(builder.Build(), ("plant.state", "whole.y0"))
    assert compare(rollouts, rollouts.walker.context) <= Equations.agreement
    end = rollouts().outputs
    np.testing.assert_allclose(end["plant.state"][0, -1, 2:], 0.3 * np.array([4.0, -2.0]) / 1.5, rtol=1e-12)
    np.testing.assert_array_equal(end["whole.y0"][0, -1], [1.0, -2.0])


def test_a_floating_base_tumbles() -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    base = plant.AddRigidBody("base", BOX)
    arm = plant.AddRigidBody("arm", BOX)
    plant.AddJointActuator(
        "motor", plant.AddJoint(RevoluteJoint("hinge", base.body_frame(), arm.body_frame(), [0, 0, 1], 0.1))
    )
    plant.Finalize()
    builder.AddNamedSystem("plant", plant)
    torque = builder.AddNamedSystem("torque", Sine(1.0, 5.0, 0.0, 1))
    builder.Connect(torque.get_output_port(0), plant.get_actuation_input_port())
    rollouts = rollouts_of(builder.Build(), ("plant.state",))
    assert compare(rollouts, rollouts.walker.context) <= Equations.agreement
    assert np.ptp(rollouts().outputs["plant.state"][0], axis=0)[7] > 1e-3


def test_poses_of_bodies_are_recorded() -> None:
    """A floating base turns through all angles, and so does a link with a tilted joint."""
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    base, arm = (plant.AddRigidBody(name, BOX) for name in ("base", "arm"))
    tilted = RigidTransform(RollPitchYaw(0.3, -0.5, 1.0), [0.1, 0.2, -0.3])
    plant.AddJoint(RevoluteJoint("hinge", base.body_frame(), plant.AddFrame(
        FixedOffsetFrame("pivot", arm.body_frame(), tilted)), [0, 0, 1], 0.1))  # fmt: skip
    plant.Finalize()
    builder.AddNamedSystem("plant", plant)
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    spin = SpatialVelocity([3.0, -4.0, 9.0], [0.1, 0.2, 3.0])
    plant.SetFreeBodySpatialVelocity(plant.GetMyMutableContextFromRoot(context), base, spin)
    variables = collect(diagram)
    entries = [f"plant.{body}.{e}" for body in ("base", "arm") for e in ("x", "y", "height", "roll", "pitch", "yaw")]
    rollouts = CompiledRollouts(
        diagram, variables, context, horizon=1.0, sample_period=0.05, outputs=["plant.state", *entries], compile=False
    )
    recorded = rollouts().outputs
    for k, state in enumerate(recorded["plant.state"][0]):
        plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(context), state)
        expected = [variables[entry].get(context) for entry in entries]
        np.testing.assert_allclose([recorded[entry][0, k] for entry in entries], expected, rtol=0, atol=1e-12)
    assert np.ptp(recorded["plant.base.yaw"]) > 5.0 and np.ptp(recorded["plant.arm.pitch"]) > 1.0


def carts_with_stops() -> Diagram:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    two_carts(plant, stop=0.05)
    builder.AddNamedSystem("plant", plant)
    source = builder.AddNamedSystem("force", ConstantVectorSource([5.0, 0.0]))
    builder.Connect(source.get_output_port(), plant.get_actuation_input_port())
    return builder.Build()


def test_a_rollout_that_reaches_a_stop_is_drakes() -> None:
    diagram = carts_with_stops()
    rollouts = rollouts_of(diagram)
    batch = rollouts({"force.value": [[0.1, 0.0], [5.0, 0.0]]})
    assert batch.valid.all() and batch.reasons == ("", "")
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.3)
    expected = rollouts.walker.read(simulator.get_context())
    state = rollouts.walker.vector.blocks["plant", DISCRETE, 0].entries
    np.testing.assert_allclose(batch.final[1][state], expected[state], atol=1e-9)
    np.testing.assert_allclose(expected[state][0], 0.05, atol=1e-4)  # It rests on its stop.


def test_without_a_compiler_a_rollout_that_reaches_a_stop_is_not_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "no-such-compiler")
    batch = rollouts_of(carts_with_stops())({"force.value": [[0.1, 0.0], [5.0, 0.0]]})
    assert batch.valid.tolist() == [True, False]
    # 0.05 m are reached after 0.173 s at 3.33 m/s^2; a stop is felt two steps ahead.
    assert batch.reasons == (
        "",
        "plant: a joint reaches a stop, which is compiled only where there is a C compiler at t = 0.15 s",
    )


def servos(*desired: str) -> Diagram:
    """Return two carts with PD controllers and effort limits; those that are named have a desired state."""
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    plant.SetUseSampledOutputPorts(False)
    two_carts(plant, stop=0.22, effort_limit=20.0, gains=PdControllerGains(p=200.0, d=3.0))
    builder.AddNamedSystem("plant", plant)
    feed_forward = builder.AddNamedSystem("feed_forward", ConstantVectorSource([1.0, 2.0]))
    builder.Connect(feed_forward.get_output_port(), plant.get_actuation_input_port())
    target = builder.AddNamedSystem("target", ConstantVectorSource([0.25, 0.1]))
    for name in desired:
        builder.Connect(target.get_output_port(), plant.GetInputPort(f"{name}_desired_state"))
    return builder.Build()


@pytest.mark.parametrize("desired", [(), ("left",), ("left", "right")])
def test_controllers_of_actuators(desired: tuple[str, ...]) -> None:
    """They are saturated at first, and run into a stop; those without a desired state are limp."""
    # Drake aborts if the net actuation is asked for where some controllers have a desired state and others have none.
    ports = ("plant.net_actuation", "plant.right_net_actuation") if len(desired) != 1 else ()
    rollouts = rollouts_of(servos(*desired), ("plant.state", *ports), left_slider=-0.2)
    compare(rollouts, rollouts.walker.context)
    moved = rollouts().outputs
    if ports:
        np.testing.assert_array_equal(moved["plant.net_actuation"][..., 1:], moved["plant.right_net_actuation"])
        assert moved["plant.net_actuation"][0, 0, 0] == (20.0 if desired else 1.0)
    assert [bool(np.ptp(moved["plant.state"][0, :, k])) for k in range(2)] == [
        name in desired for name in ("left", "right")
    ]
    assert (np.max(moved["plant.state"][0, :, 0]) > 0.219) == bool(desired)


def test_derivatives_through_stops_and_controllers() -> None:
    ports = ("plant.state", "plant.net_actuation")
    rollouts = rollouts_of(servos("left", "right"), ports, left_slider=0.1)

    def end(target: Any) -> Any:
        values = rollouts.expressions({"target.value": target})
        return casadi.vertcat(*(values[port][:, -1] for port in ports))

    target = casadi.MX.sym("target", 2)
    jacobian = casadi.Function("jacobian", [target], [casadi.jacobian(end(target), target)])
    for at in ([0.26, 0.0], [0.2, 0.1], [0.3, 0.05]):
        steps = [rollouts({"target.value": [np.add(at, h), np.subtract(at, h)]}) for h in 1e-6 * np.eye(2)]
        ends = [np.hstack([batch.outputs[port][:, -1] for port in ports]) for batch in steps]
        differences = [np.subtract(*pair) / 2e-6 for pair in ends]
        np.testing.assert_allclose(jacobian(at).full(), np.transpose(differences), atol=1e-5)


class Weigh(LeafSystem):
    """The force that a joint exerts on its child along z (N)."""

    def __init__(self, place: int) -> None:
        super().__init__()
        self.place = place
        forces = Value[list[SpatialForce]]()
        self.DeclareAbstractInputPort("reaction_forces", forces)
        self.DeclareVectorOutputPort("force", 1, self._weigh)

    def _weigh(self, context: Context, output) -> None:
        forces = self.get_input_port().Eval(context)
        output[0] = forces[self.place].translational()[2]


class WeighEquations(Equations):
    def output(self, port: str, at: At):
        return at.input("reaction_forces")(self.system.place)[5]


def weighed(plant: MultibodyPlant, joint: str) -> tuple[DiagramBuilder, MultibodyPlant]:
    """Return the builder of a plant without sampled ports, and of a `Weigh` of a joint."""
    plant.Finalize()
    builder = DiagramBuilder()
    builder.AddNamedSystem("plant", plant)
    places = [plant.get_joint(index).name() for index in plant.GetJointIndices()]
    weigh = builder.AddNamedSystem("weigh", Weigh(places.index(joint)))
    builder.Connect(plant.get_reaction_forces_output_port(), weigh.get_input_port())
    return builder, plant


@pytest.fixture
def weigh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EQUATIONS, Weigh, WeighEquations)


@pytest.mark.parametrize("hanging", ["slide", "weld"])
@pytest.mark.usefixtures("weigh")
def test_reaction_of_a_joint_whose_parent_hangs_on_its_child(hanging: str) -> None:
    """The slider is blocked by nothing, and falls; the joint of the other kind carries the box below it."""
    plant = MultibodyPlant(0.01)
    plant.SetUseSampledOutputPorts(False)
    carrier, box = plant.AddRigidBody("carrier", BOX), plant.AddRigidBody("box", BOX)
    plant.AddJoint(PrismaticJoint("along", plant.world_frame(), carrier.body_frame(), [1, 0, 0]))
    frames = box.body_frame(), carrier.body_frame()
    # Held by nothing along y, so that it carries all the weight.
    plant.AddJoint(
        WeldJoint("hung", *frames, RigidTransform([0.0, 0.0, 0.3]))
        if hanging == "weld"
        else PrismaticJoint("hung", *frames, [0, 1, 0])
    )
    builder, plant = weighed(plant, "hung")
    rollouts = rollouts_of(builder.Build(), ("weigh.force",))
    assert compare(rollouts, rollouts.walker.context) <= Equations.agreement
    # The child is the carrier, which the box pulls down.
    np.testing.assert_allclose(rollouts().outputs["weigh.force"][0], -1.5 * 9.81, rtol=1e-12)


@pytest.mark.parametrize("compiler", [None, "no-such-compiler"])
@pytest.mark.usefixtures("weigh")
def test_a_stop_that_is_felt_in_the_last_step_counts(monkeypatch: pytest.MonkeyPatch, compiler: str | None) -> None:
    """With a C compiler its force is recorded, without one the rollout is not valid."""
    if compiler is not None:
        monkeypatch.setenv("CC", compiler)
    plant = MultibodyPlant(0.01)
    plant.SetUseSampledOutputPorts(False)
    body = plant.AddRigidBody("box", BOX)
    plant.AddJoint(PrismaticJoint("down", plant.world_frame(), body.body_frame(), [0, 0, 1], -1.0, 1.0))
    builder, plant = weighed(plant, "down")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    joint, own = plant.GetJointByName("down"), plant.GetMyMutableContextFromRoot(context)

    def falls(height: float) -> bool:
        """Return whether a box that begins above its stop has a valid rollout of two steps."""
        joint.set_translation(own, -1.0 + height)
        rollouts = CompiledRollouts(
            diagram,
            collect(diagram),
            context,
            horizon=0.02,
            sample_period=0.01,
            outputs=["weigh.force"],
            compile=False,
        )
        simulator = Simulator(diagram, context.Clone())
        simulator.AdvanceTo(0.02)
        port = diagram.GetSubsystemByName("weigh").get_output_port()
        feels = port.Eval(diagram.GetSubsystemByName("weigh").GetMyContextFromRoot(simulator.get_context()))[0]
        batch = rollouts()
        assert (abs(feels - batch.outputs["weigh.force"][0, -1, 0]) < 1e-9) == batch.valid[0]
        assert (abs(feels) > 1e-9) == (height < 9.0 * 9.81e-4)
        return bool(batch.valid[0])

    # Two steps fall by 3 g T^2, and a stop is felt 2 T ahead: in the third step, 3 g T^2 + 2 * 3 g T^2 below the begin.
    assert falls(9.1 * 9.81e-4)
    assert falls(8.9 * 9.81e-4) == (compiler is None)


def test_a_state_that_is_infinite_for_a_while_makes_the_rollout_invalid() -> None:
    time, x, scale = Variable("time"), Variable("x"), Variable("scale")
    peak = SymbolicVectorSystem(
        time=time, state=[x], parameter=[scale], dynamics=[exp(scale * sin(40.0 * time))], output=[x], time_period=0.02
    )
    builder = DiagramBuilder()
    builder.AddNamedSystem("peak", peak)
    batch = rollouts_of(builder.Build(), ("peak.y0",))({"peak.parameter_0": [[1.0], [800.0]]})
    assert np.isfinite(batch.outputs["peak.y0"][:, -1]).all()
    assert batch.valid.tolist() == [True, False]


# CasADi's names of arguments have no room for these letters.
@pytest.mark.parametrize("names", [("left", "right"), ("左", "右")])
def test_two_copies_of_a_robot(names: tuple[str, str]) -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    for name in names:
        instance = plant.AddModelInstance(name)
        link = plant.AddRigidBody("link", instance, BOX)
        plant.AddJointActuator(
            "motor", plant.AddJoint(RevoluteJoint("hinge", plant.world_frame(), link.body_frame(), [0, 0, 1]))
        )
    plant.Finalize()
    builder.AddNamedSystem("plant", plant)
    torque = builder.AddNamedSystem("torque", ConstantVectorSource([1.0, -2.0]))
    builder.Connect(torque.get_output_port(), plant.get_actuation_input_port())
    masses = tuple(f"plant.{name}.link.mass" for name in names)
    rollouts = rollouts_of(builder.Build(), ("plant.state",), masses)
    assert compare(rollouts, rollouts.walker.context) <= Equations.agreement
    turned = [rollouts({masses[0]: m, masses[1]: 1.5}).outputs["plant.state"][0, -1] for m in (1.5, 3.0)]
    np.testing.assert_allclose(turned[0] / turned[1], [2.0, 1.0, 2.0, 1.0])


def test_a_plant_without_positions() -> None:
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    plant.WeldFrames(plant.world_frame(), plant.AddRigidBody("table", BOX).body_frame())
    plant.Finalize()
    builder.AddNamedSystem("plant", plant)
    batch = rollouts_of(builder.Build(), ("plant.state",))()
    assert batch.outputs["plant.state"].shape == (1, 7, 0)
    assert batch.valid.all()


def pushed_cart() -> tuple[DiagramBuilder, MultibodyPlant, Value]:
    """Return the builder of two carts, and a force on the left one."""
    builder = DiagramBuilder()
    plant = MultibodyPlant(0.01)
    two_carts(plant)
    builder.AddNamedSystem("plant", plant)
    force = ExternallyAppliedSpatialForce()
    force.body_index = plant.GetBodyByName("cart", plant.GetModelInstanceByName("left")).index()
    force.F_Bq_W = SpatialForce(tau=np.zeros(3), f=[3.0, 0.0, 0.0])
    return builder, plant, Value([force])


def test_a_constant_force_acts_on_a_body() -> None:
    builder, plant, value = pushed_cart()
    source = builder.AddNamedSystem("push", ConstantValueSource(value))
    builder.Connect(source.get_output_port(), plant.get_applied_spatial_force_input_port())
    rollouts = rollouts_of(builder.Build(), ("plant.state",))
    assert compare(rollouts, rollouts.walker.context) <= Equations.agreement
    np.testing.assert_allclose(rollouts().outputs["plant.state"][0, -1, 2:], [0.3 * 3.0 / 1.5, 0.0], rtol=1e-12)


def test_a_force_that_is_fixed_at_a_port_is_refused() -> None:
    builder, plant, value = pushed_cart()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.get_applied_spatial_force_input_port().FixValue(plant.GetMyContextFromRoot(context), value)
    with pytest.raises(UnsupportedTestbedError, match="plant: a value is fixed at the abstract input port applied_sp"):
        CompiledRollouts(diagram, collect(diagram), context, horizon=0.1, sample_period=0.1, compile=False, check=False)


def test_a_port_that_is_not_compiled_is_named() -> None:
    builder, _, _ = pushed_cart()
    with pytest.raises(UnsupportedTestbedError, match="^plant: MultibodyPlant has the output port net_actuation"):
        rollouts_of(builder.Build(), ("plant.net_actuation",))
