"""Virtual reality: headsets that open the page of a session lead a robot by its command u."""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.monitoring.live.client import LiveClient, LiveTimeoutError
from vtbdrake.testbed import Scenario
from vtbdrake.testbed.hand_command import HandCommand
from vtbdrake.web.serving.host import CLOSED, action_of, command_of, first_of, receive, send
from vtbdrake.web.serving.requests import Requests, wait_for_end
from vtbdrake.web.vr.hand import HandError, HandMessage, Lead

_TICK = 0.01  # s, between two commands while a hand leads
_STATUS_PERIOD = 0.05  # s
_ANSWER_TIME = 0.5  # s, for the loop to tell where its tool is
_BURST = 100
# Why a robot is not led: any ValueError, also of a session or a loop, and a bus that is gone.
_FORESEEN = (ValueError, BridgeError, OSError)

_BLIND = "the picture of the robot was lost: look at it before you arm the robot again"

_log = logging.getLogger(__name__)


def hand_command_of(scenario: Scenario) -> HandCommand:
    """Return the command by which a hand leads the robot of a scenario, checked against its signals.

    Raises:
        ValueError: No hand leads it, or its declaration does not fit.
    """
    command = scenario.hand_command()
    if command is None:
        raise HandError(
            f"no hand leads a {type(scenario).__name__} like this: its method hand_command() returns None; for some "
            "scenarios, a field decides (the arm: --field led_by_hand=true)"
        )
    command.check_interface(scenario.interface())
    return command


class LedRobot(ABC):
    """What a hand leads: the simulated robot of a session, or one that a loop controls.

    One thread calls its methods. They raise `HandError`, or what a session or a bus raises.

    Args:
        scenario: The scenario, which declares how a hand leads its robot.

    Attributes:
        is_real: Whether a machine may move.
        command: How it is led.
        idle: The values of the commands u while no hand leads, by name.

    Raises:
        ValueError: No hand leads this robot.
    """

    is_real = False

    def __init__(self, scenario: Scenario) -> None:
        self.command = command = hand_command_of(scenario)
        names = {command.command, command.head, command.buttons}
        self.idle = {s.name: s.default_vector() for s in scenario.interface().commands if s.name in names}

    def begin(self) -> None:
        """Let the robot follow, as soon as it can."""
        self.send(self.command.begin)

    def tool(self) -> RigidTransform:
        """Return the pose from which the tool goes on.

        Raises:
            HandError: The robot does not follow yet.
        """
        values = self.read((self.command.pose, *self.command.ready))
        for address, expected in self.command.ready.items():
            if not np.all(values[address] == expected):
                raise HandError(
                    f"the robot does not follow a hand yet: {address} is {np.asarray(values[address]).tolist()}, not "
                    f"{expected}"
                )
        matrix = np.asarray(values[self.command.pose], dtype=float).reshape(3, 4)
        if not np.isfinite(matrix).all():
            raise HandError("the pose of the tool is not finite")
        return RigidTransform(matrix)

    @abstractmethod
    def read(self, addresses: tuple[str, ...]) -> Mapping[str, Any]:
        """Return the present values of variables."""

    @abstractmethod
    def send(self, commands: Mapping[str, Any]) -> None:
        """Give values of commands u, by name."""

    def trouble(self) -> str:
        """Return the reason why the robot is not to be led now; empty if it may. Called in each turn."""
        return ""

    def close(self) -> None:  # noqa: B027
        """End the connection to the robot."""


