"""A loop that runs in another process, as its live values show it: what the page of a testbed shows of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.common.failures import FAILURES, one_line
from vtbdrake.common.json_data import plain
from vtbdrake.control.bridge import BridgeError
from vtbdrake.monitoring.live.client import LiveClient, LiveError, LiveTimeoutError, LiveWatch
from vtbdrake.monitoring.live.messages import MAX_ADDRESSES
from vtbdrake.state import AddressError
from vtbdrake.web.live.scene import LiveScene
from vtbdrake.web.live.session import Frame, Session, SessionError, Stage
from vtbdrake.web.live.watching import Groups, describe, page_value

if TYPE_CHECKING:
    from vtbdrake.monitoring.live.messages import LoopStatus
    from vtbdrake.testbed import Scenario

_FRAME_PERIOD = 0.05  # s
_STATUS_PERIOD = 0.25  # s
_PATIENCE = 2.0  # s, for values
_ANSWER = 5.0  # s, for the answer to a command
_RETRY_PERIOD = 1.0  # s, after which a loop that is silent is asked again
_RATE_PERIOD = 0.5  # s of wall time, over which the rate is measured at least
_TROUBLE = (LiveError, LiveTimeoutError, BridgeError)


class LoopSession(Session["_LoopStage"]):
    """Shows a loop that runs in another process with a `LiveService`, such as ``vtbdrake run``.

    The loop is watched through its live values alone: it costs it what ``vtbdrake watch`` costs. What is drawn is the
    world as the DPS believes it to be. The loop is asked to set variables, or to reset its guards, once for each call;
    nothing is held, so that nothing changes when the watcher is gone.

    Args:
        scenario: The scenario of the loop.
        url: LCM URL of its bus.

    Attributes:
        loop_url: LCM URL of its bus.

    Raises:
        ValueError: The testbed cannot be built.
    """

    def __init__(self, scenario: Scenario, url: str) -> None:
        self.loop_url = url
        super().__init__(scenario)

    def _make_stage(self) -> _LoopStage:
        return _LoopStage(self.scenario, self.loop_url)

    @property
    def trouble(self) -> str:
        """Return the reason why nobody is to lead the machine; empty if somebody may.

        Commands do not reach it, if the loop is silent or its fallbacks command, or the picture stands still.
        """
        stage = self._stage_of_thread
        return "the session has ended" if stage is None else stage.trouble()

    def write(self, values: Mapping[str, Any]) -> None:
        """Set variables of the loop, all of them or none.

        Raises:
            SessionError: The loop rejects it, does not answer, or one of them is not set by a page.
        """
        for address in values:
            if not self.variables.get(address.partition("[")[0], {}).get("settable"):
                raise SessionError(f"there is no variable {address!r} of the DPS, or it cannot be set")
        self._ask(lambda client: client.set(values))

    def reset(self) -> None:
        """Let the DPS command again after a fault that is over.

        Raises:
            SessionError: A cause persists, or the loop does not answer.
        """
        self._ask(lambda client: client.reset())

    def still(self) -> None:
        """Return None: what a loop looks like now is drawn in the page alone."""

    def _ask(self, action: Callable[[LiveClient], Any]) -> Any:
        try:
            with LiveClient(self.loop_url, timeout=_ANSWER) as client:
                return action(client)
        except _TROUBLE as error:
            raise SessionError(one_line(error)) from error


class _LoopStage(Stage):
    """Draws what a loop believes, and tells what it says, in the thread of a session.

    Args:
        scenario: The scenario of the loop.
        url: LCM URL of its bus.
    """

    def __init__(self, scenario: Scenario, url: str) -> None:
        self._url = url
        self._testbed = testbed = scenario.build()
        self._context = testbed.default_context()
        # The state of the DPS's systems, scans and images are in the loop's process.
        self.scene = LiveScene(testbed, self._context, only_poses=True)
        dps = {a: v for a, v in testbed.variables().items() if a.startswith(("dps.", "u.")) or a == "time"}
        self.variables = {address: describe(variable) for address, variable in dps.items()}
        self._ports = frozenset(a for a in testbed.addresses() if a.startswith("dps."))
        self._watched = Groups()
        self._every = max(1, round(_FRAME_PERIOD / scenario.deployment().period))
        estimates = dict.fromkeys(address for rule in testbed.belief_rules for address in rule.of)
        self._motion = _Feed(url, tuple(estimates) or ("time",), self._every)
        self._viewed = _Feed(url, (), self._every)
        self._drawn_at = time.monotonic()
        self._note = ""
        self._rate = _Rate()
        self._next_frame = time.monotonic() + _FRAME_PERIOD
        self._shown = Frame(
            number=0,
            time=0.0,
            playing=False,
            speed=1.0,
            rate=0.0,
            positions={},
            values={},
            history=(0.0, 0.0),
            warnings=(),
            failure="",
            preview=None,
            comparison=None,
            loop={},
        )
        self._status = _StatusFollower(url)

    def close(self) -> None:
        """End the watching; the loop goes on."""
        for feed in (self._motion, self._viewed):
            feed.close()
        self._status.close()

    @property
    def time(self) -> float:
        """Return the DPS's time of what is drawn, in seconds."""
        return float(self._context.get_time())

    def trouble(self) -> str:
        """Return the reason why nobody is to lead the machine, in any thread; empty if somebody may."""
        if reason := self._motion.trouble or "; ".join(_latched(self._status.newest)):
            return reason
        if self._testbed.believes and time.monotonic() - self._drawn_at > _PATIENCE:
            return f"the picture stands still: {self._note or 'nothing has been drawn'} for {_PATIENCE:g} s"
        return ""

    def watch(self, watcher: object, addresses: Collection[str]) -> None:
        """Read variables and ports of the DPS in each frame."""
        for address in addresses:
            if address not in self.variables and address not in self._ports:
                raise AddressError(f"there is no variable and no port {address!r} of the DPS")
        self._watched.set(watcher, addresses)

    def redraw(self) -> None:
        """Draw what is shown into a new picture."""
        self.scene.renew(self._context)

    def idle_time(self) -> float:
        """Return the wall time, in seconds, until the next frame."""
        return self._next_frame - time.monotonic()

    def work(self) -> Frame | None:
        """Take what has come, draw it, and return the next frame when it is due."""
        if self.idle_time() > 0.0:
            return None
        self._next_frame = time.monotonic() + _FRAME_PERIOD
        watched = self._watched.names()
        if watched != self._viewed.addresses:
            self._viewed.close()
            self._viewed = _Feed(self._url, watched, self._every)
        sample, viewed = self._motion.newest(), self._viewed.newest()
        if not self._testbed.believes:
            self._note = "this testbed declares no belief: the picture stands still"
        elif sample is not None:
            self._note = self._draw_belief(*sample)
        self.scene.layers.draw(self._context)
        failure, values = self._motion.trouble, {} if viewed is None else viewed[1]
        status = None if failure else self._status.newest
        self._shown = replace(
            self._shown,
            time=self._shown.time if sample is None else sample[0],
            playing=not failure and sample is not None,
            rate=0.0 if sample is None else self._rate.reached(sample[0]),
            positions={} if status is None else status.positions,
            values={address: page_value(np.asarray(value)) for address, value in values.items()},
            history=(self._shown.time, self._shown.time),
            warnings=(*_latched(status), *((self._note,) if self._note else ())),
            failure=failure,
            loop={} if status is None else _plain_status(status),
        )
        return self.frame()

    def frame(self) -> Frame:
        """Return the frame that is shown."""
        return replace(self._shown, layers=self.scene.layers.notes)

    def _draw_belief(self, when: float, values: Mapping[str, Any]) -> str:
        """Draw the world as the DPS believes it to be; return why it cannot be drawn."""
        try:
            self._context.SetTime(when)
            self._testbed.write(self._context, self._testbed.belief_of(values, time=when))
            self.scene.pose(self._context)
        except FAILURES as error:  # For example: it does not know yet where it is.
            return one_line(error)
        self._drawn_at = time.monotonic()
        return ""


