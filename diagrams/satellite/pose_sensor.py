"""A simulated pose sensor, which stands for camera, scanner and their perception where those need not be simulated."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.components.perception.estimate import PoseEstimate
from vtbdrake.components.perception.target_tracker import pose_of_state
from vtbdrake.components.sensors import ErrorModel
from vtbdrake.components.sensors.sampled import SampledSensor
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.satellite.estimation import HISTORY, POSE, pose_at

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import RigidBody


class PoseSensor(SampledSensor):
    """Measures the pose X_BT of a floating body T against a floating body B.

    .. pydrake_system::

        name: PoseSensor
        input_ports:
        - state
        output_ports:
        - target_pose

    ``state`` is the plant's [q; v]; ``target_pose`` is [quaternion wxyz, of either sign; position (m)]. The white noise
    of its `ErrorModel` is added to each of the seven numbers, so that a noise of s is one of s m in the position and,
    as the quaternion's vector is half the angle, of 2 s rad in the orientation. The quaternion is then not of length 1.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        base: RigidBody,
        target: RigidBody,
        *,
        period: float,
        errors: ErrorModel | None = None,
    ) -> None:
        self._starts = base.floating_positions_start(), target.floating_positions_start()
        q0 = plant.GetDefaultPositions()
        super().__init__(
            "target_pose",
            default=self._relative(q0),
            period=period,
            unit="1, 1, 1, 1, m, m, m",
            noise={"orientation_noise": (4, "1"), "position_noise": (3, "m")},
            errors=errors,
        )
        self._state_port = self.DeclareVectorInputPort("state", plant.num_multibody_states())

    def _relative(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        X_WB, X_WT = (pose_of_state(x[start : start + 7]) for start in self._starts)
        X_BT = X_WB.InvertAndCompose(X_WT)
        return np.concatenate((X_BT.rotation().ToQuaternion().wxyz(), X_BT.translation()))

    def _measure(self, context: Context, state: DiscreteValues) -> NDArray[np.float64]:
        return self._relative(self._state_port.Eval(context))


# The covariance of poses with a deviation of 1 m: an error of 1 m is one of 2 rad, see `PoseSensor`.
_COVARIANCE = np.diag([4.0, 4.0, 4.0, 1.0, 1.0, 1.0])
_NOTHING = PoseEstimate.missing()


class PoseReader(AddressedSystem):
    """The data processing of a `PoseSensor`: it relates each pose to the inertial frame I of the base's navigation.

    .. pydrake_system::

        name: PoseReader
        input_ports:
        - target_pose
        - history
        output_ports:
        - estimate

    ``history`` comes from a `BaseEstimator`; ``estimate`` is a PoseEstimate of X_IT. A pose that arrives was measured
    one period of the DPS before, plus the parameter ``latency`` (s), whenever the sensor samples. It waits for a
    period, in which the history reaches that time, and then shows an estimate; else none is shown. A pose that equals
    the last one in all digits is taken for one that did not arrive: sensors have noise.
    """

    def __init__(self, *, period: float, latency: float = 0.0, deviation: float = 0.01) -> None:
        """Declare the system.

        Args:
            period: The period of the DPS, in s.
            latency: The age of the sensor's samples when they are shown, in s.
            deviation: The standard deviation of its poses that is assumed, in m, and in rad twice as much.
        """
        super().__init__()
        self._period = period
        self._pose = self.DeclareVectorInputPort("target_pose", 7)
        self._history = self.DeclareVectorInputPort("history", HISTORY * POSE)
        self._last = self.declare_discrete_state(
            last_pose=Quantity(np.zeros(7), "1, 1, 1, 1, m, m, m"),
            last_time=Quantity(0.0, "s"),
            waiting=Quantity(0.0, bounds=(0.0, 1.0)),
        )
        self._settings = self.declare_parameters(
            latency=Quantity(latency, "s", (0.0, 1.0)), deviation=Quantity(deviation, "m", (0.0, 10.0))
        )
        self.DeclareAbstractOutputPort(
            "estimate",
            lambda: Value(PoseEstimate.missing()),
            self._calc,
            prerequisites_of_calc={self.xd_ticket(), self.pn_ticket(), self._history.ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _calc(self, context: Context, output: AbstractValue) -> None:
        last = self._last.view(context)
        if not last.waiting:
            output.set_value(_NOTHING)
            return
        X_IB: RigidTransform = pose_at(self._history.Eval(context), last.last_time)
        covariance = self._settings.view(context).deviation ** 2 * _COVARIANCE
        output.set_value(PoseEstimate.of(X_IB @ pose_of_state(last.last_pose), covariance, time=last.last_time))

    def _update(self, context: Context, state: DiscreteValues) -> None:
        last, pose = self._last.mutable(state), self._pose.Eval(context)
        last.waiting = 0.0
        if pose.tolist() == last.last_pose.tolist():
            return
        taken = context.get_time() - self._period - self._settings.view(context).latency
        # Nothing was measured before the start; times are rounded.
        if taken > -0.5 * self._period:
            last.last_pose, last.last_time, last.waiting = pose, max(taken, 0.0), 1.0
