"""Clients of live values: they set, read, watch and reset a DPS that runs in another process."""

from __future__ import annotations

import json
import threading
import time
import uuid
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.common.closing import Closing
from vtbdrake.control.bridge import BridgeError
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.lcm.hub import STATUS_CHANNEL, TAKE_PREFIX, HubStatistics
from vtbdrake.monitoring.live.messages import (
    ANSWER,
    GET,
    RESET,
    SET,
    STATUS,
    WATCH,
    WATCHED,
    LoopStatus,
    is_number,
    parse_request,
    to_json,
)

_CONNECT_TIMEOUT = 2.0  # s
_BURST = 1000  # messages taken at a time
_SLICE = 0.05  # s; longest wait for a message before looking at the clock
_REPEAT_PERIOD = 0.5  # s after which a request is sent again
_TAKE_PERIOD = 0.05  # s after which a channel that another client owns is asked for again

Values = dict[str, float | NDArray[np.float64]]


class LiveError(ValueError):
    """The DPS rejects a request, or an answer on the bus is not valid."""


class LiveTimeoutError(TimeoutError):
    """No answer or no value came in time."""


class LiveClient(Closing):
    """Sets and reads variables of a DPS that runs with a `LiveService`, and resets its guards.

    ::

        with LiveClient("tcpq://127.0.0.1:7700") as dps:
            dps.set({"dps.impl.stiffness": 200.0})

    Args:
        url: LCM URL of the bus.
        timeout: Seconds to wait for an answer.

    Raises:
        BridgeError: There is no bus.
        ValueError: The timeout is not positive.
    """

    def __init__(self, url: str, *, timeout: float = 5.0) -> None:
        self._timeout = _check_timeout(timeout)
        self._id = ""
        self._answer: dict[str, Any] = {}
        self._owners: dict[str, str] = {}  # of the channels that a hub protects, and that other clients own
        handlers = dict.fromkeys([channel + ANSWER for channel in (SET, GET, RESET, STATUS)], self._receive)
        self._link = LcmLink(url, {**handlers, STATUS_CHANNEL: self._receive_status}, connect_timeout=_CONNECT_TIMEOUT)
        self._link.open()

    def set(self, values: Mapping[str, ArrayLike]) -> None:
        """Set variables by address, all of them or none.

        Raises:
            LiveError: One of them is rejected.
            LiveTimeoutError: There is no answer; they may have been set or not.
        """
        self._request(SET, {"set": dict(values)})

    def get(self, addresses: Iterable[str]) -> Values:
        """Return the present values of variables and vector output ports by address.

        Raises:
            LiveError: One of them is rejected.
            LiveTimeoutError: There is no answer.
        """
        addresses = list(addresses)
        return _arrays(self._request(GET, {"get": addresses}), addresses, GET)

    def reset(self) -> list[str]:
        """Release the latch of the guards and return the reasons for which it had latched.

        Raises:
            LiveError: A cause persists; the fallbacks go on.
            LiveTimeoutError: There is no answer; the latch may have been released or not.
        """
        answer = self._request(RESET, {"reset": True})
        released = answer.get("released")
        if not isinstance(released, list) or not all(isinstance(reason, str) for reason in released):
            raise _invalid(RESET, "the list of reasons in 'released'", answer)
        return released

    def status(self) -> LoopStatus:
        """Return the status of the loop.

        Raises:
            LiveError: It cannot be told.
            LiveTimeoutError: There is no answer.
        """
        answer = self._request(STATUS, {"status": True})
        try:
            return LoopStatus(**answer["status"])
        except (KeyError, TypeError):
            raise _invalid(STATUS, "the status of a loop in 'status'", answer) from None

    def _request(self, channel: str, request: dict[str, Any]) -> dict[str, Any]:
        self._id, self._answer = uuid.uuid4().hex, {}
        data = _checked(channel, {"id": self._id, **request})
        deadline, sent = time.monotonic() + self._timeout, -np.inf
        while not self._answer:
            now = time.monotonic()
            if now >= deadline:
                raise _no_answer(self._link, self._timeout, channel, self._owners.get(channel))
            if channel in self._owners and now >= sent + _TAKE_PERIOD:
                # The hub rejects this as long as the owner goes on publishing.
                self._link.publish((TAKE_PREFIX + channel, b""))
                sent = -np.inf
                del self._owners[channel]
            if now >= sent + _REPEAT_PERIOD:
                # A service that has just started has missed it; others know it by its id.
                self._link.publish((channel, data))
                sent = now
            self._link.receive(_SLICE, _BURST)
        answer = self._answer
        if "error" in answer:
            raise LiveError(str(answer["error"]))
        if answer.get("ended") is True:
            raise LiveError("the DPS has ended before it answered")
        if answer.get("ok") is not True:
            raise _invalid(channel, "'ok' or an error", answer)
        return answer

    def _receive(self, channel: str, data: bytes) -> None:
        answer = _json_object(data)
        if answer.get("id") == self._id:
            self._answer = answer

    def _receive_status(self, channel: str, data: bytes) -> None:
        try:
            protected = HubStatistics.from_json(data).protected
        except (ValueError, TypeError, KeyError, AttributeError):
            return  # Not from a hub: on other buses every client may publish here.
        self._owners = {
            name: state.owner for name, state in protected.items() if state.owner not in (None, self._link.name)
        }

    def close(self) -> None:
        """Close the connection."""
        self._link.close()


