"""Inertial measurement unit."""

from __future__ import annotations

from math import atan2, cos, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.framework import BasicVector, Context, DiscreteValues

from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor
from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Frame

Vector3 = tuple[float, float, float]
Wxyz = tuple[float, float, float, float]


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

    F starts where ``frame`` is on B. From then on the parameter ``mount``, [x, y, z, roll, pitch, yaw] of F in B, says
    where the sensor sits; moving ``frame`` does not move it.
    """

    __slots__ = NO_DICT

    def __init__(
        self,
        plant: MultibodyPlant,
        frame: Frame,
        *,
        period: float,
        stream: int = 0,
        errors: ErrorModel | None = None,
    ) -> None:
        body = frame.body()
        default_context = plant.CreateDefaultContext()
        self._g_W: Vector3 = tuple(plant.gravity_field().gravity_vector().tolist())
        self._body = int(body.index())
        X_BF = frame.GetFixedPoseInBodyFrame()
        mount = [*X_BF.translation().tolist(), *RollPitchYaw(X_BF.rotation()).vector().tolist()]
        q_WF = tuple(frame.CalcPoseInWorld(default_context).rotation().ToQuaternion().wxyz().tolist())
        super().__init__(
            "imu",
            default=(0.0, 0.0, 0.0, *_rotate_back(q_WF, _negative(self._g_W))),
            period=period,
            unit="rad/s, m/s^2",
            noise={"gyro_noise": (3, "rad/s"), "accelerometer_noise": (3, "m/s^2")},
            stream=stream,
            errors=errors,
        )
        # [number of samples (0 or 1 is all that matters), v_WF, q_WF (wxyz)] at the last sample.
        self._memory = int(self.DeclareDiscreteState(np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])))
        self._mount = int(self.DeclareNumericParameter(BasicVector(mount)))
        self.variables += (
            parameter("mount", self._mount, shape=(6,), unit="m, rad"),
            discrete_state("sampled", self._memory, start=0, bounds=(0.0, 1.0)),
            discrete_state("last_velocity", self._memory, shape=(3,), start=1, unit="m/s"),
            discrete_state("last_orientation", self._memory, shape=(4,), start=4),
        )
        self._floating = body.is_floating_base_body() and body.has_quaternion_dofs()
        if self._floating:
            # [q; v] holds (wxyz, p_WB) and (w_WB, v_WB). Much cheaper than the poses of all bodies.
            start = body.floating_positions_start()
            self._q_slice = slice(start, start + 4)
            start = plant.num_positions() + body.floating_velocities_start_in_v()
            self._v_slice = slice(start, start + 6)
            self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())
        else:
            self._poses_port = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
            self._velocities_port = self.DeclareAbstractInputPort(
                "body_spatial_velocities", Value[list[SpatialVelocity]]()
            )

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        q_WF, v_WF = self._motion(context)
        sampled, *memory = context.get_discrete_state(self._memory).value().tolist()
        state.set_value(self._memory, np.array((1.0, *v_WF, *q_WF)))
        gx, gy, gz = self._g_W
        if not sampled:
            return np.array((0.0, 0.0, 0.0, *_rotate_back(q_WF, (-gx, -gy, -gz))))
        rate = 1.0 / self._period
        f_W = (
            (v_WF[0] - memory[0]) * rate - gx,
            (v_WF[1] - memory[1]) * rate - gy,
            (v_WF[2] - memory[2]) * rate - gz,
        )
        w0, x0, y0, z0 = memory[3:]
        if w0 * q_WF[0] + x0 * q_WF[1] + y0 * q_WF[2] + z0 * q_WF[3] < 0:  # q and -q are the same orientation
            w0, x0, y0, z0 = -w0, -x0, -y0, -z0
        w, x, y, z = _product((w0, -x0, -y0, -z0), q_WF)
        sine = sqrt(x * x + y * y + z * z)
        scale = (2.0 * atan2(sine, w) / sine if sine > 1e-12 else 2.0) * rate
        q_mid = _unit(w0 + q_WF[0], x0 + q_WF[1], y0 + q_WF[2], z0 + q_WF[3])
        return np.array((scale * x, scale * y, scale * z, *_rotate_back(q_mid, f_W)))

    def _motion(self, context: Context) -> tuple[Wxyz, Vector3]:
        """Return q_WF and v_WF."""
        if self._floating:
            x = self._state_port.Eval(context)
            q_WB = _unit(*x[self._q_slice].tolist())
            wx, wy, wz, vx, vy, vz = x[self._v_slice].tolist()
        else:
            q_WB = tuple(self._poses_port.Eval(context)[self._body].rotation().ToQuaternion().wxyz().tolist())
            V_WB = self._velocities_port.Eval(context)[self._body]
            wx, wy, wz = V_WB.rotational().tolist()
            vx, vy, vz = V_WB.translational().tolist()
        x, y, z, *rpy = context.get_numeric_parameter(self._mount).value().tolist()
        if x or y or z:
            px, py, pz = _rotate(q_WB, (x, y, z))
            vx, vy, vz = vx + wy * pz - wz * py, vy + wz * px - wx * pz, vz + wx * py - wy * px
        return (_product(q_WB, _quaternion(*rpy)) if any(rpy) else q_WB), (vx, vy, vz)


# Plain floats: for three and four numbers several times faster than numpy.


def _negative(v: Vector3) -> Vector3:
    return (-v[0], -v[1], -v[2])


def _unit(w: float, x: float, y: float, z: float) -> Wxyz:
    scale = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    return (w * scale, x * scale, y * scale, z * scale)


def _quaternion(roll: float, pitch: float, yaw: float) -> Wxyz:
    """Return the quaternion of Rz(yaw) Ry(pitch) Rx(roll)."""
    qx = (cos(roll / 2), sin(roll / 2), 0.0, 0.0)
    qy = (cos(pitch / 2), 0.0, sin(pitch / 2), 0.0)
    qz = (cos(yaw / 2), 0.0, 0.0, sin(yaw / 2))
    return _product(qz, _product(qy, qx))


def _product(a: Wxyz, b: Wxyz) -> Wxyz:
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _rotate(q: Wxyz, v: Vector3) -> Vector3:
    """Return R v for the unit quaternion q of R."""
    w, x, y, z = q
    vx, vy, vz = v
    tx, ty, tz = 2.0 * (y * vz - z * vy), 2.0 * (z * vx - x * vz), 2.0 * (x * vy - y * vx)
    return (vx + w * tx + y * tz - z * ty, vy + w * ty + z * tx - x * tz, vz + w * tz + x * ty - y * tx)


def _rotate_back(q: Wxyz, v: Vector3) -> Vector3:
    """Return R' v for the unit quaternion q of R."""
    return _rotate((q[0], -q[1], -q[2], -q[3]), v)
