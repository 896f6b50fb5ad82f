"""The climber in MuJoCo has the masses, the joints, the sensors and the walk of Drake's."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite

import mujoco
import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake_diagrams.space_climber import SpaceClimberScenario
from vtbdrake_diagrams.space_climber.morphology import JOINT_NAMES, Morphology
from vtbdrake_diagrams.space_climber.plant import add_climber, add_payload
from vtbdrake_diagrams.space_climber.studies.levers import LeverMap
from vtbdrake_diagrams.space_climber.studies.other_engine import MujocoClimber, Walk, base_motion, climber_mjcf
from vtbdrake_diagrams.space_climber.studies.payload import MASS

LOAD = 30.0


def test_inertia_and_gravity_are_those_of_drakes_model() -> None:
    plant = MultibodyPlant(0.0)
    climber = add_climber(plant)
    payload = plant.GetBodyByName("payload", add_payload(plant, climber))
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -1.62])
    plant.Finalize()
    context = plant.CreateDefaultContext()
    payload.SetMass(context, LOAD)
    model = mujoco.MjModel.from_xml_string(climber_mjcf(LOAD))
    data = mujoco.MjData(model)
    hinges = [model.joint(name) for name in JOINT_NAMES]
    joints = [plant.GetJointByName(name) for name in JOINT_NAMES]
    for joint, hinge, angle in zip(joints, hinges, np.random.default_rng(3).uniform(-1.0, 1.0, 18), strict=True):
        joint.set_angle(context, angle)
        data.qpos[hinge.qposadr[0]] = angle
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    # Both have the base's linear velocity in the world's frame, in which the base is upright here.
    drake = [*range(3, 6), *range(3), *(joint.velocity_start() for joint in joints)]
    other = [*range(6), *(hinge.dofadr[0] for hinge in hinges)]
    np.testing.assert_allclose(M[np.ix_(other, other)], plant.CalcMassMatrix(context)[np.ix_(drake, drake)], atol=1e-8)
    gravity = plant.CalcGravityGeneralizedForces(context)[drake]
    np.testing.assert_allclose(-data.qfrc_bias[other], gravity, atol=1e-8)


def test_the_imu_sees_the_angular_velocity_in_the_world() -> None:
    # A quarter turn about x: the base's y is the world's z, and its z the world's -y.
    qpos = np.array([1.0, 2.0, 3.0, np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    qvel = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
    motion = base_motion(qpos, qvel)
    np.testing.assert_allclose(motion[:4], qpos[3:])
    np.testing.assert_allclose(motion[4:], [1.0, -3.0, 2.0, 0.1, 0.2, 0.3], atol=1e-12)


def drakes_pose(scenario: SpaceClimberScenario, mass: float, time: float) -> np.ndarray:
    testbed = scenario.build()
    context = testbed.default_context()
    testbed.write(context, {MASS: mass})
    testbed.simulator(context).AdvanceTo(time)
    return np.asarray(testbed.read(context, "sim.sys.climber.base.pose"))


@pytest.mark.parametrize("slope_deg", [0.0, 10.0])
def test_it_walks_as_in_drake(slope_deg: float) -> None:
    scenario = SpaceClimberScenario(slope_deg=slope_deg)
    walk = MujocoClimber(scenario).walk(1.0, horizon=2.0)
    pose = drakes_pose(scenario, 1.0, 2.0)
    assert not isfinite(walk.fallen_at)
    # A quarter of a metre in two seconds.
    np.testing.assert_allclose(walk.poses[-1][:3], pose[:3], atol=0.02)
    np.testing.assert_allclose(walk.poses[-1][3:], pose[3:], atol=0.02)
    assert walk.poses[-1][0] - walk.poses[0][0] > 0.2


def test_a_heavy_attachment_tips_it() -> None:
    walk = MujocoClimber().walk(58.0)
    assert walk.fallen_at < 6.0
    assert walk.poses[-1][4] > np.pi / 4


def test_a_longer_lever_and_a_longer_stance_reach_the_model() -> None:
    lever, stance_x = 0.7, 0.46
    model = mujoco.MjModel.from_xml_string(MujocoClimber(lever=lever).mjcf(LOAD))
    np.testing.assert_allclose(model.body("payload").pos, [lever, 0.0, 0.0])
    walk = MujocoClimber(morphology=Morphology(stance_x=stance_x)).walk(0.1, stroke=False, horizon=0.5)
    np.testing.assert_allclose(walk.poses[-1][:3], [0.0, 0.0, 0.2], atol=0.01)


@dataclass(frozen=True)
class TipsAbove(MujocoClimber):
    """A climber that tips over with more than a limit, and with one lighter mass."""

    limit: float = inf
    odd: float = -1.0

    def walk(self, mass: float, *, phase: float = 0.0, stroke: bool = True, horizon: float = 1.0) -> Walk:
        tips = mass > self.limit + phase or mass == self.odd
        return Walk(1.0 if tips else inf, np.zeros(0), np.zeros((0, 6)))


@pytest.mark.parametrize(
    ("climber", "limits"),
    [
        (TipsAbove(limit=33.0), (33.0, 34.0)),
        (TipsAbove(limit=35.0), (35.0, 36.0)),
        (TipsAbove(limit=34.0, odd=28.0), (27.0, 28.0)),
        (TipsAbove(limit=10.0), (-inf, 20.0)),
        (TipsAbove(limit=20.0), (20.0, 21.0)),
        (TipsAbove(), (60.0, inf)),
    ],
)
def test_the_boundary_is_the_first_mass_that_tips_it(climber: TipsAbove, limits: tuple[float, float]) -> None:
    assert climber.boundary(20.0, 60.0, resolution=1.0, coarse=5.0, phases=[0.0, 0.25]) == limits


def test_the_lever_of_a_mass_lies_between_its_neighbours() -> None:
    limits = np.array([[50.0, 40.0, 30.0], [44.0, 36.0, 28.0], [90.0, 80.0, 46.0]])
    result = LeverMap(np.array([0.4, 0.5, 0.6]), np.array([0.3, 0.4, 0.5]), limits)
    np.testing.assert_allclose(result.lever_of(45.0), [0.45, np.nan, np.nan])
    assert result.plot().axes[0].get_xlabel() == "lever of the component (m)"
