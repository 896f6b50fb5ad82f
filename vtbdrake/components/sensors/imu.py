"""Inertial measurement unit."""

from __future__ import annotations

from math import ceil
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.imu_kernel import sample, specific_force_at_rest
from vtbdrake.components.sensors.sampled import SampledSensor
from vtbdrake.state import Quantity
from vtbdrake.state.systems import LEAST_TURN

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Frame


class Imu(SampledSensor):
    r"""Measures angular velocity and specific force of a frame F that is fixed to a body B.

    .. pydrake_system::

        name: Imu
        input_ports:
        - state (only if B is a floating base)
        - body_poses (only if B is not)
        - body_spatial_velocities (only if B is not)
        output_ports:
        - imu

    ``imu`` has six entries, both expressed in F: angular velocity (rad/s), then specific force (m/s^2). Like an
    integrating sensor it gives the mean over the sample interval T:

        w = log(R_WF(t-T)' R_WF(t)) / T,    f = R_mid' ((v_WF(t) - v_WF(t-T)) / T - g)

    with R_mid the orientation halfway between. It needs no accelerations (which are direct feedthrough of the actuation
    in a continuous plant, and empty after a restore in a discrete one). The first sample has no predecessor: it
    shows w = 0 and f = -R_WF' g, and so does the output before it, for the plant's default pose.

    The parameter ``mount``, [x, y, z, roll, pitch, yaw], is the pose of F in B. Initially it is the pose of ``frame``;
    moving ``frame`` afterwards does not change it.

    Args:
        plant: The finalized plant.
        frame: A frame of the plant, at which the sensor begins.

    Attributes:
        entry_names: Names of the entries of the output.
        settings: The parameter ``mount``.
        memory: The state: whether there was a sample, and v_WF (m/s) and q_WF (wxyz) at the last one.
        gravity: The acceleration of free fall in the world, shape (3,), in m/s^2.
        body: Index of the body in the plant.
        floating_places: Where q_WB (wxyz) and V_WB ([w; v]) begin in the port ``state``; None without this port.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        frame: Frame,
        *,
        period: float,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        body = frame.body()
        default_context = plant.CreateDefaultContext()
        self.gravity = np.array(plant.gravity_field().gravity_vector())
        self.body = int(body.index())
        X_BF = frame.GetFixedPoseInBodyFrame()
        mount = [*X_BF.translation().tolist(), *RollPitchYaw(X_BF.rotation()).vector().tolist()]
        q_WF = frame.CalcPoseInWorld(default_context).rotation().ToQuaternion().wxyz()
        super().__init__(
            "imu",
            default=(0.0, 0.0, 0.0, *specific_force_at_rest(q_WF, self.gravity)),
            period=period,
            unit="rad/s, m/s^2",
            noise={"gyro_noise": (3, "rad/s"), "accelerometer_noise": (3, "m/s^2")},
            stream=stream,
            errors=errors,
        )
        self.entry_names = tuple(f"{quantity} {axis}" for quantity in ("rate", "force") for axis in "xyz")
        self.settings = self.declare_parameters(mount=Quantity(mount, "m, rad"))
        self.memory = self.declare_discrete_state(
            sampled=Quantity(0.0, bounds=(0.0, 1.0)),
            last_velocity=Quantity(np.zeros(3), "m/s"),
            last_orientation=Quantity([1.0, 0.0, 0.0, 0.0]),
        )
        self.floating_places: tuple[int, int] | None = None
        if body.is_floating_base_body() and body.has_quaternion_dofs():
            # [q; v] holds (wxyz, p_WB) and (w_WB, v_WB). Much cheaper than the poses of all bodies.
            velocity = plant.num_positions() + body.floating_velocities_start_in_v()
            self.floating_places = body.floating_positions_start(), velocity
            self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        else:
            self._poses_port = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
            self._velocities_port = self.DeclareAbstractInputPort(
                "body_spatial_velocities", Value[list[SpatialVelocity]]()
            )

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        return self._sample_into(self.memory.mutable_array(state), context)

    def _sample_into(self, memory: NDArray[np.float64], context: Context) -> NDArray[np.float64]:
        """Return the measurement; ``memory`` belongs to the last sample, and is overwritten for this one."""
        orientation, velocity = self.floating_places or (0, 4)
        return sample(
            self._motion(context),
            orientation=orientation,
            velocity=velocity,
            mount=self.settings.array(context),
            g_W=self.gravity,
            memory=memory,
            period=self.period,
        )

    def resume(self, context: Context, y: NDArray[np.float64]) -> None:
        """Go on as `SampledSensor.resume` does; the motion up to now is one that was measured as ``y``.

        Args:
            context: The sensor's own context, which is changed.
            y: The last measurement, [angular velocity (rad/s), specific force (m/s^2)] in F, shape (6,).
        """
        super().resume(context, y)
        now = context.get_time()
        # The time since the last sample; what is due now has not been sampled yet.
        elapsed = now - (ceil(now / self.period - 1e-6) - 1.0) * self.period
        memory = self.memory.mutable(context.get_mutable_discrete_state())
        memory.sampled = 0.0
        self._sample_into(np.asarray(memory), context)
        R_WF = RotationMatrix(Quaternion(memory.last_orientation))
        turn = elapsed * y[:3]
        angle = float(np.linalg.norm(turn))
        if angle > LEAST_TURN:
            memory.last_orientation = (R_WF @ RotationMatrix(AngleAxis(-angle, turn / angle))).ToQuaternion().wxyz()
            R_WF = R_WF @ RotationMatrix(AngleAxis(-angle / 2.0, turn / angle))
        memory.last_velocity -= elapsed * (R_WF @ y[3:] + self.gravity)

    def _motion(self, context: Context) -> NDArray[np.float64]:
        """Return numbers that hold q_WB and V_WB."""
        if self.floating_places is not None:
            x: NDArray[np.float64] = self._state_port.Eval(context)
            return x
        q_WB = self._poses_port.Eval(context)[self.body].rotation().ToQuaternion().wxyz()
        return np.concatenate([q_WB, self._velocities_port.Eval(context)[self.body].get_coeffs()])
