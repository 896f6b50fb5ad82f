"""The supervisor of a capture: a state machine with its modes and the reasons of their changes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from math import cos, exp, hypot
from typing import Any, NamedTuple

import casadi
import numpy as np
from pydrake.systems.framework import Context, DiscreteValues

from vtbdrake.common.arrays import Array
from vtbdrake.components.casadi_system.kernel import Kernel
from vtbdrake.components.casadi_system.rotations import exponential
from vtbdrake.state import AddressedSystem, Quantity
from vtbdrake.state.declarations import NamedView
from vtbdrake_diagrams.satellite.bodies import ARM_JOINTS, JOINT_NAMES, Servicer, Target
from vtbdrake_diagrams.satellite.estimation import rotated
from vtbdrake_diagrams.satellite.relative_motion import RELATIVE, Relative, gripper_errors


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


class Arrival(IntEnum):
    """The ways in which the arm comes before the bar in the mode approach, as the variable ``arrival`` has them."""

    RATES = 0
    """Resolved rate leads the arm from the start."""
    PLANNING = 1
    """A plan has been asked for; the arm waits for it."""
    PLANNED = 2
    """The arm follows the plan."""
    ARRIVED = 3
    """The plan has ended; resolved rate goes on."""
    REFUSED = 4
    """There is no plan; by resolved rate."""
    DROPPED = 5
    """The target is not where it was predicted, or is not seen: the plan was left, resolved rate goes on."""


PLAN_TIME_OF_NONE = 1e9
"""The beginning of a plan that nobody has made, in s."""

GO = 1.0
"""Value of the command ``capture``: go ahead."""
STAY = 0.0
"""Value of the command ``capture``: wait."""
STOP = -1.0
"""Value of the command ``capture``: abort."""

# With a plan: how long the target is watched before one is asked for, and see `Supervisor`.
_PLAN_SETTINGS = {"watch_time": (2.0, "s", 60.0), "plan_tolerance": (0.15, "m", 10.0)}
# How long the arm stops where a plan is dropped, in s: until the base, too, no longer turns against the target.
_STOPPING = 1.0
# Time constant of the low-pass filter of the arm's positions, in s.
_SMOOTHING = 0.5

GUIDANCE = 6
"""Size of a `Guidance` as a vector."""
PLAN_KNOTS = 9
"""The number of knots of a planned approach."""
PLAN = 1 + PLAN_KNOTS * ARM_JOINTS
"""Size of the plan of an approach: [t_begin (s), knots (rad)], see `SplineCommand`."""


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


class _Situation(NamedTuple):
    """It is what the supervisor knows of target and gripper.

    Attributes:
        age: The age of the newest estimate of the target, in s.
        tracked: 1 if the target is tracked, else 0.
        error: The distance of the gripper from the place where it should be, in m.
        angle: The angle between its orientation and the one that it should have, in rad.
        reach: The distance of the wrist, if the gripper were at the fixture, from the shoulder, in m.
        facing: The cosine of the angle between the fixture's z axis and the base's x axis.
        speed: The speed of the fixture against the base, in m/s.
    """

    age: float
    tracked: float
    error: float
    angle: float
    reach: float
    facing: float
    speed: float


@lru_cache
def _situation() -> Kernel:
    """Return a `_Situation` as a kernel of (relative, guidance)."""
    relative, guidance = casadi.SX.sym("relative", RELATIVE), casadi.SX.sym("guidance", GUIDANCE)
    servicer, (_, _, distance, _, _, flip) = Servicer(), casadi.vertsplit(guidance)
    shoulder = servicer.X_BA @ np.array([0.0, 0.0, servicer.foot + servicer.lengths[0]])
    axis, p_BH, v_BH = relative[4:11:3], relative[11:14], relative[17:20]
    wrist = p_BH - (sum(servicer.lengths[5:]) + servicer.tool) * axis
    lengths = (*gripper_errors(relative, distance, flip), wrist - casadi.DM(shoulder))
    values = casadi.vertcat(relative[:2], *map(casadi.norm_2, lengths), axis[0], casadi.norm_2(v_BH))
    return Kernel("situation", [relative, guidance], values, compile=None)


@lru_cache
def _fixture_later() -> Kernel:
    """Return p_IHo after a time at constant velocities as a kernel of (the state of a `TargetTracker`, the time)."""
    target, later = casadi.SX.sym("target", 13), casadi.SX.sym("later", 1)
    q, p, w, v = casadi.vertsplit(target, [0, 4, 7, 10, 13])
    fixture = exponential(later * w) @ rotated(q, casadi.DM(Target().X_TH.translation()))
    return Kernel("fixture_later", [target, later], casadi.densify(p + later * v + fixture), compile=None)


class Supervisor(AddressedSystem):
    """A state machine that leads a capture from sensor data alone.

    .. pydrake_system::

        name: Supervisor
        input_ports:
        - capture
        - relative
        - joint_position
        - target (only with a plan)
        - plan (only with a plan)
        - fixture (only with a plan)
        - missed (only with a plan)
        output_ports:
        - guidance
        - arrival (only with a plan)
        - request (only with a plan)

    ``capture`` is the command: `GO`, `STAY` or `STOP`. ``relative`` comes from `RelativeMotion`. ``acceleration``
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

    The variables ``mode`` and ``reason`` are numbers of `Mode` and `Reason`.

    With ``plan_duration`` (s), the first approach is planned. When the target has been watched for ``watch_time``, the
    supervisor asks for a plan by ``request``, and the arm waits for it. The answer is ``plan``, whose first number is
    the time at which it begins, and ``fixture``, the place in I where the fixture will then be at its end; or
    ``missed`` counts one more. The arm is on the plan while ``arrival``, an `Arrival`, says so. The plan is dropped
    when the present estimate, a ``target`` that turns at a constant rate, has the fixture farther than
    ``plan_tolerance`` from there at its end, and when the estimate is old; then the arm stops before it goes on.
    """

    def __init__(self, *, period: float, acceleration: float, plan_duration: float | None = None) -> None:
        super().__init__()
        self._plan_duration = plan_duration
        self._period = period
        self._opening, self._bar = Servicer().opening, 2.0 * Target().bar_radius
        self._situation = _situation()
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
        if plan_duration is not None:
            sizes = {"target": 13, "plan": PLAN, "fixture": 3, "missed": 1}
            self._plan_inputs = {name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()}
            self._arrival = self.declare_discrete_state(
                arrival=Quantity(Arrival.RATES, bounds=(0, Arrival.DROPPED)),
            )
            self.DeclareStateOutputPort("arrival", self._arrival.index)
            self._request = self.declare_discrete_state(request=Quantity(0.0, bounds=flag))
            self.DeclareStateOutputPort("request", self._request.index)
            self._stop = self.declare_discrete_state(stopping=Quantity(0.0, "s"))
        self._memory = self.declare_discrete_state(
            reason=Quantity(Reason.START, bounds=(0, Reason.SLIPPED)),
            time_in_mode=Quantity(0.0, "s"),
            capture_time=Quantity(0.0, "s"),
            steady_for=Quantity(0.0, "s"),
            attempts_made=Quantity(0.0),
            last_fingers=Quantity([self._opening, self._opening], "m"),
            # The arm's positions through a low-pass filter, which are behind by the arm's rates times _SMOOTHING.
            smooth_position=Quantity(np.zeros(ARM_JOINTS), "rad"),
        )
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
            **({} if plan_duration is None else _PLAN_SETTINGS),
        }
        self._settings = self.declare_parameters(
            **{name: Quantity(value, unit, (0.0, most)) for name, (value, unit, most) in settings.items()}
        )
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    def _update(self, context: Context, state: DiscreteValues) -> None:
        T, p = self._period, self._settings.view(context)
        instructions, memory = self._instructions.mutable_array(state), self._memory.mutable(state)
        guidance = self._instructions.vector.view(instructions)
        situation = _Situation(*self._situation.value((self._relative.Eval(context), instructions)).tolist())
        go = self._capture.Eval(context).item(0)
        *arm, left, right = self._joints.Eval(context).tolist()
        behind = [now - smooth for now, smooth in zip(arm, memory.smooth_position.tolist(), strict=True)]
        rests = all(abs(angle) < p.still_rate * _SMOOTHING for angle in behind)
        last_left, last_right = memory.last_fingers.tolist()
        still = abs(left - last_left) < 5e-4 * T / 0.02 and abs(right - last_right) < 5e-4 * T / 0.02
        holds = 0.6 * self._bar < left + right < 1.4 * self._bar
        mode, rate, fresh = guidance.mode, guidance.rate, situation.age < p.hold_after
        memory.time_in_mode += T
        memory.capture_time = memory.capture_time + T if mode != Mode.WAIT else 0.0
        guidance.rate = 0.0
        planned = self._plan_duration is not None and self._follow_plan(
            context, state, mode, memory.time_in_mode, fresh, p
        )
        trouble = self._trouble(mode, go, situation, memory.capture_time, p, planned=planned)
        if trouble is not None:
            guidance.mode, memory.reason = Mode.ABORT, trouble
        elif mode == Mode.WAIT:
            if go > 0.5 and situation.tracked > 0.5 and fresh and not self._unreachable(situation, p):
                guidance.mode, memory.reason, guidance.distance = Mode.APPROACH, Reason.TRACKED, p.standoff
                relative = Relative(self._relative.Eval(context))
                guidance.flip = (relative.R_BH[:, 0] * relative.R_BG[:, 0]).sum() < 0.0
        elif mode in (Mode.APPROACH, Mode.TRACK) and fresh and not planned:
            self._steer(guidance, memory, situation, rate, p)
        elif mode == Mode.GRIP:
            self._grip(guidance, memory, still, holds, p)
        elif mode == Mode.RETREAT and holds and self._lasts(memory, rests) > p.still_time:
            guidance.mode, memory.reason = Mode.HOLD, Reason.STOPPED
        elif mode in (Mode.RETREAT, Mode.HOLD) and not holds and still:
            guidance.mode, memory.reason = Mode.ABORT, Reason.SLIPPED
        if guidance.mode == Mode.ABORT:
            guidance.opening = self._opening
        if guidance.mode != mode:
            memory.time_in_mode = memory.steady_for = 0.0
        guidance.follows = guidance.mode in (Mode.APPROACH, Mode.TRACK, Mode.GRIP) and fresh and not planned
        memory.last_fingers = left, right
        decay = exp(-T / _SMOOTHING)
        memory.smooth_position = [now - decay * late for now, late in zip(arm, behind, strict=True)]

    def _follow_plan(
        self, context: Context, state: DiscreteValues, mode: float, time_in_mode: float, fresh: bool, p: NamedView
    ) -> bool:
        """Ask for a plan, or see how it goes on; return whether the arm waits for it, is on it or stops."""
        arrival, request, stop = (each.mutable(state) for each in (self._arrival, self._request, self._stop))
        if mode != Mode.APPROACH:
            if arrival.arrival in (Arrival.PLANNING, Arrival.PLANNED):
                arrival.arrival = Arrival.DROPPED
            return mode == Mode.WAIT  # The approach may begin in this period.
        target, plan, fixture, missed = (port.Eval(context) for port in self._plan_inputs.values())
        now, begin = context.get_time(), plan.item(0)
        if arrival.arrival == Arrival.RATES:
            arrival.arrival = Arrival.PLANNING
        elif arrival.arrival == Arrival.PLANNING and request.request == 0.0:
            # Until its velocities are known well.
            request.request = float(time_in_mode > p.watch_time)
        elif arrival.arrival == Arrival.PLANNING and missed.item(0) > 0.5:
            arrival.arrival = Arrival.REFUSED
        elif arrival.arrival == Arrival.PLANNING and begin < PLAN_TIME_OF_NONE:
            arrival.arrival = Arrival.PLANNED
        elif arrival.arrival == Arrival.PLANNED:
            # What follows the plan shows its own state: it is a period behind.
            left = begin + self._plan_duration + 2.0 * self._period - now
            drift = _fixture_later().value((target, np.array([max(left, 0.0)]))) - fixture
            if left <= 0.0:
                arrival.arrival = Arrival.ARRIVED
            elif not fresh or hypot(*drift.tolist()) > p.plan_tolerance:
                arrival.arrival, stop.stopping = Arrival.DROPPED, _STOPPING
        stop.stopping = max(stop.stopping - self._period, 0.0)
        return arrival.arrival in (Arrival.PLANNING, Arrival.PLANNED) or stop.stopping > 0.0

    def _lasts(self, memory: NamedView, true: bool) -> float:
        """Return for how long something has been true, in s."""
        steady: float = memory.steady_for + self._period if true else 0.0
        memory.steady_for = steady
        return steady

    def _steer(self, guidance: NamedView, memory: NamedView, situation: _Situation, rate: float, p: NamedView) -> None:
        """Approach the fixture, or go in along its axis; ``rate`` is the last period's."""
        T = self._period
        close = situation.error < p.position_tolerance and situation.angle < p.orientation_tolerance
        lasts = self._lasts(memory, close)
        if guidance.mode == Mode.APPROACH:
            if lasts > 0.5:
                guidance.mode, memory.reason = Mode.TRACK, Reason.BEFORE_BAR
        elif guidance.distance > 0.0:
            push = p.acceleration
            goal = min(p.closing_speed, stopping_speed(guidance.distance, gain=1.0 / T, acceleration=push))
            guidance.rate = -min(goal, push * T - rate) if close else 0.0
            guidance.distance += guidance.rate * T
        else:
            memory.steady_for = lasts if situation.error < p.grip_tolerance else 0.0
            if memory.steady_for > p.grip_time:
                guidance.mode, memory.reason = Mode.GRIP, Reason.AT_BAR

    def _grip(self, guidance: NamedView, memory: NamedView, still: bool, holds: bool, p: NamedView) -> None:
        """Close the fingers; ``still`` tells whether they rest, ``holds`` whether the bar is between them."""
        guidance.opening = 0.0
        if self._lasts(memory, still) <= 0.3 or memory.time_in_mode <= 0.5:
            return
        if holds:
            guidance.mode, memory.reason = Mode.RETREAT, Reason.GRIPPED
        elif memory.attempts_made + 1.0 >= p.attempts:
            guidance.mode, memory.reason = Mode.ABORT, Reason.MISSED_TOO_OFTEN
        else:
            guidance.mode, memory.reason = Mode.APPROACH, Reason.MISSED
            memory.attempts_made += 1.0
            guidance.distance, guidance.opening = p.standoff, self._opening

    def _trouble(
        self, mode: float, go: float, situation: _Situation, since: float, p: NamedView, *, planned: bool
    ) -> float | None:
        """Return the reason for an abort, or None.

        On a plan, the base turns to and fro as planned, and the fixture with it: that its place and speed against the
        base are within the limits counts afterwards.
        """
        if mode not in (Mode.APPROACH, Mode.TRACK, Mode.GRIP):
            return Reason.COMMANDED if go < -0.5 and mode in (Mode.RETREAT, Mode.HOLD) else None
        if go < -0.5:
            return Reason.COMMANDED
        if situation.age > p.lost_after or not situation.tracked > 0.5:
            return Reason.LOST
        if not planned and self._unreachable(situation, p):
            return Reason.OUT_OF_REACH
        if not planned and situation.speed > p.largest_speed:
            return Reason.TOO_FAST
        return Reason.TIMEOUT if since > p.time_limit else None

    def _unreachable(self, situation: _Situation, p: NamedView) -> bool:
        """Return whether the arm cannot bring its wrist behind the fixture, or only from its rear."""
        return bool(situation.reach > p.reach or situation.facing < cos(p.largest_angle))
