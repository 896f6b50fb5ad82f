"""A loop that runs in another process, as its live values show it: what the page of a testbed shows of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import replace
from math import isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from vtbdrake.control.bridge import BridgeError
from vtbdrake.failures import FAILURES, one_line
from vtbdrake.monitoring.live.client import LiveClient, LiveError, LiveTimeoutError, LiveWatch
from vtbdrake.monitoring.live.messages import MAX_ADDRESSES
from vtbdrake.state import AddressError
from vtbdrake.visualization.drawing import Drawing
from vtbdrake.visualization.meshcat import make_meshcat
from vtbdrake.web.layers import Layers
from vtbdrake.web.session import Frame, Session, SessionError, describe, plain

if TYPE_CHECKING:
    from vtbdrake.monitoring.live.messages import LoopStatus
    from vtbdrake.testbed import Scenario

_FRAME_PERIOD = 0.05  # s
_STATUS_PERIOD = 0.25  # s
_PATIENCE = 2.0  # s, for values
_ANSWER = 5.0  # s, for the answer to a command
_RETRY_PERIOD = 1.0  # s, after which a loop that is silent is asked again
_TROUBLE = (LiveError, LiveTimeoutError, BridgeError)


class LoopSession(Session):
    """Shows a loop that runs in another process with a `LiveService`, such as ``vtbdrake run``.

    The loop is watched through its live values alone: it costs it what ``vtbdrake watch`` costs. What is drawn is the
    world as the DPS believes it to be. The loop is asked to set variables, or to reset its guards, once for each call;
    nothing is held, so that nothing changes when the watcher is gone.

    Args:
        scenario: The scenario of the loop.
        url: LCM URL of its bus.

    Attributes:
        latest, variables, bodies, followed, layers, cameras, handles, meshcat_url: As of a `Session`.

    Raises:
        ValueError: The testbed cannot be built.
    """

    def __init__(self, scenario: Scenario, url: str) -> None:
        self._ended = threading.Event()
        self._status: LoopStatus | None = None
        self._motion = self._viewed = _Feed(url, (), 1)
        self._url = url
        super().__init__(scenario)
        self.loop_url = url

    def close(self) -> None:
        """End the watching; the loop goes on."""
        self._ended.set()
        self._thread.join()

    @property
    def trouble(self) -> str:
        """Return why commands do not reach the machine: a loop that is silent, or its fallbacks; empty if they do."""
        return self._motion.trouble or "; ".join(_latched(self._status))

    # -- commands

    def write(self, values: Mapping[str, Any], *, compare: bool = False) -> None:
        """Set variables of the loop, all of them or none.

        Raises:
            SessionError: The loop rejects it, does not answer, or one of them is not set by a page.
        """
        if compare:
            raise SessionError("a running loop has one course: leave the comparison out")
        for address in values:
            if not self.variables.get(address, {}).get("settable"):
                raise SessionError(f"there is no variable {address!r} of the DPS, or it cannot be set")
        self._ask(lambda client: client.set(values))

    def reset(self) -> None:
        """Let the DPS command again after a fault that is over.

        Raises:
            SessionError: A cause persists, or the loop does not answer.
        """
        self._ask(lambda client: client.reset())

    def watch(self, watcher: object, addresses: Collection[str]) -> None:
        """Read variables and ports in each frame, for one of several watchers; an empty list ends it.

        Raises:
            AddressError: There is no such variable or port.
        """
        for address in addresses:
            if address not in self.variables and address not in self._ports:
                raise AddressError(f"there is no variable and no port {address!r} of the DPS")
        with self._frame_ready:
            self._watched.pop(watcher, None)
            if addresses:
                self._watched[watcher] = tuple(addresses)

    def deflect(self, deflections: Mapping[str, Any]) -> None:
        """Do nothing: a loop is not driven by a page."""

    def show(self, viewer: object, layers: Collection[str]) -> None:
        """Show layers to one of several viewers; an empty list ends it.

        Raises:
            LayerError: A loop has no such layer.
        """
        self._layers.check(layers)
        with self._frame_ready:
            self._shown.pop(viewer, None)
            if layers:
                self._shown[viewer] = tuple(layers)

    def still(self) -> None:
        """Return None: what a loop looks like now is drawn in the page alone."""

    def _do(self, action: Callable[[], Any]) -> Any:
        raise SessionError(
            "a loop that runs elsewhere keeps its own time and switches: this is done to simulations alone"
        )

    def _ask(self, action: Callable[[LiveClient], Any]) -> Any:
        try:
            with LiveClient(self._url, timeout=_ANSWER) as client:
                return action(client)
        except _TROUBLE as error:
            raise SessionError(one_line(error)) from error

    # -- in the thread that draws

    def _run(self, ready: Future[None]) -> None:
        status = threading.Thread(target=self._follow_status, name="vtbdrake loop status", daemon=True)
        status.start()
        super()._run(ready)
        self._ended.set()
        status.join()

    def _drop(self) -> None:
        for feed in (self._motion, self._viewed):
            feed.close()
        super()._drop()

    def _build(self) -> None:
        self._testbed = testbed = self.scenario.build()
        self._context = testbed.default_context()
        self._meshcat = make_meshcat()
        self.meshcat_url = self._meshcat.web_url()
        self._drawing, self.bodies, self.followed = None, tuple[str, ...](), ""
        size = 0.0
        if testbed.scene_graph is not None:
            self._drawing = Drawing(self._meshcat, testbed, self._context, "now")
            self._drawing.fit_camera(self._context)
            self.bodies, self.followed = self._drawing.places, self._drawing.floating
            size = self._drawing.diagonal(self._context)
        # The state of the DPS's systems, scans and images are in the loop's process.
        self._layers = Layers(self._meshcat, testbed, size, only_poses=True)
        self.layers = self._layers.titles
        dps = {a: v for a, v in testbed.variables().items() if a.startswith(("dps.", "u.")) or a == "time"}
        self.variables = {address: describe(variable) for address, variable in dps.items()}
        self._ports = frozenset(a for a in testbed.addresses() if a.startswith("dps."))
        period = self.scenario.deployment().period
        self._every = max(1, round(_FRAME_PERIOD / period))
        estimates = dict.fromkeys(address for rule in testbed.belief_rules for address in rule.of)
        self._motion = _Feed(self._url, tuple(estimates) or ("time",), self._every)
        self._viewed = _Feed(self._url, (), self._every)
        self._last, self._rate = (0.0, 0.0), 0.0
        self.latest = Frame(
            number=1,
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

    def _work(self) -> None:
        """Take what has come, draw it, and publish a frame."""
        if self._ended.wait(_FRAME_PERIOD):
            self._closed = True
            return
        with self._frame_ready:
            watched = tuple(dict.fromkeys(address for group in self._watched.values() for address in group))
            layers = tuple(dict.fromkeys(name for group in self._shown.values() for name in group))
        if watched != self._viewed.addresses:
            self._viewed.close()
            self._viewed = _Feed(self._url, watched, self._every)
        sample, shown = self._motion.newest(), self._viewed.newest()
        note = ""
        if sample is not None and self._testbed.believes:
            note = self._draw_belief(*sample)
        elif not self._testbed.believes:
            note = "this testbed declares no belief: the picture stands still"
        self._layers.show(layers)
        self._layers.draw(self._context)
        latest, status = self.latest, self._status
        assert latest is not None
        now = time.monotonic() if sample is None else sample[0]
        failure = self._motion.trouble
        values = {} if shown is None else {address: plain(np.asarray(value)) for address, value in shown[1].items()}
        latched = () if failure else _latched(status)
        frame = replace(
            latest,
            number=latest.number + 1,
            time=latest.time if sample is None else now,
            playing=not failure and sample is not None,
            rate=self._reached(sample),
            positions={} if status is None or failure else status.positions,
            values=values,
            history=(latest.time, latest.time),
            warnings=(*latched, *((note,) if note else ())),
            failure=failure,
            layers=self._layers.notes,
            loop={} if status is None or failure else _plain_status(status),
        )
        with self._frame_ready:
            self.latest = frame
            self._frame_ready.notify_all()

    def _draw_belief(self, when: float, values: Mapping[str, Any]) -> str:
        """Draw the world as the DPS believes it to be; return why it cannot be drawn."""
        try:
            self._context.SetTime(when)
            self._testbed.write(self._context, self._testbed.belief_of(values, time=when))
            if self._drawing is not None:
                self._drawing.pose(self._context)
        except FAILURES as error:  # For example: it does not know yet where it is.
            return one_line(error)
        return ""

    def _reached(self, sample: tuple[float, Mapping[str, Any]] | None) -> float:
        """Return the DPS's seconds per second, over half a second at least."""
        if sample is None:
            return 0.0
        wall = time.monotonic()
        before, since = self._last
        if not since or wall - since >= 0.5:
            self._rate = (sample[0] - before) / (wall - since) if since else 0.0
            self._last = sample[0], wall
        return self._rate

    def _follow_status(self) -> None:
        while not self._ended.wait(_STATUS_PERIOD):
            try:
                with LiveClient(self._url, timeout=_PATIENCE) as client:
                    while not self._ended.wait(_STATUS_PERIOD):
                        self._status = client.status()
            except _TROUBLE:  # The frames tell it.
                self._status = None


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
    """Return why the fallbacks command until they are reset, as sentences."""
    return () if status is None else tuple(f"the fallbacks command: {text}" for text in status.latched)


def _plain_status(status: LoopStatus) -> dict[str, Any]:
    """Return what a page shows of a status, for JSON."""
    return {
        "ages": {name: age if isfinite(age) else None for name, age in status.ages.items()},
        "reasons": status.reasons,
        "faults": status.faults,
    }
