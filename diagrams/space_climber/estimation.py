"""The perceived environment of the robot: its pose, estimated from its own sensors."""

from __future__ import annotations

from math import pi

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology
from vtbdrake_diagrams.space_climber.pose_filter import PoseFilter


class PerceivedEnvironment(AddressedSystem):
    r"""An estimator: attitude by a complementary filter, position by leg odometry.

    .. pydrake_system::

        name: PerceivedEnvironment
        input_ports:
        - measurements
        output_ports:
        - pose

    ``measurements`` is [imu (6), joint_encoders (18), foot_contact (6)], ``pose`` is [roll, pitch, yaw, x, y, height],
    the state of the last sample.

    Attitude: R_WB = Rz(yaw) Ry(pitch) Rx(roll), pitch positive nose down. The angles integrate the gyro's w; roll and
    pitch are drawn to the direction of the specific force f with the time constant tau:

        roll_f = atan2(f_y, f_z),   pitch_f = atan2(-f_x, |(f_y, f_z)|)

    Yaw starts where its state starts (0: the robot's own x axis) and drifts with the gyro. The first f that is
    not zero sets roll and pitch.

    Position: feet that are on the ground at two successive samples stand still, so the body moves against their mean
    displacement. The height is the torso's centre's over the ground under the feet, on average.
    """

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._filter = PoseFilter(LegKinematics(morphology), foot_radius=morphology.foot_radius, period=period)
        legs = len(LEGS)
        self._measurements = self.DeclareVectorInputPort("measurements", 6 + 4 * legs)
        angle, flag = Quantity(0.0, "rad", (-pi, pi)), (0.0, 1.0)
        self._pose = self.declare_discrete_state(
            roll=angle, pitch=angle, yaw=angle, position=Quantity([0.0, 0.0, morphology.torso_clearance], "m")
        )
        self.DeclareStateOutputPort("pose", self._pose.index)
        self._memory = self.declare_discrete_state(
            attitude_known=Quantity(0.0, bounds=flag),
            standing=Quantity(np.zeros(legs), bounds=flag),
            feet=Quantity(np.zeros((legs, 2)), "m"),
        )
        self._settings = self.declare_parameters(time_constant=Quantity(2.0, "s", (0.0, 1e3)))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        self._filter.step(
            self._settings.view(context).time_constant,
            self._measurements.Eval(context),
            self._pose.mutable_array(state),
            self._memory.mutable_array(state),
        )
