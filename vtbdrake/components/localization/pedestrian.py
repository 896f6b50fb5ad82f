"""Dead reckoning on foot: the speed of a walker by steps that an IMU shows, and how it drifts.

A body that walks rises and falls once per step. So the specific force of a unit that is worn or held swings once per
step about the weight, and the more, the longer the steps are (Weinberg, "Using the ADXL202 in pedometer and personal
navigation applications", Analog Devices AN-602, 2002): with the largest and the least magnitude of the specific force
within a step,

    step length = K (f_max - f_min)^(1/4).

The `Pedometer` gives the speed in place of wheels; a `DeadReckoning` takes it, with heading, roll and pitch by the
gyros and accelerometers of the same IMU.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, inf, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.arrays import Array
from vtbdrake.common.settings import setting
from vtbdrake.components.localization.dead_reckoning import MOTION, DriftModel
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.declarations import NamedView

# Readings of at least this size, in rad/s or m/s^2, are faults.
_LARGEST = 1e3
# The largest number of steps per second is the inverse of this time in s: what swings faster is no step.
_SHORTEST_STEP = 0.3
# After this time in s without a step, the walker stands.
_LONGEST_STEP = 1.0
# A walker stands who has not swung for this time in s.
_STILL = 0.5


@dataclass(frozen=True)
class PedestrianDriftModel(DriftModel):
    """The drift of dead reckoning on foot, which takes the walker to move along the x axis of the unit.

    Lengths of single steps vary, the body sways to the sides, and a unit in the hand does not point along the path: it
    points aside for seconds, and the error grows sideways. The error that all steps have in common is not part of this
    model: a `Tracker` estimates it (``odometry_deviation``). ``along`` and ``across`` are calibrated with the simulated
    worker of `vtbdrake_diagrams.forest`.
    """

    along: float = setting(0.08, "Standard deviation along the path.", unit="m/sqrt(m)", ge=0)
    across: float = setting(0.12, "Standard deviation sideways, by the sway and the pointing.", unit="m/sqrt(m)", ge=0)
    heading: float = setting(0.002, "Standard deviation of the heading.", unit="rad/sqrt(s)", ge=0)
    unseen: float = setting(
        0.1, "Standard deviation of motion that no step shows, as the first step, per axis.", unit="m/sqrt(s)", ge=0
    )

    def covariance(self, motion: ArrayLike, duration: float) -> Array:
        """Return the covariance (3, 3) of a motion, see `DriftModel.covariance`, with the motion that no step shows.

        Args:
            motion: The motion X_AB = [x, y, heading], (3,) in m and rad, assumed to follow an arc.
            duration: The duration of the motion in s.
        """
        return super().covariance(motion, duration) + np.diag([1.0, 1.0, 0.0]) * self.unseen**2 * duration


class Pedometer(AddressedSystem):
    r"""The speed of a walker from the steps that an IMU shows.

    .. pydrake_system::

        name: Pedometer
        input_ports:
        - imu
        - motion
        output_ports:
        - odometry

    ``imu`` is [angular velocity (rad/s); specific force (m/s^2)] of a unit that is worn or held, ``motion`` the port of
    a `DeadReckoning`, for roll and pitch.

    *Steps.* Only the magnitude f of the specific force is used, less its mean over ``mean_time`` and smoothed over
    ``smoothing`` (time constants in s). A step is counted when it rises above ``threshold`` after it has been below
    -``threshold``, 0.3 s after the last one at least. Its length is ``gain`` (f_max - f_min)^(1/4), see the module, and
    its duration the time since the step before. The quotient is the speed by steps, u. It is 0 when there has been no
    step for a second. At the first step, and when the force has swung by half of ``threshold`` within half a second
    before it, u is unknown, and taken to be the present speed.

    *Between steps.* The speed v in ``odometry`` (m/s, along x of H) follows the levelled acceleration a along x, and u
    with the time constant ``blending`` (s):

        v <- v + T a + T / blending (u - v).

    So a walk is noticed when it begins, before its first step is counted, and the speed follows the surge of each step.

    A sample with a number that is not finite, or with one of 1,000 or more, is left out and counted in ``ignored``.
    State: ``speed``, the number of ``steps``, and what the filter remembers.
    """

    def __init__(self, *, period: float) -> None:
        """Declare the system.

        Args:
            period: Sample period of the IMU in s.

        Raises:
            ValueError: The period is not positive.
        """
        super().__init__()
        if not 0.0 < period < inf:
            raise ValueError(f"Pedometer: the period is positive, in s, not {period!r}")
        self._period = period
        self._imu = self.DeclareVectorInputPort("imu", 6)
        self._motion = self.DeclareVectorInputPort("motion", MOTION.size)
        self._speed = self.declare_discrete_state(speed=Quantity(0.0, "m/s"))
        self._memory = self.declare_discrete_state(
            samples=Quantity(bounds=(0.0, inf)),
            ignored=Quantity(bounds=(0.0, inf)),
            steps=Quantity(bounds=(0.0, inf)),
            mean=Quantity(0.0, "m/s^2"),
            swing=Quantity(0.0, "m/s^2"),
            largest=Quantity(0.0, "m/s^2"),
            least=Quantity(0.0, "m/s^2"),
            was_below=Quantity(0.0, bounds=(0.0, 1.0)),
            since_step=Quantity(_LONGEST_STEP, "s", (0.0, inf)),
            since_swing=Quantity(_STILL, "s", (0.0, inf)),
            is_first=Quantity(0.0, bounds=(0.0, 1.0)),
            step_speed=Quantity(0.0, "m/s"),
        )
        self._settings = self.declare_parameters(
            gain=Quantity(0.43, "m^(3/4) s^(1/2)", (0.0, 10.0)),
            threshold=Quantity(0.5, "m/s^2", (0.0, 10.0)),
            mean_time=Quantity(2.0, "s", (0.1, 60.0)),
            smoothing=Quantity(0.04, "s", (0.0, 1.0)),
            blending=Quantity(0.7, "s", (0.1, 60.0)),
        )
        self.DeclareStateOutputPort("odometry", self._speed.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        memory, settings, T = self._memory.mutable(state), self._settings.view(context), self._period
        sample = self._imu.Eval(context).tolist()
        memory.since_step += T
        ahead = 0.0
        if all(abs(number) < _LARGEST for number in sample):
            self._count(memory, sqrt(sum(f * f for f in sample[3:])), settings)
            motion = MOTION.view(self._motion.Eval(context))
            fx, fy, fz = sample[3:]
            ahead = cos(motion.pitch) * fx + sin(motion.pitch) * (sin(motion.roll) * fy + cos(motion.roll) * fz)
        else:
            memory.ignored += 1.0
        speed = self._speed.mutable(state)
        if memory.since_step >= _LONGEST_STEP:
            memory.step_speed = 0.0 if memory.since_swing > _STILL else speed.speed
        elif memory.is_first:
            memory.step_speed = speed.speed
        if memory.since_swing > _STILL:
            memory.largest = memory.least = 0.0
        speed.speed += T * (ahead + (memory.step_speed - speed.speed) / settings.blending)

    def _count(self, memory: NamedView, force: float, settings: NamedView) -> None:
        """Bring the memory to what it is after a specific force of this magnitude, in m/s^2."""
        T = self._period
        # At first the mean over what there was so far.
        memory.mean += max(T / settings.mean_time, 1.0 / (memory.samples + 1.0)) * (force - memory.mean)
        memory.swing += T / (T + settings.smoothing) * (force - memory.mean - memory.swing)
        memory.samples += 1.0
        memory.largest, memory.least = max(memory.largest, memory.swing), min(memory.least, memory.swing)
        memory.since_swing = 0.0 if abs(memory.swing) > 0.5 * settings.threshold else memory.since_swing + T
        memory.was_below = float(memory.was_below or memory.swing < -settings.threshold)
        if memory.was_below and memory.swing > settings.threshold and memory.since_step > _SHORTEST_STEP:
            memory.is_first = float(memory.since_step >= _LONGEST_STEP)
            memory.step_speed = settings.gain * (memory.largest - memory.least) ** 0.25 / memory.since_step
            memory.steps += 1.0
            memory.since_step = memory.was_below = 0.0
            memory.largest = memory.least = memory.swing