def watch(
    url: str, addresses: Sequence[str], *, every: int = 1, lease: float = 2.0, timeout: float = 5.0
) -> Iterator[tuple[float, Values]]:
    """Yield the values of variables and vector output ports of a DPS that runs with a `LiveService`, until it ends.

    ::

        for time, values in watch("tcpq://127.0.0.1:7700", ["dps.impl.torque"], every=10):
            print(time, values["dps.impl.torque"])

    When the iteration stops, the watch costs the loop nothing once the lease is over.

    Args:
        url: LCM URL of the bus.
        addresses: Addresses of variables and output ports.
        every: Period in cycles; fewer values come if the loop lacks the time to read all watched values.
        lease: Lease in seconds, which is renewed during the iteration.
        timeout: Seconds without a value after which an error is raised, without the time between two iterations.

    Yields:
        The DPS's time in seconds, and the values by address. Where the loop lacks the time to read all of them in one
        cycle, they are of this and the previous cycles.

    Raises:
        BridgeError: There is no bus.
        LiveError: An address is rejected.
        LiveTimeoutError: No value comes.
        ValueError: The timeout is not positive.
    """
    for now, _, values in _samples(url, addresses, every, lease, timeout):
        yield now, values


def _samples(
    url: str, addresses: Sequence[str], every: int, lease: float, timeout: float, stop: threading.Event | None = None
) -> Iterator[tuple[float, float, Values]]:
    """Yield ``time``, ``since`` and the watched values (see `messages`) until ``stop`` is set."""
    _check_timeout(timeout)
    id = uuid.uuid4().hex
    request = {"id": id, "watch": list(addresses), "every": every, "lease": lease}
    data = _checked(WATCH, request)
    received: deque[dict[str, Any]] = deque()

    def receive(channel: str, data: bytes) -> None:
        message = _json_object(data)
        if channel != WATCH + ANSWER or message.get("id") == id:
            received.append(message)

    link = LcmLink(url, dict.fromkeys((WATCH + ANSWER, WATCHED + id), receive), connect_timeout=_CONNECT_TIMEOUT)
    link.open()
    renewed, last, begun = -np.inf, time.monotonic(), False
    try:
        while stop is None or not stop.is_set():
            now = time.monotonic()
            if now >= renewed + lease / 3:
                link.publish((WATCH, data))
                renewed = now
            link.receive(_SLICE, _BURST)
            while received:
                message = received.popleft()
                last = time.monotonic()
                if "error" in message:
                    raise LiveError(str(message["error"]))
                if "ended" in message:
                    return
                begun = True
                if "values" in message:
                    yield _sample(message, addresses)
                    last = time.monotonic()  # The caller may have taken long: values wait meanwhile.
            if time.monotonic() >= last + timeout:
                if begun and link.connected:
                    raise LiveTimeoutError(
                        f"no value came within {timeout:g} s: the loop stands still, or {every} cycles take longer; "
                        "then choose a longer timeout"
                    )
                raise _no_answer(link, timeout)
    finally:
        link.publish((WATCH, to_json({**request, "watch": []})))
        link.close()


def _sample(message: Mapping[str, Any], addresses: Sequence[str]) -> tuple[float, float, Values]:
    """Return ``time``, ``since`` and the watched values of a message."""
    values = _arrays(message, addresses, WATCHED)
    for name in ("time", "since"):
        if not is_number(message.get(name)):
            raise _invalid(WATCHED, f"a number of seconds in {name!r}", message)
    return message["time"], message["since"], values


