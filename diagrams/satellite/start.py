"""The motion of the target at the start of a capture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context

from vtbdrake.common.arrays import Array
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.systems import pose_to_array
from vtbdrake_diagrams.satellite.bodies import Target

MEETING = 15.0
"""When the gripper meets the bar in a capture without delays, in s: the servicer waits for a target that will then face
it. So a target that turns by 3 deg/s does so by 45 deg before, as far as its markers can be seen."""
ATTITUDE_SPREAD = np.radians(10.0)
"""By how much the target is off its nominal attitude then, at most, in rad."""
POSITION_SPREAD = 0.05
"""By how much its bar is off its nominal place then, in each direction at most, in m."""
DRIFT = 0.005
"""Its velocity against the servicer, in each direction at most, in m/s."""


@dataclass(frozen=True)
class Start:
    """The motion of the target at t = 0.

    Attributes:
        X_WT: Its pose.
        w_WT: Its angular velocity in W (rad/s), shape (3,).
        v_WT: The velocity of its centre of mass in W (m/s), shape (3,).
    """

    X_WT: RigidTransform
    w_WT: Array
    v_WT: Array

    def values(self) -> dict[str, Array]:
        """Return the start as values by address, for a rollout of any `SatelliteScenario`."""
        return {
            "sim.sys.target.body.pose": pose_to_array(self.X_WT),
            "sim.env.release.velocity": np.concatenate((self.w_WT, self.v_WT)),
        }


def random_start(seed: int, *, tumble: float, distance: float) -> Start:
    """Return the start of a tumble about a random axis, in which the bar is near its nominal place at `MEETING`.

    Args:
        seed: The seed of all random numbers.
        tumble: The angular velocity in rad/s.
        distance: The distance of the target's centre from the servicer's, along x, when the target faces it, in m.
    """
    random = np.random.default_rng(seed)
    axis, off_axis = (direction / np.linalg.norm(direction) for direction in random.normal(size=(2, 3)))
    off = RotationMatrix(AngleAxis(ATTITUDE_SPREAD * random.uniform(), off_axis))
    p_THo_T = Target().X_TH.translation()
    p_WHo = np.array([distance, 0.0, 0.0]) + p_THo_T + random.uniform(-POSITION_SPREAD, POSITION_SPREAD, 3)
    v_WT = random.uniform(-DRIFT, DRIFT, 3)
    p_WTo = p_WHo - off @ p_THo_T - MEETING * v_WT
    before = RotationMatrix(AngleAxis(-tumble * MEETING, axis))
    return Start(RigidTransform(before @ off, p_WTo), tumble * axis, v_WT)


class Release(AddressedSystem):
    """Sets a resting, floating body in motion in the first step of a discrete plant.

    .. pydrake_system::

        name: Release
        input_ports:
        - state
        output_ports:
        - spatial_force

    A plant has no default velocities. During the first step, of dt, the body is pushed by the momentum that it is to
    have, divided by dt; it then has the parameter ``velocity``, [angular (rad/s); linear (m/s)] in the world. The
    body's frame is at its centre of mass, and its mass is the model's.
    """

    def __init__(self, plant: MultibodyPlant, instance: ModelInstanceIndex, start: Start) -> None:
        super().__init__()
        body = plant.GetBodyByName("body", instance)
        self._body, self._step = body.index(), plant.time_step()
        inertia = body.default_spatial_inertia()
        self._mass, self._I_T = inertia.get_mass(), inertia.CalcRotationalInertia().CopyToFullMatrix3()
        self._quaternion = slice(body.floating_positions_start(), body.floating_positions_start() + 4)
        self._settings = self.declare_parameters(
            velocity=Quantity(np.concatenate((start.w_WT, start.v_WT)), "rad/s, m/s")
        )
        self._state = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        self.DeclareAbstractOutputPort(
            "spatial_force",
            lambda: Value([ExternallyAppliedSpatialForce()]),
            self._calc,
            prerequisites_of_calc={
                self.numeric_parameter_ticket(self._settings.index),
                self.time_ticket(),
                self._state.ticket(),
            },
        )

    def _calc(self, context: Context, output: Value) -> None:  # type: ignore[valid-type]
        if context.get_time() >= 0.5 * self._step:
            output.set_value([])  # type: ignore[attr-defined]
            return
        velocity = self._settings.view(context).velocity
        R_WT = RotationMatrix(Quaternion(self._state.Eval(context)[self._quaternion])).matrix()
        push = ExternallyAppliedSpatialForce()
        push.body_index = self._body
        push.F_Bq_W = SpatialForce(
            tau=R_WT @ self._I_T @ R_WT.T @ velocity[:3] / self._step, f=self._mass * velocity[3:] / self._step
        )
        output.set_value([push])  # type: ignore[attr-defined]
