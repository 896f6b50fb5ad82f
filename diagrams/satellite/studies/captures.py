"""Captures from random starts, for the campaign of ``captures.yaml``: how they begin, and how they are judged.

``vtbdrake campaign captures.yaml``, in the folder of this module, simulates 40 captures whose tumble rates are drawn
from [0, `LARGEST_TUMBLE`], with camera and scanner in the loop, and reports how often they succeed.

The criteria of success, fixed before any result was seen, are in the file:

* The bar is held: the supervisor is in its mode ``hold``, and the bar is in truth between the fingers' pads, no further
  than 6 cm from the middle of the hand along it, than 2 cm along the direction of approach, and than 1 cm from one
  finger to the other. (The bar reaches 0.13 m to both sides of its middle and the fingers 0.04 m; the pads reach from
  0.04 m behind G to 0.05 m before it, the bar 0.033 m to both sides of H.)
* The relative motion has stopped: with the velocities at the end the bar would move by less than 1 mm against the hand
  in half a second, and each joint of the arm by less than 2 mrad.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import casadi
import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context

from vtbdrake.campaigns.campaign import Campaign, Criterion
from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.state.systems import pose_from_array, pose_later
from vtbdrake.testbed import VirtualTestbed
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Target
from vtbdrake_diagrams.satellite.kinematics import gripper
from vtbdrake_diagrams.satellite.scenario import SatelliteScenario
from vtbdrake_diagrams.satellite.start import random_start

LARGEST_TUMBLE = np.radians(3.0)
FIRST_SEED = 1000
"""The seed of the first capture."""
PAUSE = 0.5
"""The time in s in which bar and joints may creep."""
GRIP = (
    "sim.sys.servicer.base.pose",
    "sim.sys.target.body.pose",
    *(f"sim.sys.servicer.{name}.position" for name in JOINT_NAMES[:ARM_JOINTS]),
)
"""The arguments of `bar_in_gripper`."""


def start(seed: int) -> dict[str, Array]:
    """Return the random start of a capture as values by address; its tumble rate is drawn, too."""
    # The rates of all captures are one sequence, however many there are.
    rates = np.random.default_rng(FIRST_SEED).uniform(size=seed - FIRST_SEED + 1)
    tumble = float(LARGEST_TUMBLE * rates[-1])
    return random_start(seed, tumble=tumble, distance=SatelliteScenario().distance).values()


def bar_in_gripper(base: Array, target: Array, *joints: float) -> Array:
    """Return p_GoHo_G, the place of the bar in the gripper, in truth, shape (3,).

    Args:
        base: Pose of the base, [x, y, z, roll, pitch, yaw] in m and rad.
        target: Pose of the target, likewise.
        joints: Positions of the arm's joints in rad.
    """
    pose = _gripper().value([np.array(joints)])
    X_BG = RigidTransform(RotationMatrix(pose[:9].reshape(3, 3)), pose[9:])
    X_BT = pose_from_array(base).InvertAndCompose(pose_from_array(target))
    return np.array(X_BG.InvertAndCompose(X_BT @ Target().X_TH).translation())


def across(*grip: Array) -> float:
    """Return how far the bar is from the middle between the fingers, in m; arguments as in `bar_in_gripper`."""
    return float(abs(bar_in_gripper(*grip)[0]))


def along(*grip: Array) -> float:
    """Return how far the middle of the bar is from the hand, along the bar, in m; arguments as in `bar_in_gripper`."""
    return float(abs(bar_in_gripper(*grip)[1]))


def deep(*grip: Array) -> float:
    """Return how far the bar is from the hand, along the approach, in m; arguments as in `bar_in_gripper`."""
    return float(abs(bar_in_gripper(*grip)[2]))


def creep(base: Array, target: Array, base_velocity: Array, target_velocity: Array, *joints: float) -> float:
    """Return by how much the bar will move against the hand in `PAUSE` at the present velocities, in m.

    Args:
        base: Pose of the base, [x, y, z, roll, pitch, yaw] in m and rad.
        target: Pose of the target, likewise.
        base_velocity: Velocity of the base, [angular in rad/s, linear in m/s].
        target_velocity: Velocity of the target, likewise.
        joints: Positions of the arm's joints in rad, then their velocities in rad/s.
    """
    positions, rates = np.array(joints).reshape(2, ARM_JOINTS)
    later = bar_in_gripper(
        pose_later(base, base_velocity, PAUSE), pose_later(target, target_velocity, PAUSE), *(positions + PAUSE * rates)
    )
    return float(np.linalg.norm(later - bar_in_gripper(base, target, *positions)))


def joint_creep(*rates: float) -> float:
    """Return by how much a joint will move in `PAUSE` at most, in rad; of the velocities in rad/s."""
    return PAUSE * float(np.abs(rates).max())


def turned(base: Array) -> float:
    """Return by which angle the base has turned, in deg."""
    return float(np.degrees(pose_from_array(base).rotation().ToAngleAxis().angle()))


def succeeds(testbed: VirtualTestbed, context: Context) -> bool:
    """Return whether a capture that has ended in this context keeps all limits of ``captures.yaml``."""
    return all(
        criterion.passes(float(criterion.function()(*(testbed.read(context, name) for name in criterion.addresses))))
        for criterion in _criteria()
    )


@lru_cache
def _criteria() -> tuple[Criterion, ...]:
    """Return the criteria of success, which are all read at the end."""
    criteria = Campaign.load(Path(__file__).with_name("captures.yaml")).criteria.values()
    return tuple(criterion for criterion in criteria if criterion.is_limited)


@lru_cache
def _gripper() -> Kernel:
    q = casadi.SX.sym("q", ARM_JOINTS)
    G = gripper(q)
    pose = casadi.densify(casadi.vertcat(G.R.T.reshape((9, 1)), G.p))
    return Kernel("gripper", [q], pose, compile=False)