class LiveWatch(Closing):
    """A buffer of the newest watched values for plotting; a separate thread receives them.

    ::

        with LiveWatch("tcpq://127.0.0.1:7700", ["dps.impl.torque"], every=10) as live:
            ...
            plt.plot(live.arrays()["time"], live.arrays()["dps.impl.torque"])

    Args:
        url, addresses, every, lease, timeout: See `watch`.
        size: Number of samples that are kept.

    Raises:
        ValueError: The timeout is not positive.
    """

    def __init__(
        self,
        url: str,
        addresses: Sequence[str],
        *,
        size: int = 10_000,
        every: int = 1,
        lease: float = 2.0,
        timeout: float = 5.0,
    ) -> None:
        _check_timeout(timeout)
        self._addresses = tuple(addresses)
        self._samples: deque[tuple[float, float, Values]] = deque(maxlen=size)
        self._error: Exception | None = None
        self._ended = False
        self._stop = threading.Event()
        self._grown = threading.Condition()
        self._count = 0
        arguments = (url, addresses, every, lease, timeout, self._stop)
        self._thread = threading.Thread(target=self._collect, args=arguments, name="vtbdrake-live-watch", daemon=True)
        self._thread.start()

    def _collect(self, *arguments: Any) -> None:
        try:
            for sample in _samples(*arguments):
                with self._grown:
                    self._samples.append(sample)
                    self._count += 1
                    self._grown.notify_all()
        except (LiveError, LiveTimeoutError, BridgeError) as error:
            self._error = error
        with self._grown:
            self._ended = True
            self._grown.notify_all()

    @property
    def alive(self) -> bool:
        """Return whether more values can come."""
        return self._thread.is_alive()

    def wait(self, count: int, *, timeout: float = 10.0) -> None:
        """Wait until ``count`` samples have come in all.

        Args:
            count: Number of samples since the watch began.
            timeout: Longest wait, in s.

        Raises:
            LiveError: The DPS rejects the watch.
            LiveTimeoutError: They do not come within ``timeout`` seconds, or the watch has timed out.
            BridgeError: There is no bus.
        """
        with self._grown:
            arrived = self._grown.wait_for(lambda: self._count >= count or self._ended, timeout)
        self._check()
        if not arrived or self._count < count:
            raise LiveTimeoutError(f"{self._count} of {count} samples came within {timeout} s")

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Return the samples that are kept, the oldest first.

        Returns:
            ``time`` and ``since``, of shape (n,), in seconds, and the values by address, of shape (n, ...). The values
            were read between the cycles of ``since`` and ``time``: in one, if the loop had the time for it.

        Raises:
            LiveError: The DPS has rejected the watch.
            LiveTimeoutError: The watch has timed out.
            BridgeError: There is no bus.
        """
        self._check()
        with self._grown:
            samples = list(self._samples)
        columns = {"time": np.array([time for time, _, _ in samples]), "since": np.array([s for _, s, _ in samples])}
        return columns | {a: np.array([values[a] for _, _, values in samples]) for a in self._addresses}

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """End the watch; the samples that are kept remain."""
        self._stop.set()
        self._thread.join()


# -- checks


def _check_timeout(timeout: float) -> float:
    if not timeout > 0.0:
        raise ValueError(f"the timeout must be a positive number of seconds, not {timeout}")
    return timeout


def _checked(channel: str, message: dict[str, Any]) -> bytes:
    """Return the bytes of a request, or raise the LiveError with which the DPS would reject it."""
    data = to_json(message)
    try:
        parse_request(channel, data)
    except ValueError as error:
        raise LiveError(str(error)) from None
    return data


def _json_object(data: bytes) -> dict[str, Any]:
    """Return the JSON object of an answer, or an empty one: every client of the bus may publish there."""
    try:
        message = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return message if isinstance(message, dict) else {}


def _arrays(message: Mapping[str, Any], addresses: Sequence[str], channel: str) -> Values:
    """Return the values of a message, lists as arrays."""
    values = message.get("values")
    if not isinstance(values, dict) or not set(addresses) <= values.keys():
        raise _invalid(channel, f"the values of {', '.join(addresses)}", message)
    checked: Values = {}
    for address, value in values.items():
        try:
            array = np.array(value)
        except (ValueError, OverflowError):  # ragged, or out of range
            array = np.array(None)
        if array.dtype.kind not in "iuf" and array.size:
            raise _invalid(channel, f"a number or an array of numbers for {address}", value)
        checked[address] = array.astype(float) if isinstance(value, list) else value
    return checked


def _invalid(channel: str, expected: str, got: Any) -> LiveError:
    text = repr(got)
    return LiveError(
        f"an answer on {channel} is not from a DPS of vtbdrake: it should have {expected}, and is "
        f"{text if len(text) <= 100 else text[:100] + '...'}; check which client publishes there"
    )


def _no_answer(link: LcmLink, seconds: float, channel: str = "", owner: str | None = None) -> LiveTimeoutError:
    cause = "does a DPS run there (vtbdrake run)?" if link.connected else "the bus is lost"
    if owner is not None:
        cause = f"the hub lets only {owner} publish on {channel}, which goes on doing so"
    return LiveTimeoutError(f"no answer on {link.url} within {seconds:g} s: {cause}")
