"""Standing by inverse dynamics: the torques that carry a robot, what they lead to, and what holds one that fell."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

from vtbdrake.components.standing import Gains, Stance, StandingController, WholeBodyModel, WholeBodyMotion

MODEL = Path(__file__).parents[1] / "project" / "models" / "quadruped.urdf"
LEGS = [f"{x}_{y}" for x in ("front", "hind") for y in ("left", "right")]
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in ("roll", "pitch", "knee")]
# The feet lie below the hips, whose pitch is half of the knee's bend: 0.4 m of leg to the middle of the foot.
PITCH = 0.5
HEIGHT = 0.4 * np.cos(PITCH) + 0.02
# The direction to the ground in a shank, in which the contact point lies 2 cm from the middle of the foot.
POINT = np.array([0.0, 0.0, -0.2]) + 0.02 * np.array([-np.sin(PITCH), 0.0, -np.cos(PITCH)])


def make_plant() -> MultibodyPlant:
    plant = MultibodyPlant(0.001)
    Parser(plant).AddModels(str(MODEL))
    plant.Finalize()
    return plant


@pytest.fixture(scope="module")
def stance() -> Stance:
    return Stance(
        "trunk",
        np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, HEIGHT]),
        np.array([0.0, PITCH, -2.0 * PITCH] * 4),
        tuple(JOINTS),
        {f"{leg}_shank": POINT[np.newaxis] for leg in LEGS},
    )


def model_of(stance: Stance, limit: float = 40.0) -> WholeBodyModel:
    return WholeBodyModel(make_plant, stance, motions=np.eye(12), limit=np.full(12, limit))


def test_torques_at_rest_carry_the_weight(stance: Stance) -> None:
    """With half of the weight on either side: torque = -(gravity) - J' f, joint by joint."""
    model = model_of(stance)
    effort, solved = model.effort(model.rest, gains=Gains(), shift=0.0)
    plant = make_plant()
    context = plant.CreateDefaultContext()
    for name, position in zip(JOINTS, stance.posture, strict=True):
        plant.GetJointByName(name).set_angle(context, position)
    weight = plant.CalcTotalMass(context) * 9.81
    # The feet are at x = 0.2 and -0.2 m; the legs lean a little.
    x = (
        plant.CalcCenterOfMassPositionInWorld(context)[0]
        - plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("trunk")).translation()[0]
    )
    torque = -plant.CalcGravityGeneralizedForces(context)
    for leg, share in zip(LEGS, [0.5 + x / 0.4] * 2 + [0.5 - x / 0.4] * 2, strict=True):
        foot = plant.GetBodyByName(f"{leg}_shank").body_frame()
        J = plant.CalcJacobianTranslationalVelocity(
            context, JacobianWrtVariable.kV, foot, POINT, plant.world_frame(), plant.world_frame()
        )
        torque -= J.T @ [0.0, 0.0, 0.5 * share * weight]
    places = [plant.GetJointByName(name).velocity_start() for name in JOINTS]
    assert solved and model.weight == pytest.approx(weight, rel=1e-3)
    np.testing.assert_allclose(effort, torque[places], atol=0.02 * np.abs(effort).max())


def test_weight_is_led_to_the_left_of_the_feet(stance: Stance) -> None:
    model = model_of(stance)
    end = model.settled(gains=Gains(), shift=0.03, duration=2.0)
    assert end is not None
    assert 0.024 < model.shifted(end) < 0.033
    assert end.pose[5] > 0.02 and abs(end.pose[4]) < 0.005


def test_the_stance_is_the_same_wherever_the_feet_are(stance: Stance) -> None:
    """A robot that stands elsewhere, turned by 2 rad, needs the same torques."""
    model = model_of(stance)
    turned = np.array([np.cos(1.0), 0.0, 0.0, np.sin(1.0), 3.0, -2.0, HEIGHT])
    elsewhere = model.rest._replace(pose=turned)
    expected, _ = model.effort(model.rest, gains=Gains(), shift=0.02)
    effort, solved = model.effort(elsewhere, gains=Gains(), shift=0.02)
    assert solved
    np.testing.assert_allclose(effort, expected, atol=1e-3)


def test_joints_are_held_once_the_trunk_has_turned_over(stance: Stance) -> None:
    """The fallback commands torques by the inertia at each joint."""
    model, angle, offset = model_of(stance), 1.2, 0.001
    position = stance.posture + offset
    fallen = np.array([np.cos(0.5 * angle), np.sin(0.5 * angle), 0.0, 0.0, 0.0, 0.0, 0.1])
    effort, solved = model.effort(
        WholeBodyMotion(fallen, np.zeros(6), position, np.zeros(12)), gains=Gains(posture_frequency=10.0), shift=0.0
    )
    plant = make_plant()
    context = plant.CreateDefaultContext()
    for name, q in zip(JOINTS, position, strict=True):
        plant.GetJointByName(name).set_angle(context, q)
    places = [plant.GetJointByName(name).velocity_start() for name in JOINTS]
    inertia = np.diagonal(plant.CalcMassMatrix(context))[places]
    assert not solved
    np.testing.assert_allclose(effort, -(10.0**2) * offset * inertia, rtol=1e-6)


def test_weak_drives_let_the_robot_sink(stance: Stance) -> None:
    model = model_of(stance, limit=0.5)  # N m, where standing takes some 8
    end = model.settled(gains=Gains(), shift=0.0, duration=0.2)
    assert end is not None and end.pose[6] < stance.X_WB[6] - 0.05


def test_efforts_stay_within_their_limits(stance: Stance) -> None:
    model = model_of(stance, limit=12.0)
    falling = model.rest._replace(twist=np.array([0.0, 0.5, 0.0, 0.0, 0.0, -1.0]))
    effort, _ = model.effort(falling, gains=Gains(frequency=20.0), shift=0.05)
    assert np.abs(effort).max() <= 12.0


def test_controller_begins_with_the_torques_of_its_stance(stance: Stance) -> None:
    controller = StandingController(make_plant, stance, motions=np.eye(12), limit=np.full(12, 40.0), period=0.005)
    at_rest, _ = controller.model.effort(controller.model.rest, gains=Gains(), shift=0.0)
    assert np.array_equal(controller.get_output_port().Eval(controller.CreateDefaultContext()), at_rest)
