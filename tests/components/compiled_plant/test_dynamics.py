"""The equations of motion in CasADi are Drake's."""

from __future__ import annotations

import casadi
import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    JacobianWrtVariable,
    MultibodyForces,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)

from tests.components.compiled_plant.plants import (
    arm,
    cart_pole,
    climber,
    floating,
    inertia,
    simulate,
    states,
)
from vtbdrake.components.compiled_plant import PlantDynamics, plant_dynamics, plant_step
from vtbdrake.state.systems import pose_from_array


def relative(value, expected) -> float:
    return float(np.max(np.abs(np.ravel(value) - expected)) / np.max(np.abs(expected)))


def test_quaternion_needs_no_norm():
    plant = floating(0.0)
    context = plant.CreateDefaultContext()
    x, u = next(states(plant))
    x[:4] = [0.5, -1.0, 2.0, 0.3]
    plant.SetPositionsAndVelocities(context, x)
    plant.get_actuation_input_port().FixValue(context, u)
    expected = plant.EvalTimeDerivatives(context).CopyToVector()
    assert relative(plant_dynamics(plant, context)(x, u).full(), expected) < 1e-12


@pytest.mark.parametrize("make", [arm, floating])
def test_inverse_dynamics_invert_the_accelerations(make):
    plant = make(0.0)
    context = plant.CreateDefaultContext()
    model = PlantDynamics(plant, context)
    q, v, _ = model.symbols()
    vdot = casadi.SX.sym("vdot", plant.num_velocities())
    tau = casadi.Function("tau", [q, v, vdot], [model.inverse_dynamics(q, v, vdot)])
    for x, _ in states(plant):
        plant.SetPositionsAndVelocities(context, x)
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        a = np.cos(np.arange(plant.num_velocities()))
        damping = np.concatenate([joint.GetDampingVector(context) for joint in _joints_by_velocity(plant)])
        # Drake's torques contain the damping.
        expected = plant.CalcInverseDynamics(context, a, forces) - damping * plant.GetVelocities(context)
        n = plant.num_positions()
        assert relative(tau(x[:n], x[n:], a).full(), expected) < 1e-12


def pendulum_of(length: float) -> MultibodyPlant:
    """A pendulum of two boxes whose lengths, mass and gravity have one scale: it moves alike, whatever that is."""
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -9.81 * length])
    com = np.array([0.0, 0.1, -0.5]) * length
    box = UnitInertia.SolidBox(*(np.array([0.1, 0.2, 1.0]) * length)).ShiftFromCenterOfMass(com)
    carrier = plant.world_frame()
    for name in ("upper", "lower"):
        body = plant.AddRigidBody(name, SpatialInertia(length**3, com, box, skip_validity_check=True))
        plant.AddJoint(RevoluteJoint(f"{name}_hinge", carrier, body.body_frame(), [0, 1, 0]))
        X_BF = RigidTransform([0.0, 0.0, -length])
        carrier = plant.AddFrame(FixedOffsetFrame(f"{name}_end", body.body_frame(), X_BF))
    plant.Finalize()
    return plant


@pytest.mark.parametrize("length", [1.0, 1e-6, 1e-16])
def test_a_model_of_any_size_keeps_its_dimensions(length):
    x = [0.3, -0.2, 0.5, 1.0]
    plant = pendulum_of(1.0)
    context = plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, x)
    small = pendulum_of(length)
    found = plant_dynamics(small, small.CreateDefaultContext())(x, []).full()
    assert relative(found, plant.EvalTimeDerivatives(context).CopyToVector()) < 1e-12


def _joints_by_velocity(plant):
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    return sorted((j for j in joints if j.num_velocities()), key=lambda joint: joint.velocity_start())


def test_energies_are_those_of_the_plant():
    plant = floating(0.0)
    context = plant.CreateDefaultContext()
    plant.GetJointActuatorByName("motor").SetRotorInertia(context, 0.0)
    model = PlantDynamics(plant, context)
    q, v, _ = model.symbols()
    energy = casadi.Function("energy", [q, v], list(model.energy(q, v)))
    for x, _ in states(plant):
        plant.SetPositionsAndVelocities(context, x)
        expected = plant.CalcKineticEnergy(context), plant.CalcPotentialEnergy(context)
        n = plant.num_positions()
        assert [float(e) for e in energy(x[:n], x[n:])] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("make", "name"), [(arm, "tip"), (floating, "tool"), (climber, "payload")])
def test_frames_move_as_those_of_the_plant(make, name):
    plant = make(0.0)
    context = plant.CreateDefaultContext()
    model = PlantDynamics(plant, context)
    frame = plant.GetFrameByName(name)
    q, v, _ = model.symbols()
    motion = model.frame(frame, q)
    found = casadi.Function("found", [q, v], [motion.R, motion.p, motion.J, model.frame_bias(frame, q, v)])
    for x, _ in states(plant, 2):
        plant.SetPositionsAndVelocities(context, x)
        n, world = plant.num_positions(), plant.world_frame()
        X_WF = frame.CalcPoseInWorld(context)
        J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world)
        bias = plant.CalcBiasSpatialAcceleration(context, JacobianWrtVariable.kV, frame, np.zeros(3), world, world)
        expected = X_WF.rotation().matrix(), X_WF.translation()[:, None], J, bias.get_coeffs()[:, None]
        for value, wanted in zip(found(x[:n], x[n:]), expected, strict=True):
            np.testing.assert_allclose(value.full(), wanted, atol=1e-11)


