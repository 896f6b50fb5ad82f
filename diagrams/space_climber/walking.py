"""The walking controller: posture feedback and the gait generator."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from diagrams.space_climber.estimation import wrap
from diagrams.space_climber.gait import Gait, advance, heights
from diagrams.space_climber.kinematics import LegKinematics
from diagrams.space_climber.morphology import LEGS, Morphology
from vtbdrake.state import discrete_state, parameter


class Posture(LeafSystem):
    """Levels the torso: an integrator with a limit.

    .. pydrake_system::

        name: Posture
        input_ports:
        - attitude
        output_ports:
        - lean

    ``lean`` is (roll, pitch), by which the torso is to be turned back over its feet; it grows with
    ``gain * (roll, pitch)`` of the estimated ``attitude`` within +- ``limit``, and is the state of the last sample.
    """

    def __init__(self, *, period: float) -> None:
        super().__init__()
        self._period = period
        self._attitude = self.DeclareVectorInputPort("attitude", 3)
        lean = self.DeclareDiscreteState(2)
        self.DeclareStateOutputPort("lean", lean)
        gains = int(self.DeclareNumericParameter(BasicVector([1.0, 0.15])))
        self.variables = (
            discrete_state("roll", lean, start=0, unit="rad"),
            discrete_state("pitch", lean, start=1, unit="rad"),
            parameter("gain", gains, start=0, unit="1/s", bounds=(0.0, 10.0)),
            parameter("limit", gains, start=1, unit="rad", bounds=(0.0, 0.5)),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        gain, limit = context.get_numeric_parameter(0).value().tolist()
        roll, pitch, _ = self._attitude.Eval(context).tolist()
        lean_roll, lean_pitch = context.get_discrete_state(0).value().tolist()
        gain *= self._period
        state.set_value(0, (clamp(lean_roll + gain * roll, limit), clamp(lean_pitch + gain * pitch, limit)))


class GaitGenerator(LeafSystem):
    """Turns a walk command and a heading into joint positions.

    .. pydrake_system::

        name: GaitGenerator
        input_ports:
        - attitude
        - lean
        - heading
        - walk
        output_ports:
        - joint_position

    ``walk`` in [0, 1] scales stroke, clearance and turning; it is followed at the rate 1 / ``ramp_time``, so that the
    robot starts and stops smoothly, and standing is a walk of 0 with a phase that rests. The robot walks along its
    own x axis and turns at the rate ``heading_gain * (heading - yaw)`` within +- ``yaw_rate_limit``. ``lean`` tilts the plane of
    the feet's heights. ``joint_position`` follows from the state, ``lean`` and the parameters by inverse kinematics.
    """

    def __init__(self, gait: Gait, *, period: float, morphology: Morphology) -> None:
        super().__init__()
        self._gait = gait
        self._period = period
        self._foot_radius = morphology.foot_radius
        self._legs = LegKinematics(morphology)
        self._nominal: list[tuple[float, float]] = [(x, y) for x, y, _ in morphology.stance.tolist()]
        self._attitude = self.DeclareVectorInputPort("attitude", 3)
        self._lean = self.DeclareVectorInputPort("lean", 2)
        self._heading = self.DeclareVectorInputPort("heading", 1)
        self._walk = self.DeclareVectorInputPort("walk", 1)
        cycle = self.DeclareDiscreteState(2)
        feet = self.DeclareDiscreteState(morphology.stance[:, :2].ravel())
        defaults = {
            "period": (2.0, "s", (0.2, 60.0)),
            "stroke": (0.2, "m", (0.0, 0.3)),
            "clearance": (0.05, "m", (0.0, 0.15)),
            "height": (morphology.torso_clearance, "m", (0.1, 0.35)),
            "ramp_time": (1.0, "s", (0.02, 60.0)),
            "heading_gain": (0.5, "1/s", (0.0, 10.0)),
            "yaw_rate_limit": (0.15, "rad/s", (0.0, 1.0)),
        }
        gains = int(self.DeclareNumericParameter(BasicVector([value for value, _, _ in defaults.values()])))
        self.variables = (
            discrete_state("phase", cycle, start=0, unit="cycle", bounds=(0.0, 1.0)),
            discrete_state("walk_level", cycle, start=1, bounds=(0.0, 1.0)),
            discrete_state("feet", feet, shape=(len(LEGS), 2), unit="m"),
            *(
                parameter(name, gains, start=k, unit=unit, bounds=bounds)
                for k, (name, (_, unit, bounds)) in enumerate(defaults.items())
            ),
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareVectorOutputPort(
            "joint_position",
            3 * len(LEGS),
            self._joint_position,
            prerequisites_of_calc={self.xd_ticket(), self.all_parameters_ticket(), self._lean.ticket()},
        )

    def _update(self, context: Context, state: DiscreteValues) -> None:
        period, stroke, _, _, ramp_time, heading_gain, yaw_rate_limit = (
            context.get_numeric_parameter(0).value().tolist()
        )
        phase, level = context.get_discrete_state(0).value().tolist()
        change = self._period / ramp_time
        walk = min(max(float(self._walk.Eval(context)[0]), 0.0), 1.0)
        level += clamp(walk - level, change)
        if level == 0.0:
            return
        yaw = float(self._attitude.Eval(context)[2])
        heading = float(self._heading.Eval(context)[0])
        turn = clamp(heading_gain * wrap(heading - yaw), yaw_rate_limit)
        next_phase = phase + self._period / period
        scale = level * self._period
        feet = advance(
            self._gait,
            context.get_discrete_state(1).value().tolist(),
            nominal=self._nominal,
            phase=phase,
            next_phase=next_phase,
            step=(scale * self._gait.speed(stroke=stroke, period=period), 0.0, scale * turn),
            stance_steps=self._gait.duty * period / self._period,
        )
        state.set_value(0, (next_phase % 1.0, level))
        state.set_value(1, feet)

    def _joint_position(self, context: Context, output: BasicVector) -> None:
        _, _, clearance, height, _, _, _ = context.get_numeric_parameter(0).value().tolist()
        phase, level = context.get_discrete_state(0).value().tolist()
        feet = context.get_discrete_state(1).value().tolist()
        roll, pitch = self._lean.Eval(context).tolist()
        ground = self._foot_radius - height
        clearance *= level
        points = [
            (x, y, ground + clearance * up - pitch * x + roll * y)
            for x, y, up in zip(feet[::2], feet[1::2], heights(self._gait, phase), strict=True)
        ]
        output.SetFromVector(self._legs.angles(points))


def clamp(value: float, limit: float) -> float:
    """``value`` within +- ``limit``."""
    return limit if value > limit else (-limit if value < -limit else value)