class ControlledRobot(LedRobot):
    """A robot that a loop (``vtbdrake run``) controls: it receives commands u over LCM, and answers what it is asked.

    Args:
        scenario: The scenario, whose protocol has a channel for each of the commands.
        url: The LCM URL of the bus.
        trouble: Returns why commands do not reach the machine; empty if they do.

    Raises:
        ValueError: The protocol has no channel for a command.
        BridgeError: There is no bus.
    """

    is_real = True

    def __init__(self, scenario: Scenario, url: str, *, trouble: Callable[[], str] = str) -> None:
        super().__init__(scenario)
        self._trouble = trouble
        signals = {signal.name: signal for signal in scenario.interface().commands}
        self._encoders = {
            name: (map.channel, map.encoder([signals[signal] for signal in map.signals]))
            for map in protocol_of(scenario).commands
            for name in map.signals
        }
        if missing := {*self.idle, *self.command.begin} - self._encoders.keys():
            raise HandError(
                f"the protocol of {type(scenario).__name__} has no channel for {', '.join(sorted(missing))}"
            )
        self._url, self._utime = url, 0
        self._link = LcmLink(url, {}, connect_timeout=_ANSWER_TIME)
        self._link.open()

    def begin(self) -> None:
        self.read((self.command.pose,))  # A loop that does not answer cannot be led.
        super().begin()

    def read(self, addresses: tuple[str, ...]) -> Mapping[str, Any]:
        try:
            with LiveClient(self._url, timeout=_ANSWER_TIME) as loop:
                return loop.get(addresses)
        except (BridgeError, LiveTimeoutError) as error:
            raise HandError(
                f"the loop does not answer at {self._url} ({one_line(error)}): start vtbdrake run"
            ) from None

    def send(self, commands: Mapping[str, Any]) -> None:
        self._utime = max(self._utime + 1, time.time_ns() // 1000)
        for name, value in commands.items():
            channel, encode = self._encoders[name]
            if not self._link.publish((channel, encode({name: np.atleast_1d(np.asarray(value, float))}, self._utime))):
                raise HandError(f"the bus {self._url} takes no commands: is the hub running?")

    def trouble(self) -> str:
        self._link.receive(0.0, _BURST)  # It keeps the connection.
        return self._trouble()

    def close(self) -> None:
        self._link.close()


@dataclass(frozen=True)
class VrStatus:
    """The status of a robot that is led, for pages; see `Lead` for the fields.

    Attributes:
        armed: Whether a hand may lead.
        leading: Whether a clutch is closed.
        notice: What has happened last.
        headset: The headset that leads, or may.
        refusals: Why the hands of other headsets do not lead.
        sent: The number of commands that were given.
    """

    armed: bool = False
    leading: bool = False
    notice: str = "not armed"
    headset: object | None = None
    refusals: Mapping[object, str] = field(default_factory=dict)
    sent: int = 0


class VirtualReality:
    """Lets headsets lead a robot, in a thread of its own, which also decides when a hand has let go.

    Args:
        robot: The robot; it is closed at the end.
        picture: Returns which picture shows the robot, such as the address of a Meshcat; empty for none. A robot is
            disarmed when its picture is lost, or another one.

    Attributes:
        status: The present status.
    """

    def __init__(self, robot: LedRobot, *, picture: Callable[[], str]) -> None:
        self.status = VrStatus()
        self._robot, self._picture, self._picture_of_arming = robot, picture, picture()
        self._lead = Lead(robot.command, robot.tool)
        self._refusals: dict[object, str] = {}
        self._sent = 0
        self._released = True
        self._inbox = Requests(HandError, "the server has ended: no hand leads", self._failure)
        self._thread = threading.Thread(target=self._run, name="vtbdrake hand", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Release the robot, and end; a robot that hangs is left behind after 10 s."""
        self._inbox.end()
        wait_for_end(self._thread, "leading the robot")

    def arm(self) -> None:
        """Let a headset lead.

        Raises:
            ValueError: The robot cannot be led, or the server has ended.
        """
        self._inbox.ask(self._thread, self._arm)

    def disarm(self) -> None:
        """Release the robot, and let nobody lead it until it is armed again."""
        self._inbox.ask(self._thread, lambda: self._lead.disarm("disarmed by hand"))

    def receive(self, headset: object, message: HandMessage) -> None:
        """Take a message of a headset.

        Args:
            headset: The headset that has sent it: any object that can be a key.
            message: What it tells: poses in the world, grips and buttons.
        """
        now = time.monotonic()
        self._inbox.tell(lambda: self._receive(headset, message, now))

    def gone(self, headset: object) -> None:
        """Note that the page of a headset is closed, or has left virtual reality."""
        self._inbox.tell(lambda: self._forget(headset))

    # -- in the thread

    def _run(self) -> None:
        try:
            while self._inbox.carry_out(_TICK):
                self._work()
        finally:
            self._lead.disarm("the server has ended")
            self._work()
            self._robot.close()

    def _fail(self, error: BaseException) -> None:
        if self._lead.armed and not isinstance(error, _FORESEEN):
            _log.error("the robot is released, as leading it has failed", exc_info=error)
        self._lead.disarm(one_line(error))

    def _failure(self, error: BaseException) -> Exception:
        """Return the error to raise for the caller; an unforeseen one disarms."""
        if not isinstance(error, _FORESEEN):
            self._fail(error)
        return error if isinstance(error, Exception) else HandError(one_line(error))

    def _work(self) -> None:
        """Give the command of this instant: while a hand leads, and once when it has let go."""
        lead = self._lead
        try:
            if reason := self._robot.trouble() or self._blindness():
                lead.disarm(reason)
            command = lead.command(time.monotonic())
            if lead.leading or not self._released:
                self._released = False
                self._robot.send(self._commands(command))
                self._released = not lead.leading
                self._sent += 1
        except FAILURES as error:
            self._fail(error)
        self.status = VrStatus(lead.armed, lead.leading, lead.notice, lead.headset, dict(self._refusals), self._sent)

    def _commands(self, command: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return the values of the commands u."""
        declared, commands = self._robot.command, dict(self._robot.idle)
        if not self._lead.leading:
            return commands
        commands[declared.command] = command
        if declared.head and (head := self._lead.head) is not None:
            commands[declared.head] = np.array([*head.rotation().ToQuaternion().wxyz(), *head.translation()])
        if declared.buttons:
            values = commands[declared.buttons] = commands[declared.buttons].copy()
            pressed = self._lead.buttons[: values.size]
            values[: len(pressed)] = pressed
        return commands

    def _blindness(self) -> str:
        """Return the reason why the leaders do not see the robot; empty if they see it since it was armed."""
        return "" if self._picture_of_arming and self._picture() == self._picture_of_arming else _BLIND

    def _arm(self) -> None:
        self._picture_of_arming = self._picture()
        if reason := self._robot.trouble() or self._blindness():
            raise HandError(reason)
        self._robot.begin()
        self._lead.arm()

    def _receive(self, headset: object, message: HandMessage, now: float) -> None:
        try:
            self._refusals[headset] = self._lead.receive(headset, message, now)
        except _FORESEEN as error:
            self._refusals[headset] = self._lead.notice = one_line(error)

    def _forget(self, headset: object) -> None:
        self._refusals.pop(headset, None)
        self._lead.gone(headset)

    # -- pages

    async def serve(self, browser: WebSocket) -> None:
        """Serve the socket of a page: it arms and disarms, and its headset leads."""
        await browser.accept()
        headset = object()
        try:
            await first_of(self._listen(browser, headset), self._tell(browser, headset))
        except CLOSED:
            pass
        finally:
            self.gone(headset)
            with suppress(*CLOSED):
                await browser.close()

    def description(self) -> dict[str, Any]:
        """Return the description for a page."""
        command = self._robot.command
        return {"real": self._robot.is_real, "stand": list(command.stand), "box": [[*command.lower], [*command.upper]]}

    async def _listen(self, browser: WebSocket, headset: object) -> None:
        actions: dict[str, Callable[[], None]] = {
            "arm": self.arm,
            "disarm": self.disarm,
            "leave": lambda: self.gone(headset),
        }
        while True:
            content = await receive(browser)
            try:
                message = command_of(content)
                if "do" in message:
                    await run_in_threadpool(action_of(message, actions))
                else:
                    self.receive(headset, HandMessage.of(message))
            except FAILURES as error:
                await send(browser, {"type": "error", "error": one_line(error)})

    async def _tell(self, browser: WebSocket, headset: object) -> None:
        before: dict[str, Any] = {}
        while True:
            status = self.status
            message = {
                "type": "status",
                "armed": status.armed,
                "leading": status.leading,
                "notice": status.notice,
                "mine": status.headset is headset,
                "refusal": status.refusals.get(headset, ""),
                "sent": status.sent,
            }
            if message != before:
                await send(browser, before := message)
            await asyncio.sleep(_STATUS_PERIOD)
