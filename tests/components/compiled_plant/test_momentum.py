"""The base of a free-floating tree moves as momentum demands."""

from __future__ import annotations

import casadi
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, QuaternionFloatingJoint, RevoluteJoint
from pydrake.systems.analysis import Simulator
from scipy.integrate import solve_ivp

from tests.components.compiled_plant.plants import cart_pole, floating, inertia
from vtbdrake.common.spline import Spline
from vtbdrake.components.compiled_plant import BaseReaction, MomentumModel, UnsupportedPlantError, momentum_world

SPLINE = Spline("bspline", 8, 3.0)
STEPS = 60


def model_of(plant: MultibodyPlant) -> MomentumModel:
    joints = [plant.GetJointByName(name) for name in ("hinge", "slider")]
    return MomentumModel(plant, plant.CreateDefaultContext(), joints=joints)


def knots(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-1.5, -0.4], [1.5, 0.4], (SPLINE.knots, 2))


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    return floating(0.0, gravity=False)


@pytest.fixture(scope="module")
def model(plant: MultibodyPlant) -> MomentumModel:
    return model_of(plant)


@pytest.fixture(scope="module")
def reaction(model: MomentumModel) -> BaseReaction:
    return BaseReaction(model, SPLINE, steps=STEPS, compile=False)


def base_velocity(model: MomentumModel) -> casadi.Function:
    q, qdot = casadi.SX.sym("q", 2), casadi.SX.sym("qdot", 2)
    return casadi.Function("base_velocity", [q, qdot], [model.base_velocity(q, qdot)])


def test_base_velocity_follows_from_the_mass_matrix(plant, model):
    function, random = base_velocity(model), np.random.default_rng(1)
    context = plant.CreateDefaultContext()
    for _ in range(5):
        q, qdot = random.normal(size=(2, 2))
        plant.GetJointByName("hinge").set_angle(context, q[0])
        plant.GetJointByName("slider").set_translation(context, q[1])
        M = plant.CalcMassMatrix(context)
        moving = [plant.GetJointByName(name).velocity_start() for name in ("hinge", "slider")]
        expected = -np.linalg.solve(M[:6, :6], M[:6, moving] @ qdot)
        np.testing.assert_allclose(function(q, qdot).full().ravel(), expected, atol=1e-13)


def test_momentum_is_zero_in_any_pose_of_the_base(plant, model):
    function, random = base_velocity(model), np.random.default_rng(2)
    context = plant.CreateDefaultContext()
    X_WB = RigidTransform(RollPitchYaw(0.4, -0.9, 2.0), [3.0, -1.0, 0.5])
    plant.SetFreeBodyPose(context, plant.GetBodyByName("torso"), X_WB)
    q, qdot = random.normal(size=(2, 2))
    plant.SetPositions(context, [*plant.GetPositions(context)[:7], *q])
    V_WB_B = function(q, qdot).full()
    V_WB = np.concatenate([X_WB.rotation().matrix() @ part for part in (V_WB_B[:3], V_WB_B[3:])]).ravel()
    plant.SetVelocities(context, [*V_WB, *qdot])
    L_W = plant.CalcSpatialMomentumInWorldAboutPoint(context, [0.3, 0.7, -0.2])
    np.testing.assert_allclose(L_W.get_coeffs(), 0.0, atol=1e-12)


def test_the_plant_follows_its_torques_and_turns_alike(plant, model, reaction):
    w = knots()
    q, qdot, qddot = (casadi.SX.sym(name, 2) for name in ("q", "qdot", "qddot"))
    torque = casadi.Function("torque", [q, qdot, qddot], [model.torque(q, qdot, qddot)])
    curve = [lambda t, derivative=k: SPLINE.weights(t, derivative) @ w for k in range(3)]
    V_WB = base_velocity(model)(curve[0](0.0), curve[1](0.0)).full().ravel()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, [*plant.GetPositions(context)[:7], *curve[0](0.0)])
    plant.SetVelocities(context, [*V_WB, *curve[1](0.0)])
    forces = plant.get_applied_generalized_force_input_port()

    def derivatives(t, x):
        tau = torque(*(part(t) for part in curve)).full().ravel()
        forces.FixValue(context, np.concatenate([np.zeros(6), tau]))
        plant.SetPositionsAndVelocities(context, x)
        return plant.EvalTimeDerivatives(context).CopyToVector()

    plant.get_actuation_input_port().FixValue(context, [0.0])
    x = plant.GetPositionsAndVelocities(context)
    # From piece to piece, as the acceleration has kinks between them.
    for begin in np.linspace(0.0, SPLINE.duration, 6)[:-1]:
        x = solve_ivp(derivatives, (begin, begin + SPLINE.step * (1 - 1e-12)), x, rtol=1e-8, atol=1e-9).y[:, -1]
    motion = reaction(w)
    assert motion.angle.max() > 0.1
    np.testing.assert_allclose(x[7:9], w[-1], atol=1e-5)
    np.testing.assert_allclose(x[:4] * np.sign(x[0] * motion.rotation[-1, 0]), motion.rotation[-1], atol=1e-5)
    np.testing.assert_allclose(x[4:7], motion.position[-1], atol=1e-5)


