"""The perceived environment of the robot: its pose, estimated from its own sensors."""

from __future__ import annotations

from math import pi

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from vtbdrake.state import discrete_state, parameter
from vtbdrake.state.declarations import NO_DICT
from vtbdrake_diagrams.space_climber.kinematics import LegKinematics
from vtbdrake_diagrams.space_climber.morphology import LEGS, Morphology
from vtbdrake_diagrams.space_climber.pose_filter import PoseFilter


class PerceivedEnvironment(LeafSystem):
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
    displacement. The height is that of the torso's centre over the ground under the feet, on average.
    """

    __slots__ = NO_DICT

    def __init__(self, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._filter = PoseFilter(LegKinematics(morphology), foot_radius=morphology.foot_radius, period=period)
        legs = len(LEGS)
        self._measurements = self.DeclareVectorInputPort("measurements", 6 + 4 * legs)
        pose = self.DeclareDiscreteState(np.array([0.0, 0.0, 0.0, 0.0, 0.0, morphology.torso_clearance]))
        self.DeclareStateOutputPort("pose", pose)
        self.DeclareDiscreteState(1 + 3 * legs)
        self.DeclareNumericParameter(BasicVector([2.0]))
        self.variables = (
            *(
                discrete_state(name, 0, start=k, unit="rad", bounds=(-pi, pi))
                for k, name in enumerate(("roll", "pitch", "yaw"))
            ),
            discrete_state("position", 0, start=3, shape=(3,), unit="m"),
            discrete_state("attitude_known", 1, start=0, bounds=(0.0, 1.0)),
            discrete_state("standing", 1, start=1, shape=(legs,), bounds=(0.0, 1.0)),
            discrete_state("feet", 1, start=1 + legs, shape=(legs, 2), unit="m"),
            parameter("time_constant", 0, unit="s", bounds=(0.0, 1e3)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        self._filter.step(
            context.get_numeric_parameter(0)[0],
            self._measurements.Eval(context),
            state.get_mutable_value(0),
            state.get_mutable_value(1),
        )
