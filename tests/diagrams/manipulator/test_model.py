"""The shipped model, and the controllers' own dynamics, against Drake and hand formulas."""

from __future__ import annotations

import casadi
import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable, MultibodyForces
from pydrake.systems.framework import Context

from vtbdrake_diagrams.manipulator.arm import JOINT_NAMES, JOINTS, Arm
from vtbdrake_diagrams.manipulator.dynamics import ArmDynamics, function
from vtbdrake_diagrams.manipulator.model import ARM_SDF, arm_sdf

ARM = Arm()
RNG = np.random.default_rng(7)
POSES = [(RNG.uniform(ARM.lower, ARM.upper), RNG.normal(size=7), RNG.normal(size=7)) for _ in range(5)]


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModels(str(ARM_SDF))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -9.81])
    plant.Finalize()
    return plant


@pytest.fixture
def context(plant: MultibodyPlant) -> Context:
    return plant.CreateDefaultContext()


def own(name: str, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """A result of the controllers' model."""
    return OWN(q=q, v=v, a=a)[name].full().squeeze()


def _own() -> casadi.Function:
    q, v, a = (casadi.SX.sym(n, JOINTS) for n in ("q", "v", "a"))
    dynamics = ArmDynamics()
    tip = dynamics.tip(q)
    p, dL_dq = dynamics.momentum(q, v)
    results = {
        "torque": dynamics.inverse_dynamics(q, v, a),
        "link_torque": dynamics.inverse_dynamics(q, v, a, rotors=False),
        "R": tip.R,
        "p": tip.p,
        "J": tip.J,
        "bias": dynamics.tip_bias(q, v),
        "momentum": p,
        "dL_dq": dL_dq,
    }
    return function("own", {"q": q, "v": v, "a": a}, results)


OWN = _own()


def without_rotors(plant: MultibodyPlant, context: Context) -> None:
    for name in JOINT_NAMES:
        plant.GetJointActuatorByName(name).SetRotorInertia(context, 0.0)


def test_shipped_file_is_what_the_generator_writes() -> None:
    assert ARM_SDF.read_text() == arm_sdf()


def test_arm_weighs_what_its_data_sheet_says(plant: MultibodyPlant, context: Context) -> None:
    tool = plant.GetBodyByName("tool").get_mass(context)
    assert plant.CalcTotalMass(context) - tool == pytest.approx(29.9, abs=1e-9)


def test_inertias_are_those_of_bodies(plant: MultibodyPlant) -> None:
    for index in plant.GetBodyIndices(plant.GetModelInstanceByName("arm")):
        assert plant.get_body(index).default_spatial_inertia().IsPhysicallyValid()
    cylinder = plant.GetBodyByName("link_1").default_rotational_inertia().CopyToFullMatrix3()
    m, r, length = ARM.masses[0], ARM.radii[0], ARM.lengths[0]
    # About the end of a solid cylinder.
    across = m * (3 * r**2 + 4 * length**2) / 12
    np.testing.assert_allclose(cylinder, np.diag([across, across, m * r**2 / 2]), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("q", "v", "a"), POSES)
def test_mass_matrix_is_positive_definite(plant: MultibodyPlant, context: Context, q, v, a) -> None:
    plant.SetPositions(context, q)
    without_rotors(plant, context)
    assert np.linalg.eigvalsh(plant.CalcMassMatrix(context)).min() > 0.0


def test_limits_and_rotors_reach_the_plant(plant: MultibodyPlant, context: Context) -> None:
    np.testing.assert_allclose(plant.GetPositionLowerLimits(), ARM.lower, atol=1e-9)
    np.testing.assert_allclose(plant.GetPositionUpperLimits(), ARM.upper, atol=1e-9)
    actuators = [plant.GetJointActuatorByName(name) for name in JOINT_NAMES]
    assert tuple(a.effort_limit() for a in actuators) == ARM.torques
    reflected = [a.calc_reflected_inertia(context) for a in actuators]
    np.testing.assert_allclose(reflected, ARM.reflected_inertias, rtol=1e-9)


def test_arm_points_up_at_zero(plant: MultibodyPlant, context: Context) -> None:
    plant.SetPositions(context, np.zeros(7))
    p = plant.GetFrameByName("tip").CalcPoseInWorld(context).translation()
    np.testing.assert_allclose(p, [0, 0, 0.36 + 0.42 + 0.40 + 0.126 + ARM.tool_length], atol=1e-12)


def test_home_is_within_the_ranges_and_points_along_x(plant: MultibodyPlant, context: Context) -> None:
    assert np.all(np.array(ARM.home) > ARM.lower)
    assert np.all(np.array(ARM.home) < ARM.upper)
    plant.SetPositions(context, ARM.home)
    X_WT = plant.GetFrameByName("tip").CalcPoseInWorld(context)
    np.testing.assert_allclose(X_WT.rotation().matrix()[:, 2], [1, 0, 0], atol=1e-12)


@pytest.mark.parametrize(("q", "v", "a"), POSES)
def test_own_kinematics_agree_with_drake(plant: MultibodyPlant, context: Context, q, v, a) -> None:
    plant.SetPositions(context, q)
    tip, world = plant.GetFrameByName("tip"), plant.world_frame()
    X_WT = tip.CalcPoseInWorld(context)
    J = plant.CalcJacobianSpatialVelocity(context, JacobianWrtVariable.kV, tip, np.zeros(3), world, world)
    np.testing.assert_allclose(own("R", q, v, a), X_WT.rotation().matrix(), atol=1e-9)
    np.testing.assert_allclose(own("p", q, v, a), X_WT.translation(), atol=1e-9)
    np.testing.assert_allclose(own("J", q, v, a), J, atol=1e-9)


@pytest.mark.parametrize(("q", "v", "a"), POSES)
def test_own_bias_agrees_with_drake(plant: MultibodyPlant, context: Context, q, v, a) -> None:
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    tip, world = plant.GetFrameByName("tip"), plant.world_frame()
    expected = plant.CalcBiasSpatialAcceleration(context, JacobianWrtVariable.kV, tip, np.zeros(3), world, world)
    np.testing.assert_allclose(own("bias", q, v, a), expected.get_coeffs(), atol=1e-8)


@pytest.mark.parametrize("rotors", [True, False])
@pytest.mark.parametrize(("q", "v", "a"), POSES)
def test_own_inverse_dynamics_agree_with_drake(plant: MultibodyPlant, context: Context, q, v, a, rotors: bool) -> None:
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    if not rotors:
        without_rotors(plant, context)
    forces = MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    expected = plant.CalcInverseDynamics(context, a, forces)
    np.testing.assert_allclose(own("torque" if rotors else "link_torque", q, v, a), expected, atol=1e-7)


@pytest.mark.parametrize(("q", "v", "a"), POSES)
def test_own_momentum_obeys_lagranges_equation(plant: MultibodyPlant, context: Context, q, v, a) -> None:
    """dp/dt - dL/dq = tau, with dp/dt by differences along the motion."""
    plant.SetPositions(context, q)
    without_rotors(plant, context)
    np.testing.assert_allclose(own("momentum", q, v, a), plant.CalcMassMatrix(context) @ v, atol=1e-7)
    h = 1e-5
    ahead, behind = (own("momentum", q + s * h * v + h * h * a / 2, v + s * h * a, a) for s in (1, -1))
    tau = (ahead - behind) / (2 * h) - own("dL_dq", q, v, a)
    np.testing.assert_allclose(tau, own("link_torque", q, v, a), atol=1e-5)