def test_the_base_turns_alike_at_any_speed(model, reaction):
    slower = BaseReaction(model, Spline("bspline", 8, 9.0), steps=STEPS, compile=False)(knots())
    motion = reaction(knots())
    np.testing.assert_allclose(slower.rotation, motion.rotation, atol=1e-12)
    np.testing.assert_allclose(slower.position, motion.position, atol=1e-12)


def test_gradient_is_that_of_finite_differences(reaction):
    z = casadi.MX.sym("z", 2, SPLINE.knots)
    rotation, position, torque = reaction.function(z)
    value = casadi.sumsqr(rotation[1:, -1]) + position[0, -1] + 1e-3 * casadi.sumsqr(torque)
    f = casadi.Function("f", [z], [value, casadi.gradient(value, z)])
    w, way = knots().T, knots(5).T
    slope = float(casadi.dot(f(w)[1], way))
    h = 1e-5
    difference = (float(f(w + h * way)[0]) - float(f(w - h * way)[0])) / (2.0 * h)
    assert slope == pytest.approx(difference, rel=1e-6)


def test_machine_code_computes_the_same(model, reaction):
    expected, motion = reaction(knots()), BaseReaction(model, SPLINE, steps=STEPS)(knots().ravel())
    for name in ("rotation", "position", "torque"):
        np.testing.assert_allclose(getattr(motion, name), getattr(expected, name), atol=1e-11)


def test_the_world_turns_as_the_base_of_the_plan(model, reaction):
    w, period = knots(), 0.01
    world = momentum_world(model, w[0], period=period)
    simulator = Simulator(world)
    context = simulator.get_mutable_context()
    # At t = 0 the joints are at the start already.
    for k in range(round(SPLINE.duration / period) + 1):
        world.GetInputPort("position").FixValue(context, SPLINE.weights(min(k * period, SPLINE.duration)) @ w)
        simulator.AdvanceTo((k + 0.5) * period)
    state = world.GetOutputPort("state").Eval(context)
    motion = reaction(w)
    np.testing.assert_allclose(state[:7], [*motion.rotation[-1], *motion.position[-1]], atol=1e-5)
    np.testing.assert_allclose(state[7:], w[-1], atol=1e-12)
    assert [element.name for element in world.variables] == ["torso.position", "hinge.position", "slider.position"]


def two_bodies() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    first, second, arm = (plant.AddRigidBody(name, inertia(1.0)) for name in ("first", "second", "arm"))
    assert second
    plant.AddJoint(RevoluteJoint("hinge", first.body_frame(), arm.body_frame(), [0, 0, 1]))
    plant.Finalize()
    return plant


def moved_base() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    base, arm = (plant.AddRigidBody(name, inertia(1.0)) for name in ("base", "arm"))
    corner = plant.AddFrame(FixedOffsetFrame("corner", base.body_frame(), RigidTransform([1.0, 0.0, 0.0])))
    plant.AddJoint(QuaternionFloatingJoint("free", plant.world_frame(), corner))
    plant.AddJoint(PrismaticJoint("hinge", base.body_frame(), arm.body_frame(), [0, 0, 1]))
    plant.mutable_gravity_field().set_gravity_vector([0, 0, 0])
    plant.Finalize()
    return plant


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda: floating(0.0), "there is gravity"),
        (lambda: cart_pole(0.0), "0 bodies float .* 1 joints are attached to the world"),
        (two_bodies, "2 bodies float"),
        (moved_base, "free is not at the origin"),
    ],
)
def test_other_plants_are_refused_by_name(make, reason):
    plant = make()
    with pytest.raises(UnsupportedPlantError, match=reason):
        MomentumModel(plant, plant.CreateDefaultContext(), joints=[plant.GetJointByName("hinge")])


def test_joints_and_curves_that_do_not_fit_are_refused(plant, model, reaction):
    context = plant.CreateDefaultContext()
    with pytest.raises(ValueError, match="given once each"):
        MomentumModel(plant, context, joints=[])
    with pytest.raises(ValueError, match="has 6 velocities"):
        MomentumModel(plant, context, joints=[plant.GetJointByName("torso")])
    with pytest.raises(ValueError, match="take 'cubic' or 'bspline'"):
        model.motion(Spline("linear", 4, 1.0), steps=10)
    with pytest.raises(ValueError, match=r"shape \(8, 2\), not \(8,\)"):
        reaction(np.zeros(8))
