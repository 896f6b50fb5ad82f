"""A hand that leads a robot: its clutch, its limits, and who decides that it has let go.

Nothing here knows a network or a clock: the caller passes the time of a monotonic clock, in seconds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf, isfinite
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import AngleAxis, Quaternion
from pydrake.math import RigidTransform, RotationMatrix

from vtbdrake.testbed.hand_command import HandCommand

FORGET_TIME = 2.0
"""Seconds beyond the release time without a message after which a headset no longer leads and the robot is disarmed."""

_DELAY_WINDOW = 10.0  # s; the shortest delay of messages is taken over the last one or two windows
_SETTLING_TIME = 0.5  # s, in which all that has waited in a connection arrives when it works again
_SIDES = ("left", "right")


class HandError(ValueError):
    """A message of a headset cannot be understood, or a robot cannot be led."""


@dataclass(frozen=True)
class HandMessage:
    """What a headset tells at an instant, in the world frame of Drake.

    Attributes:
        time: The time of the headset's page, in seconds.
        head: The pose of the head.
        hands: The poses of the hands that are tracked, by side.
        grips: Whether each of them holds its clutch.
        buttons: The values of its buttons, 0 to 1.
    """

    time: float
    head: RigidTransform | None = None
    hands: Mapping[str, RigidTransform] = field(default_factory=dict)
    grips: Mapping[str, bool] = field(default_factory=dict)
    buttons: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @classmethod
    def of(cls, message: Mapping[str, Any]) -> Self:
        """Return the message of a page.

        Raises:
            HandError: A number is missing or not finite, or a rotation is none.
        """
        try:
            sides = {side: message[side] for side in _SIDES if message.get(side) is not None}
            return cls(
                time=_number(message["time"]),
                head=None if message.get("head") is None else _pose(message["head"]),
                hands={side: _pose(hand["pose"]) for side, hand in sides.items()},
                grips={side: hand["grip"] is True for side, hand in sides.items()},
                buttons={side: tuple(map(_number, hand.get("buttons", ()))) for side, hand in sides.items()},
            )
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise HandError(f"a headset sends time, head, left and right; this cannot be understood: {error}") from None


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise ValueError(f"{value!r} is no finite number")
    return float(value)


def _pose(value: Any) -> RigidTransform:
    """Return a pose from [w, x, y, z, px, py, pz]."""
    numbers = np.array([_number(entry) for entry in value])
    if numbers.shape != (7,) or not 0.9 < (norm := float(np.linalg.norm(numbers[:4]))) < 1.1:
        raise ValueError(f"{value!r} is not a unit quaternion and a position")
    return RigidTransform(Quaternion(numbers[:4] / norm), numbers[4:])


class Clutch:
    """Turns the motion of a hand into the pose of a tool, while it is closed.

    From the poses X_WH0 of the hand and X_WT0 of the tool at which it was closed, with the scales k,

        p_goal = p_WT0 + k (p_WH - p_WH0), within the box,       R_goal = (R_WH R_WH0')^k R_WT0,

    and the commanded pose moves towards the goal no faster than the limits. A tool that starts outside the box may stay
    where it is, but is not led further out.

    Args:
        command: The limits.

    Attributes:
        closed: Whether it is closed.
    """

    def __init__(self, command: HandCommand) -> None:
        self._command = command
        self.closed = False
        # Where the hand and the tool were when it was closed, and where the tool is to go.
        self._hand = self._tool = self._goal = RigidTransform()
        # The pose that is commanded.
        self._position: NDArray[np.float64] = np.zeros(3)
        self._rotation = RotationMatrix()
        # The box of positions, with the tool in it.
        self._lower = np.asarray(command.lower)
        self._upper = np.asarray(command.upper)
        self._moved_at = 0.0

    def close(self, hand: RigidTransform, tool: RigidTransform, now: float) -> None:
        """Close the clutch: the tool goes on from ``tool``.

        Args:
            hand: The pose X_WH0 of the hand.
            tool: The pose X_WT0 of the tool.
            now: The present time of the monotonic clock, in seconds.
        """
        self.closed = True
        self._hand, self._tool, self._goal = hand, tool, tool
        self._position = tool.translation()
        self._rotation = tool.rotation()
        self._lower = np.minimum(self._command.lower, self._position)
        self._upper = np.maximum(self._command.upper, self._position)
        self._moved_at = now

    def open(self) -> None:
        """Open the clutch: the robot stays where it is."""
        self.closed = False

    def follow(self, hand: RigidTransform) -> None:
        """Let the goal follow the hand."""
        moved = self._command.scale * (hand.translation() - self._hand.translation())
        turned = _scaled(hand.rotation() @ self._hand.rotation().inverse(), self._command.turn_scale)
        position = np.clip(self._tool.translation() + moved, self._lower, self._upper)
        self._goal = RigidTransform(turned @ self._tool.rotation(), position)

    def command(self, now: float) -> NDArray[np.float64]:
        """Return the command u of this instant, [c; w, x, y, z; p]; it moves towards the goal since the last call."""
        if not self.closed:
            return np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        # What is missed in a pause is not made up for.
        dt = min(max(now - self._moved_at, 0.0), self._command.release_time)
        self._moved_at = now
        way = self._goal.translation() - self._position
        length = float(np.linalg.norm(way))
        reach = self._command.speed * dt
        self._position = self._goal.translation() if length <= reach else self._position + way * (reach / length)
        turn = self._rotation.inverse() @ self._goal.rotation()
        angle = turn.ToAngleAxis().angle()
        reach = self._command.turn_rate * dt
        step = turn if angle <= reach else _scaled(turn, reach / angle)
        self._rotation = RotationMatrix.ProjectToRotationMatrix((self._rotation @ step).matrix())
        return np.array([1.0, *self._rotation.ToQuaternion().wxyz(), *self._position])


def _scaled(rotation: RotationMatrix, factor: float) -> RotationMatrix:
    """Return the rotation about the same axis by ``factor`` times the angle, which is at most pi."""
    turn = rotation.ToAngleAxis()
    return RotationMatrix(AngleAxis(factor * turn.angle(), turn.axis()))


class ExcessDelay:
    """How much later than the quickest messages a message arrives: those that have waited somewhere are old.

    The sender's clock is another one, so only differences between delays are known; they are compared with the
    shortest one of the last ten to twenty seconds, in which clocks do not drift apart.

    A connection keeps the order of its messages. So of two stamps in a falling order one is false, perhaps the one that
    makes all later messages look old: the delays are measured anew. They are measured anew, too, after a silence, in
    which the clock may have stood still; but what arrives soon after it may have waited as long as that.
    """

    def __init__(self) -> None:
        self._forget()
        self._last = -inf, inf
        self._silence, self._silent_until = 0.0, -inf

    def _forget(self) -> None:
        self._shortest = [inf, inf]
        self._begun = -inf

    def of(self, sent: float, arrived: float) -> float:
        """Return the delay of a message, in seconds, beyond the shortest one.

        Args:
            sent: The sender's time stamp, in seconds, on the sender's clock.
            arrived: The time of arrival, in seconds, on the monotonic clock here.
        """
        last_sent, last_arrived = self._last
        self._last = sent, arrived
        if arrived - last_arrived > FORGET_TIME:
            self._forget()
            self._silence, self._silent_until = arrived - last_arrived, arrived
        delay = self._beyond_shortest(sent, arrived)
        if sent < last_sent:
            self._forget()
            self._beyond_shortest(sent, arrived)
        return delay if arrived - self._silent_until > _SETTLING_TIME else max(delay, self._silence)

    def _beyond_shortest(self, sent: float, arrived: float) -> float:
        if arrived - self._begun > _DELAY_WINDOW:
            self._shortest = [self._shortest[1], inf]
            self._begun = arrived
        delay = arrived - sent
        self._shortest[1] = min(self._shortest[1], delay)
        return delay - min(self._shortest)


class Lead:
    """Decides which headset leads a robot, and when it does not.

    A person arms the robot in a page. Then the first headset that closes its clutch leads, until it is gone; poses of
    the others are not used. The clutch closes when a grip is taken, not while one is still held from before. It opens
    when the grip is let go, the hand is not tracked, none of its messages has come for the release time of the command,
    or they arrive that late. A headset whose page is closed, or that is silent for `FORGET_TIME`, disarms the robot.

    Args:
        command: What is led.
        tool: Returns the pose from which the tool goes on; raises HandError where it is not known.

    Attributes:
        armed: Whether a hand may lead.
        notice: What has happened last, for people.
        headset: The headset that leads, or has led since the robot was armed; None if there is none.
        head: The pose of its head.
        buttons: The buttons of its hand that leads, or led last.
    """

    def __init__(self, command: HandCommand, tool: Callable[[], RigidTransform]) -> None:
        self.armed = False
        self.notice = "not armed"
        self.headset: object | None = None
        self.head: RigidTransform | None = None
        self.buttons: tuple[float, ...] = ()
        self._tool, self._release_time = tool, command.release_time
        self._clutch = Clutch(command)
        self._side = ""
        self._heard = -inf
        self._delays: dict[object, ExcessDelay] = {}
        self._grips: dict[object, dict[str, bool]] = {}

    @property
    def leading(self) -> bool:
        """Return whether a clutch is closed."""
        return self._clutch.closed

    def arm(self) -> None:
        """Let a headset lead."""
        if not self.armed:
            self.armed = True
            self.notice = "armed: take a grip to lead"

    def disarm(self, notice: str) -> None:
        """Let nobody lead until the robot is armed again."""
        if self.armed:
            self.notice = notice
        self._clutch.open()
        self.armed, self.headset = False, None

    def receive(self, headset: object, message: HandMessage, now: float) -> str:
        """Take a message of a headset, and return why its hands may not lead; empty if they may.

        Args:
            headset: The headset that has sent it: any object that can be a key.
            message: What it tells: poses in the world, grips and buttons.
            now: The time of arrival on the monotonic clock, in seconds.
        """
        delay = self._delays.setdefault(headset, ExcessDelay()).of(message.time, now)
        before = self._grips.setdefault(headset, {})
        taken = [side for side, grip in message.grips.items() if grip and not before.get(side, True)]
        before |= message.grips
        if not self.armed:
            return "the robot is not armed"
        if delay > self._release_time:
            if headset is self.headset:
                self._release(f"poses arrive {1e3 * delay:.0f} ms late: the clutch is released")
            return "its poses arrive too late"
        if self.headset not in (None, headset):
            return "another headset leads"
        if self.headset is headset:
            self._heard, self.head = now, message.head
        if self._clutch.closed:
            self._follow(message)
        elif taken:
            self._clutch.close(message.hands[taken[0]], self._tool(), now)
            self.headset, self._heard, self.head = headset, now, message.head
            self._side, self.buttons = taken[0], message.buttons[taken[0]]
            self.notice = f"the {self._side} hand leads"
        return ""

    def _follow(self, message: HandMessage) -> None:
        if self._side not in message.hands:
            self._release("the hand is not tracked: the clutch is released")
        elif not message.grips[self._side]:
            self._release("the grip was let go: the robot holds its position")
        else:
            self.buttons = message.buttons[self._side]
            self._clutch.follow(message.hands[self._side])

    def gone(self, headset: object) -> None:
        """Note that a headset has closed its connection."""
        self._delays.pop(headset, None)
        self._grips.pop(headset, None)
        if headset is self.headset:
            self.disarm("the page of the headset is gone: the robot holds its position, and is disarmed")

    def command(self, now: float) -> NDArray[np.float64]:
        """Return the command u of this instant."""
        silent = now - self._heard - self._release_time
        if self.headset is not None and silent > 0.0:
            self._release(f"no pose for {1e3 * self._release_time:.0f} ms: the clutch is released")
            if silent > FORGET_TIME:
                self.disarm(f"the headset is silent for {FORGET_TIME:g} s: the robot is disarmed")
        return self._clutch.command(now)

    def _release(self, notice: str) -> None:
        if self._clutch.closed:
            self.notice = notice
        self._clutch.open()
