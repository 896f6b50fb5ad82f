"""What carries the arm after a fault, against the simulated arm."""

from __future__ import annotations

import numpy as np
import pytest

from diagrams.manipulator.arm import Arm
from diagrams.manipulator.safety import SLIP, FloatInPlace
from diagrams.manipulator.scenario import ManipulatorScenario
from vtbdrake.testbed import WorldAlone

HOME = np.array(Arm().home)
REST = np.zeros(7)


WORLD = WorldAlone(ManipulatorScenario())


def gravity(q: np.ndarray) -> np.ndarray:
    """By Drake."""
    plant = WORLD.plant
    assert plant is not None
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, q)
    return -plant.CalcGravityGeneralizedForces(context)


def sensed(q: np.ndarray, v: np.ndarray = REST) -> dict[str, np.ndarray]:
    return {"joint_position": q, "joint_velocity": v}


def test_resting_arm_is_carried() -> None:
    torque = FloatInPlace().command(np.zeros(7), sensed(HOME), 0.001)
    np.testing.assert_allclose(torque, gravity(HOME), atol=1e-9)


def test_arm_that_moves_is_braked_and_pulled_back() -> None:
    floating = FloatInPlace()
    floating.command(np.zeros(7), sensed(HOME), 0.001)
    q, v = HOME + 0.01, np.full(7, 0.1)
    pull = floating.command(np.zeros(7), sensed(q, v), 0.001) - gravity(q)
    assert (pull < 0.0).all()
    slower = floating.command(np.zeros(7), sensed(q), 0.001) - gravity(q)
    assert (slower < 0.0).all()
    assert (pull < slower).all()


def test_pose_far_away_is_no_goal() -> None:
    """The arm was moved while somebody else commanded it: the springs pull no harder than at the slip."""
    floating, pushed = FloatInPlace(), FloatInPlace()
    floating.command(np.zeros(7), sensed(HOME), 0.001)
    pushed.command(np.zeros(7), sensed(HOME), 0.001)
    far, near = HOME + 1.0, HOME + SLIP
    torques = [f.command(np.zeros(7), sensed(q), 0.001) - gravity(q) for f, q in ((floating, far), (pushed, near))]
    np.testing.assert_allclose(torques[0], torques[1], atol=1e-9)


def test_weight_of_the_last_known_pose_is_carried_blindly() -> None:
    floating = FloatInPlace()
    floating.command(np.zeros(7), sensed(HOME), 0.001)
    np.testing.assert_allclose(floating.command(np.zeros(7), {}, 0.001), gravity(HOME), atol=1e-9)


def test_arm_is_held_where_it_was_when_this_took_over() -> None:
    floating = FloatInPlace()
    floating.command(np.zeros(7), sensed(HOME), 0.001)
    floating.take_over()
    moved = HOME + 0.3
    np.testing.assert_allclose(floating.command(np.zeros(7), sensed(moved), 0.001), gravity(moved), atol=1e-9)


def test_pose_of_an_earlier_fault_is_forgotten() -> None:
    floating = FloatInPlace()
    floating.command(np.zeros(7), sensed(HOME), 0.001)
    floating.take_over()
    with pytest.raises(RuntimeError, match="no position"):
        floating.command(np.zeros(7), {}, 0.001)


def test_arm_that_was_never_seen_cannot_be_carried() -> None:
    with pytest.raises(RuntimeError, match="no position"):
        FloatInPlace().command(np.zeros(7), {}, 0.001)