class _Rate:
    """The DPS's seconds per second of wall time."""

    def __init__(self) -> None:
        self._rate = 0.0
        self._last: tuple[float, float] | None = None

    def reached(self, now: float) -> float:
        """Return the rate at a time of the DPS in seconds, measured over half a second at least."""
        wall = time.monotonic()
        if self._last is None:
            self._last = now, wall
        before, since = self._last
        if wall - since >= _RATE_PERIOD:
            self._rate = (now - before) / (wall - since)
            self._last = now, wall
        return self._rate


class _StatusFollower:
    """Asks a loop for its status again and again, in a thread of its own.

    Attributes:
        newest: The last status; None while the loop does not answer.
    """

    def __init__(self, url: str) -> None:
        self.newest: LoopStatus | None = None
        self._url = url
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="vtbdrake loop status", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._ended.set()
        self._thread.join()

    def _follow(self) -> None:
        while not self._ended.wait(_STATUS_PERIOD):
            try:
                with LiveClient(self._url, timeout=_PATIENCE) as client:
                    while not self._ended.wait(_STATUS_PERIOD):
                        self.newest = client.status()
            except _TROUBLE:  # The frames tell it.
                self.newest = None


class _Feed:
    """The newest values of some addresses; if the loop ends or is silent, a loop that is started anew is waited for.

    Attributes:
        addresses: Addresses of variables and ports.
        trouble: Why nothing comes; empty while it does.
    """

    def __init__(self, url: str, addresses: Sequence[str], every: int) -> None:
        self.addresses = tuple(addresses)
        self.trouble = ""
        self._url, self._every = url, every
        self._watches: list[LiveWatch] = []
        self._again_at = 0.0

    def newest(self) -> tuple[float, dict[str, Any]] | None:
        """Return the time of the DPS in seconds and the values by address; None without any."""
        if not self._watches and time.monotonic() >= self._again_at:
            parts = range(0, len(self.addresses), MAX_ADDRESSES)
            options: dict[str, Any] = {"size": 1, "every": self._every, "timeout": _PATIENCE}
            self._watches = [LiveWatch(self._url, self.addresses[k : k + MAX_ADDRESSES], **options) for k in parts]
        values: dict[str, Any] = {}
        when = 0.0
        for watch in self._watches:
            # Asked first: what a watch gets until it ends is still read.
            ended = not watch.alive
            try:
                columns = watch.arrays()
            except _TROUBLE as error:
                self._fail(one_line(error))
                return None
            if ended:
                self._fail("the loop has ended")
                return None
            if not columns["time"].size:
                return None
            when = float(columns["time"][-1])
            values |= {address: columns[address][-1] for address in columns if address not in ("time", "since")}
        if not self._watches:
            return None
        self.trouble = ""
        return when, values

    def _fail(self, trouble: str) -> None:
        # While a loop that has ended is waited for, that stays the reason.
        self.trouble = self.trouble or trouble
        self.close()
        self._again_at = time.monotonic() + _RETRY_PERIOD

    def close(self) -> None:
        """End the watches."""
        for watch in self._watches:
            watch.close()
        self._watches.clear()


def _latched(status: LoopStatus | None) -> tuple[str, ...]:
    """Return the reasons why the fallbacks command until they are reset, as sentences."""
    return () if status is None else tuple(f"the fallbacks command: {text}" for text in status.latched)


def _plain_status(status: LoopStatus) -> dict[str, Any]:
    """Return the parts of a status that a page shows, for JSON."""
    return {
        "ages": plain(status.ages),
        "reasons": status.reasons,
        "faults": status.faults,
    }