INPUTS = {
    "arm.mass": 1.7,
    "arm.center_of_mass": [0.3, -0.1, 0.2],
    "torso.inertia": [0.9, 1.1, 1.0, 0.1, -0.05, 0.02],
    "slider.damping": 0.7,
    "mount.pose": [0.2, -0.3, 0.4, 0.3, -0.5, 1.1],
    "motor.rotor_inertia": 4e-3,
    "motor.gear_ratio": 35.0,
}


@pytest.mark.parametrize("addresses", [list(INPUTS), ["arm.mass"], ["torso.inertia", "slider.damping"]])
def test_changed_belief_is_a_changed_argument(addresses):
    plant = floating(0.0)
    context = plant.CreateDefaultContext()
    dynamics = plant_dynamics(plant, context, inputs=addresses)
    values = {name: INPUTS[name] for name in addresses}
    _write(plant, context, values)
    for x, u in states(plant, 2):
        plant.SetPositionsAndVelocities(context, x)
        plant.get_actuation_input_port().FixValue(context, u)
        expected = plant.EvalTimeDerivatives(context).CopyToVector()
        assert relative(dynamics(x, u, *values.values()).full(), expected) < 1e-12
        named = dynamics(x=x, u=u, **{name.replace(".", "_"): value for name, value in values.items()})
        assert relative(named["xdot"].full(), expected) < 1e-12


def _write(plant, context, values):
    """By Drake's own setters."""
    for address, value in values.items():
        name, quantity = address.split(".")
        if quantity == "mass":
            plant.GetBodyByName(name).SetMass(context, value)
        elif quantity == "center_of_mass":
            # The inertia about the centre of mass stays.
            body = plant.GetBodyByName(name)
            body.SetSpatialInertiaInBodyFrame(context, inertia(body.get_mass(context), value))
        elif quantity == "inertia":
            body = plant.GetBodyByName(name)
            M = body.CalcSpatialInertiaInBodyFrame(context)
            m, com = M.get_mass(), M.get_com()
            unit = type(M.get_unit_inertia())(*(np.array(value) / m)).ShiftFromCenterOfMass(com)
            body.SetSpatialInertiaInBodyFrame(context, SpatialInertia(m, com, unit))
        elif quantity == "damping":
            plant.GetJointByName(name).SetDamping(context, value)
        elif quantity == "pose":
            plant.GetFrameByName(name).SetPoseInParentFrame(context, pose_from_array(np.array(value)))
        elif quantity == "gear_ratio":
            plant.GetJointActuatorByName(name).SetGearRatio(context, value)
        else:
            plant.GetJointActuatorByName(name).SetRotorInertia(context, value)


def test_values_in_the_context_count():
    """Masses are read when the function is made, not when the plant was."""
    plant = cart_pole(0.0)
    context = plant.CreateDefaultContext()
    light = plant_dynamics(plant, context)
    plant.GetBodyByName("pole").SetMass(context, 2.0)
    heavy = plant_dynamics(plant, context)
    x, u = [0, 1, 0, 0], [0.0]
    plant.SetPositionsAndVelocities(context, x)
    plant.get_actuation_input_port().FixValue(context, u)
    expected = plant.EvalTimeDerivatives(context).CopyToVector()
    assert relative(heavy(x, u).full(), expected) < 1e-12
    assert relative(light(x, u).full(), expected) > 1e-2


@pytest.mark.parametrize("u", [19.0, 21.0, -500.0])
def test_effort_limits_hold(u):
    plant = cart_pole(0.0)
    context = plant.CreateDefaultContext()
    plant.get_actuation_input_port().FixValue(context, [u])
    expected = plant.EvalTimeDerivatives(context).CopyToVector()
    assert relative(plant_dynamics(plant, context)(np.zeros(4), u).full(), expected) < 1e-12


def test_actuation_that_is_not_a_number_stays_one():
    """Drake's plant fails at such a value; here it is seen in the result, whatever the effort limit."""
    plant = cart_pole(0.0)
    assert np.isnan(plant_dynamics(plant, plant.CreateDefaultContext())(np.zeros(4), np.nan).full()[2:]).all()


def test_overrun_tells_exactly_when_drakes_stop_acts():
    plant = cart_pole(0.01, stop=1.0)
    context = plant.CreateDefaultContext()
    step = plant_step(plant, context)
    seen = set()
    for speed in np.arange(0.125, 3.0, 0.25):
        x = np.array([0.97, 0.0, speed, 0.0])
        plant.SetPositionsAndVelocities(context, x)
        following, overrun = step(x, 0.0)
        acts = relative(following.full(), simulate(plant, context, np.zeros((1, 1)), 1)[0]) > 1e-9
        assert acts == (float(overrun) > 0.0)
        seen.add(acts)
    assert seen == {True, False}


def test_steps_have_derivatives():
    plant = arm(0.005)
    context = plant.CreateDefaultContext()
    step = plant_step(plant, context)
    x, u = casadi.SX.sym("x", 14), casadi.SX.sym("u", 7)
    slope = casadi.Function("slope", [x, u], [casadi.jacobian(step(x, u)[0], u)])
    x0, u0, h = 0.1 * np.arange(14.0), np.arange(7.0), 1e-5
    for k in range(7):
        ahead, behind = (step(x0, u0 + s * h * np.eye(7)[k])[0].full().ravel() for s in (1, -1))
        np.testing.assert_allclose(slope(x0, u0).full()[:, k], (ahead - behind) / (2 * h), atol=1e-8)


def test_plant_without_actuators_is_a_plant():
    plant = MultibodyPlant(0.0)
    plant.AddRigidBody("stone", inertia(1.0))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    xdot = plant_dynamics(plant, context)(plant.GetPositionsAndVelocities(context), [])
    np.testing.assert_allclose(xdot.full().ravel()[-3:], [0, 0, -9.81], atol=1e-12)
