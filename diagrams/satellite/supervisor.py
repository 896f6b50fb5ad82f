"""The supervisor of a capture: a state machine with its modes and the reasons of their changes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from math import exp, hypot
from typing import Any

import casadi
import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.arrays import Array
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.declarations import NamedView
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Servicer, Target
from vtbdrake_diagrams.satellite.relative_motion import RELATIVE, Relative


class Mode(IntEnum):
    """The modes; the variable ``mode`` holds their numbers."""

    WAIT = 0
    APPROACH = 1
    TRACK = 2
    GRIP = 3
    RETREAT = 4
    HOLD = 5
    ABORT = 6

    @property
    def label(self) -> str:
        """Return the name as users read it."""
        return self.name.lower()


class Reason(IntEnum):
    """Why the mode was entered; the variable ``reason`` holds the numbers."""

    label: str

    START = 0, "start"
    TRACKED = 1, "the target is tracked and within reach"
    BEFORE_BAR = 2, "the gripper is before the bar"
    AT_BAR = 3, "the bar is between the fingers"
    GRIPPED = 4, "the fingers hold the bar"
    STOPPED = 5, "the relative motion has stopped"
    MISSED = 6, "the fingers missed the bar, next attempt"
    COMMANDED = 7, "abort commanded"
    LOST = 8, "the target is lost"
    OUT_OF_REACH = 9, "the target is out of reach"
    TOO_FAST = 10, "the target moves too fast"
    TIMEOUT = 11, "out of time"
    MISSED_TOO_OFTEN = 12, "the fingers missed the bar too often"
    SLIPPED = 13, "the bar slipped out"

    def __new__(cls, number: int, label: str) -> Reason:
        """Make a member with its number and what users read."""
        member = int.__new__(cls, number)
        member._value_ = number
        member.label = label
        return member


GO, STAY, STOP = 1.0, 0.0, -1.0
"""Values of the command ``capture``: go ahead, wait, abort."""

# Time constant of the low-pass filter of the arm's positions, in s.
_SMOOTHING = 0.5

GUIDANCE = 6
"""Size of a `Guidance` as a vector."""


@dataclass(frozen=True)
class Guidance:
    """The supervisor's instructions to the controller.

    Attributes:
        mode: One of the modes.
        follows: Whether the gripper is to follow the fixture.
        distance: From the gripper to the fixture, along its z axis, in m.
        rate: The rate of that distance, in m/s.
        opening: Position of each finger, in m.
        flip: Whether to grip with the gripper turned by pi about its z axis.
    """

    mode: float
    follows: bool
    distance: float
    rate: float
    opening: float
    flip: bool

    @staticmethod
    def of(vector: Array) -> Guidance:
        """Return the guidance that is in a vector of shape (`GUIDANCE`,)."""
        mode, follows, distance, rate, opening, flip = vector.tolist()
        return Guidance(mode, follows > 0.5, distance, rate, opening, flip > 0.5)


def stopping_speed(distance: Any, *, gain: Any, acceleration: Any) -> Any:
    r"""Return the speed at a distance from the goal from which the brakes still stop there.

    It is gain d up to d = a / gain^2, and beyond that sqrt(2 a (d - a / (2 gain^2))): a constant deceleration a.

    Args:
        distance: The distance d, not negative; numbers, or expressions of CasADi.
        gain: The rate at which the distance shrinks near the goal, in 1/s.
        acceleration: The deceleration a.
    """
    knee = acceleration / casadi.fmax(gain**2, 1e-12)
    near = casadi.fmin(distance, knee)
    return casadi.sqrt((gain * near) ** 2 + 2.0 * acceleration * (distance - near))


def _all_below(values: Array, limit: float) -> bool:
    """Return whether no value is beyond a limit, in either direction; NaN is."""
    return all(abs(value) < limit for value in values.tolist())


@dataclass
class _Step:
    """A step holds what an update changes: mode, guidance, how long the gripper is steady (s), and attempts."""

    mode: float
    reason: float
    distance: float
    rate: float
    opening: float
    flip: float
    steady: float
    attempts: float


class Supervisor(AddressedSystem):
    """A state machine that leads a capture from sensor data alone.

    .. pydrake_system::

        name: Supervisor
        input_ports:
        - capture
        - relative
        - joint_position
        output_ports:
        - guidance

    ``capture`` is the command: `GO`, `STAY` or `STOP`. ``relative`` is that of `RelativeMotion`. ``acceleration``
    limits how fast ``closing_speed`` is reached and left.

    ========= ============================================ =====================================================
    mode      what happens                                 ends when
    ========= ============================================ =====================================================
    wait      nothing moves                                go, the track is valid, the fixture within reach: approach
    approach  to ``standoff`` before the fixture           there, within the tolerances: track
    track     in along its axis, at ``closing_speed``      at the fixture, within ``grip_tolerance``: grip
    grip      the fingers close                            they hold the bar: retreat; they miss it: approach
    retreat   the arm brakes the relative motion           all joints are slower than ``still_rate``: hold
    hold      nothing moves
    abort     fingers open, the arm backs off
    ========= ============================================ =====================================================

    Approach, track and grip are aborted on command, when there has been no estimate for ``lost_after``, when the
    fixture leaves the reach, when it moves against the base faster than ``largest_speed``, and after ``time_limit``;
    retreat and hold on command, and when the bar slips out. Whether the joints rest is measured by their encoders, for
    ``still_time``: while the fingers hold the bar, nothing else moves. While the newest estimate is older than
    ``hold_after``, all holds.

    The open fingers' lips leave 25 mm of room on each side of the bar. The grip tolerance takes half of it; the other
    half is for what the target does while the fingers close.

    The variables ``mode`` and ``reason`` are numbers: those of `Mode` and `Reason`.
    """

    def __init__(self, *, period: float, acceleration: float) -> None:
        super().__init__()
        self._period = period
        servicer, target = Servicer(), Target()
        self._shoulder = servicer.X_BA @ np.array([0.0, 0.0, servicer.foot + servicer.lengths[0]])
        self._wrist = sum(servicer.lengths[5:]) + servicer.tool
        self._opening = servicer.opening
        self._bar = 2.0 * target.bar_radius
        self._capture = self.DeclareVectorInputPort("capture", 1)
        self._relative = self.DeclareVectorInputPort("relative", RELATIVE)
        self._joints = self.DeclareVectorInputPort("joint_position", len(JOINT_NAMES))
        flag = (0.0, 1.0)
        self._instructions = self.declare_discrete_state(
            mode=Quantity(Mode.WAIT, bounds=(0, Mode.ABORT)),
            follows=Quantity(0.0, bounds=flag),
            distance=Quantity(0.0, "m"),
            rate=Quantity(0.0, "m/s"),
            opening=Quantity(self._opening, "m"),
            flip=Quantity(0.0, bounds=flag),
        )
        self.DeclareStateOutputPort("guidance", self._instructions.index)
        self._memory = self.declare_discrete_state(
            reason=Quantity(Reason.START, bounds=(0, Reason.SLIPPED)),
            time_in_mode=Quantity(0.0, "s"),
            capture_time=Quantity(0.0, "s"),
            steady_for=Quantity(0.0, "s"),
            attempts_made=Quantity(0.0),
            last_fingers=Quantity([self._opening, self._opening], "m"),
        )
        # The arm's positions through a low-pass filter, which are behind by the arm's rates times _SMOOTHING.
        self._smooth = self.declare_discrete_state(smooth_position=Quantity(np.zeros(ARM_JOINTS), "rad"))
        settings = {
            # Value, unit, and the largest value.
            "standoff": (0.25, "m", 2.0),
            "closing_speed": (0.06, "m/s", 0.5),
            "acceleration": (acceleration, "m/s^2", 1e6),  # that is, unlimited
            "position_tolerance": (0.03, "m", 1.0),
            "orientation_tolerance": (0.12, "rad", np.pi),
            "grip_tolerance": (0.012, "m", 0.1),
            "grip_time": (0.2, "s", 60.0),
            "hold_after": (1.0, "s", 60.0),
            "lost_after": (3.0, "s", 600.0),
            "reach": (1.46, "m", 10.0),
            "largest_angle": (1.05, "rad", np.pi),
            "largest_speed": (0.15, "m/s", 1.0),
            "time_limit": (60.0, "s", 3600.0),
            "attempts": (3.0, "1", 100.0),
            "still_rate": (2e-3, "rad/s", 1.0),
            "still_time": (1.0, "s", 60.0),
        }
        self._settings = self.declare_parameters(
            **{name: Quantity(value, unit, (0.0, most)) for name, (value, unit, most) in settings.items()}
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        T = self._period
        p, last, memory = self._settings.view(context), self._instructions.view(context), self._memory.view(context)
        mode = last.mode
        relative = Relative(self._relative.Eval(context))
        joints = self._joints.Eval(context)
        arm, fingers = joints[:ARM_JOINTS], joints[ARM_JOINTS:]
        behind = arm - self._smooth.array(context)
        rests = _all_below(behind, p.still_rate * _SMOOTHING)
        go = float(self._capture.Eval(context)[0])
        still = _all_below(fingers - memory.last_fingers, 5e-4 * T / 0.02)
        holds = 0.6 * self._bar < sum(fingers.tolist()) < 1.4 * self._bar
        in_mode, since = memory.time_in_mode + T, memory.capture_time + T if mode != Mode.WAIT else 0.0

        step = _Step(
            mode=mode,
            reason=memory.reason,
            distance=last.distance,
            rate=0.0,
            opening=last.opening,
            flip=last.flip,
            steady=memory.steady_for,
            attempts=memory.attempts_made,
        )
        trouble = self._trouble(mode, go, relative, since, p)
        fresh = relative.age < p.hold_after
        if trouble is not None:
            step.mode, step.reason = Mode.ABORT, trouble
        elif mode == Mode.WAIT:
            if go > 0.5 and relative.valid and fresh and not self._unreachable(relative, p):
                step.mode, step.reason, step.distance = Mode.APPROACH, Reason.TRACKED, p.standoff
                step.flip = float((relative.R_BH[:, 0] * relative.R_BG[:, 0]).sum() < 0.0)
        elif mode in (Mode.APPROACH, Mode.TRACK) and fresh:
            self._steer(step, relative, last.rate, p)
        elif mode == Mode.GRIP:
            self._grip(step, still, holds, in_mode, p)
        elif mode == Mode.RETREAT and holds and self._lasts(step, rests) > p.still_time:
            step.mode, step.reason = Mode.HOLD, Reason.STOPPED
        elif mode in (Mode.RETREAT, Mode.HOLD) and not holds and still:
            step.mode, step.reason = Mode.ABORT, Reason.SLIPPED
        if step.mode == Mode.ABORT:
            step.opening = self._opening
        if step.mode != mode:
            in_mode = step.steady = 0.0
        follows = step.mode in (Mode.APPROACH, Mode.TRACK, Mode.GRIP) and fresh
        following = self._instructions.mutable(state)
        following.mode, following.follows, following.flip = step.mode, follows, step.flip
        following.distance, following.rate, following.opening = step.distance, step.rate, step.opening
        remembered = self._memory.mutable(state)
        remembered.reason, remembered.time_in_mode, remembered.capture_time = step.reason, in_mode, since
        remembered.steady_for, remembered.attempts_made = step.steady, step.attempts
        remembered.last_fingers = fingers
        self._smooth.mutable(state).smooth_position = arm - behind * exp(-T / _SMOOTHING)

    def _lasts(self, step: _Step, true: bool) -> float:
        """Return for how long something has been true, in s."""
        step.steady = step.steady + self._period if true else 0.0
        return step.steady

    def _steer(self, step: _Step, relative: Relative, rate: float, p: NamedView) -> None:
        """Approach the fixture, or go in along its axis; ``rate`` is that of the last period."""
        T = self._period
        error, angle = relative.errors(step.distance, step.flip)
        close = error < p.position_tolerance and angle < p.orientation_tolerance
        lasts = self._lasts(step, close)
        if step.mode == Mode.APPROACH:
            if lasts > 0.5:
                step.mode, step.reason = Mode.TRACK, Reason.BEFORE_BAR
        elif step.distance > 0.0:
            push = p.acceleration
            goal = min(p.closing_speed, stopping_speed(step.distance, gain=1.0 / T, acceleration=push))
            step.rate = -min(goal, push * T - rate) if close else 0.0
            step.distance += step.rate * T
        else:
            step.steady = lasts if error < p.grip_tolerance else 0.0
            if step.steady > p.grip_time:
                step.mode, step.reason = Mode.GRIP, Reason.AT_BAR

    def _grip(self, step: _Step, still: bool, holds: bool, in_mode: float, p: NamedView) -> None:
        """Close the fingers; ``still`` tells whether they rest, ``holds`` whether the bar is between them."""
        step.opening = 0.0
        if self._lasts(step, still) <= 0.3 or in_mode <= 0.5:
            return
        if holds:
            step.mode, step.reason = Mode.RETREAT, Reason.GRIPPED
        elif step.attempts + 1.0 >= p.attempts:
            step.mode, step.reason = Mode.ABORT, Reason.MISSED_TOO_OFTEN
        else:
            step.mode, step.reason, step.attempts = Mode.APPROACH, Reason.MISSED, step.attempts + 1.0
            step.distance, step.opening = p.standoff, self._opening

    def _trouble(self, mode: float, go: float, relative: Relative, since: float, p: NamedView) -> float:
        """Return the reason for an abort, or None."""
        if mode not in (Mode.APPROACH, Mode.TRACK, Mode.GRIP):
            return Reason.COMMANDED if go < -0.5 and mode in (Mode.RETREAT, Mode.HOLD) else None
        if go < -0.5:
            return Reason.COMMANDED
        if relative.age > p.lost_after or not relative.valid:
            return Reason.LOST
        if self._unreachable(relative, p):
            return Reason.OUT_OF_REACH
        if hypot(*relative.v_BH.tolist()) > p.largest_speed:
            return Reason.TOO_FAST
        return Reason.TIMEOUT if since > p.time_limit else None

    def _unreachable(self, relative: Relative, p: NamedView) -> bool:
        """Return whether the arm cannot bring its wrist behind the fixture, or only from its rear."""
        wrist = relative.p_BH - self._wrist * relative.R_BH[:, 2]
        far = hypot(*(wrist - self._shoulder).tolist()) > p.reach
        return far or relative.R_BH[0, 2] < np.cos(p.largest_angle)
