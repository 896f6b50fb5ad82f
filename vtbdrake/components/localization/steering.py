"""Dead reckoning of a car-like carrier from speed and steering angle, without gyros.

See `vtbdrake.components.localization.dead_reckoning` for the frames; Bo is the middle of the axle that is not
steered, and B stays level.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.settings import check_settings, setting
from vtbdrake.components.localization.dead_reckoning import MOTION, POSE, history_at_start
from vtbdrake.components.localization.planar import Numbers, chord, compose
from vtbdrake.state import AddressedSystem, Quantity

# Speeds of at least this size are faults, in m/s.
_LARGEST_SPEED = 1e3
# Larger angles of the steered wheels are faults, in rad.
_LARGEST_ANGLE = 1.4


@dataclass
class SteeringConfig:
    """The geometry of a car with steered front wheels, and the calibration of its sensors."""

    wheel_base: float = setting(2.83, "Distance of the axles.", unit="m", gt=0)
    wheel_offset: float = setting(
        0.0, "How far left of the middle of the axle the wheel is whose speed is measured.", unit="m"
    )
    speed_scale: float = setting(1.0, "True over measured speed.", gt=0)
    steering_scale: float = setting(1.0, "Change of the true over the change of the measured angle.", gt=0)
    steering_offset: float = setting(0.0, "The true angle where 0 is measured.", unit="rad")

    def __post_init__(self) -> None:
        check_settings(self)


def bicycle_motion(
    speed: Numbers, angle: Numbers, *, wheel_base: float, wheel_offset: float = 0.0
) -> tuple[Numbers, Numbers]:
    r"""Return the speed of the middle of the axle that is not steered (m/s), and the turn rate (rad/s).

    .. math:: v = \frac{v_m}{1 - d \tan(\alpha) / l}, \qquad \dot\theta = v \tan(\alpha) / l

    with the speed v_m of a wheel at the distance d left of the middle, the wheel base l and the mean angle alpha of the
    steered wheels.

    Args:
        speed: The speed v_m in m/s, positive forwards; one or an array.
        angle: The angle alpha in rad, positive to the left.
        wheel_base: The wheel base l in m.
        wheel_offset: The distance d in m.
    """
    curvature = np.tan(angle) / wheel_base
    v = speed / (1.0 - wheel_offset * curvature)
    return v, v * curvature


class SteeringReckoning(AddressedSystem):
    """The path in the plane from the speed of a wheel and the steering angle.

    .. pydrake_system::

        name: SteeringReckoning
        input_ports:
        - odometry
        output_ports:
        - motion
        - history

    ``odometry`` is [speed (m/s), steering angle (rad)], sampled one period ago, see `SteeringConfig`. The outputs are
    as in a `DeadReckoning`, with roll and pitch 0: ``motion`` is laid out as `MOTION`, ``history`` as rows of
    `CarrierPose`, newest first. Between two samples, the carrier moves on an arc with the mean of their speeds and turn
    rates.

    A sample with a speed of 1,000 m/s or more, with an angle beyond 1.4 rad, or with a number that is not finite, is
    left out and counted in ``ignored``: speed and turn rate keep their values.
    """

    def __init__(self, *, period: float, config: SteeringConfig | None = None) -> None:
        """Declare the system.

        Args:
            period: Sample period in s.
            config: The initial values of the parameters, which have its names.

        Raises:
            ValueError: The period is not positive.
        """
        super().__init__()
        if not 0.0 < period < inf:
            raise ValueError(f"SteeringReckoning: the period is positive, in s, not {period!r}")
        config = config or SteeringConfig()
        self._period = period
        self._odometry = self.DeclareVectorInputPort("odometry", 2)
        self._motion = self.declare_discrete_state(**{**MOTION.quantities, "time": Quantity(-period, "s")})
        self._history = self.declare_discrete_state(history=Quantity(history_at_start(period), "s, rad, m"))
        count = Quantity(bounds=(0.0, inf))
        self._counts = self.declare_discrete_state(samples=count, ignored=count)
        for port, group in (("motion", self._motion), ("history", self._history)):
            self.DeclareStateOutputPort(port, group.index)
        self._settings = self.declare_parameters(
            wheel_base=Quantity(config.wheel_base, "m", (0.1, 100.0)),
            wheel_offset=Quantity(config.wheel_offset, "m", (-10.0, 10.0)),
            speed_scale=Quantity(config.speed_scale, bounds=(0.1, 10.0)),
            steering_scale=Quantity(config.steering_scale, bounds=(0.1, 10.0)),
            steering_offset=Quantity(config.steering_offset, "rad", (-1.0, 1.0)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        motion, past, counts = self._motion.mutable(state), self._history.array(context), self._counts.mutable(state)
        settings = self._settings.view(context)
        speed, steering = self._odometry.Eval(context).tolist()
        T, now = self._period, context.get_time() - self._period
        # The first sample belongs to an interval before the start.
        if now > -T / 2.0:
            v_before, rate_before = motion.speed, motion.turn_rate
            angle = settings.steering_scale * steering + settings.steering_offset
            if abs(speed) < _LARGEST_SPEED and abs(angle) < _LARGEST_ANGLE:
                motion.speed, motion.turn_rate = bicycle_motion(
                    settings.speed_scale * speed,
                    angle,
                    wheel_base=settings.wheel_base,
                    wheel_offset=settings.wheel_offset,
                )
                if not counts.samples:  # How fast the carrier was before the first sample is not known.
                    v_before, rate_before = motion.speed, motion.turn_rate
                counts.samples += 1.0
            else:
                counts.ignored += 1.0
            turned = T * (rate_before + motion.turn_rate) / 2.0
            moved = chord(T * (v_before + motion.speed) / 2.0, turned)
            x, y, _ = compose([*motion.position.tolist(), motion.heading], moved).tolist()
            motion.position, motion.heading = (x, y), motion.heading + turned
        motion.time = now
        pose = self._motion.mutable_array(state)[:POSE]
        self._history.mutable_array(state)[:] = np.concatenate((pose, past[:-POSE]))
