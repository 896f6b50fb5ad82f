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
from math import inf, sqrt

from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.settings import setting
from vtbdrake.components.localization.dead_reckoning import DriftModel
from vtbdrake.state import AddressedSystem, Quantity

# Readings of at least this size, in rad/s or m/s^2, are faults.
_LARGEST = 1e3
# The largest number of steps per second is the inverse of this time in s: what swings faster is no step.
_SHORTEST_STEP = 0.3
# After this time in s without a step, the walker stands.
_LONGEST_STEP = 1.0
# The time in s that a first step is taken to last, as nothing shows when it began.
_FIRST_STEP = 0.55


@dataclass(frozen=True)
class PedestrianDriftModel(DriftModel):
    """The drift of dead reckoning on foot, which takes the walker to move along the x axis of the unit.

    Lengths of single steps vary, the body sways to the sides, and a unit in the hand does not point along the path: it
    points aside for seconds, and the error grows sideways. The error that all steps have in common is not part of this
    model: a `Tracker` estimates it (``odometry_deviation``). ``along`` and ``across`` are calibrated with the simulated
    worker of `vtbdrake_diagrams.forest`.
    """

    along: float = setting(0.06, "Standard deviation along the path.", unit="m/sqrt(m)", ge=0)
    across: float = setting(0.12, "Standard deviation sideways, by the sway and the pointing.", unit="m/sqrt(m)", ge=0)
    heading: float = setting(0.002, "Standard deviation of the heading.", unit="rad/sqrt(s)", ge=0)


class Pedometer(AddressedSystem):
    r"""The speed of a walker from the steps that an IMU shows.

    .. pydrake_system::

        name: Pedometer
        input_ports:
        - imu
        output_ports:
        - odometry

    ``imu`` is [angular velocity (rad/s); specific force (m/s^2)] of a unit that is worn or held, in any orientation:
    only the magnitude f of the specific force is used, less its mean over ``mean_time`` and smoothed over ``smoothing``
    (time constants in s). A step is counted when it rises above ``threshold`` after it has been below -``threshold``,
    0.3 s after the last one at least. Its length is ``gain`` (f_max - f_min)^(1/4), see the module, and its duration
    the time since the step before, 0.55 s if the walker stood. ``odometry`` is the quotient (m/s), smoothed over
    ``speed_smoothing``; it goes to 0 when there has been no step for a second. So it begins one step late, and ends one
    second late.

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
            step_speed=Quantity(0.0, "m/s"),
        )
        self._settings = self.declare_parameters(
            gain=Quantity(0.43, "m^(3/4) s^(1/2)", (0.0, 10.0)),
            threshold=Quantity(0.5, "m/s^2", (0.0, 10.0)),
            mean_time=Quantity(2.0, "s", (0.1, 60.0)),
            smoothing=Quantity(0.04, "s", (0.0, 1.0)),
            speed_smoothing=Quantity(0.3, "s", (0.0, 10.0)),
        )
        self.DeclareStateOutputPort("odometry", self._speed.index)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        memory, settings, T = self._memory.mutable(state), self._settings.view(context), self._period
        sample = self._imu.Eval(context).tolist()
        memory.since_step += T
        if all(abs(number) < _LARGEST for number in sample):
            force = sqrt(sum(f * f for f in sample[3:]))
            # At first the mean over what there was so far.
            memory.mean += max(T / settings.mean_time, 1.0 / (memory.samples + 1.0)) * (force - memory.mean)
            memory.swing += T / (T + settings.smoothing) * (force - memory.mean - memory.swing)
            memory.samples += 1.0
            memory.largest, memory.least = max(memory.largest, memory.swing), min(memory.least, memory.swing)
            memory.was_below = float(memory.was_below or memory.swing < -settings.threshold)
            if memory.was_below and memory.swing > settings.threshold and memory.since_step > _SHORTEST_STEP:
                duration = memory.since_step if memory.since_step < _LONGEST_STEP else _FIRST_STEP
                memory.step_speed = settings.gain * (memory.largest - memory.least) ** 0.25 / duration
                memory.steps += 1.0
                memory.since_step = memory.was_below = 0.0
                memory.largest = memory.least = memory.swing
        else:
            memory.ignored += 1.0
        if memory.since_step >= _LONGEST_STEP:
            memory.step_speed = memory.largest = memory.least = 0.0
        speed = self._speed.mutable(state)
        speed.speed += T / (T + settings.speed_smoothing) * (memory.step_speed - speed.speed)
