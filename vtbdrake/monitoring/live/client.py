"""The part of those who set, read, watch and reset what runs in another process."""

from __future__ import annotations

import threading
import time
import uuid
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vtbdrake.control.json_object import json_object
from vtbdrake.lcm.connections import LcmLink
from vtbdrake.lcm.hub import STATUS_CHANNEL, TAKE_PREFIX, HubStatistics
from vtbdrake.monitoring.live.messages import ANSWER, GET, RESET, SET, WATCH, WATCHED, parse, to_json

_CONNECT_TIMEOUT = 2.0  # s
_BURST = 1000  # messages to take in at a time
_SLICE = 0.05  # s; longest wait for a message before looking at the clock
_REPEAT = 0.5  # s after which a request is said again
_TAKE_AGAIN = 0.05  # s after which a channel that belongs to somebody else is asked for again

Values = dict[str, float | NDArray[np.float64]]


class LiveError(ValueError):
    """The DPS refuses what it is asked for, or somebody else on the bus gives an answer that a DPS would not."""


class SilenceError(TimeoutError):
    """Nobody answers."""


class LiveClient:
    """Sets and reads variables of a DPS that runs with a `LiveService`, and resets its guards.

    ::

        with LiveClient("tcpq://127.0.0.1:7700") as dps:
            dps.set({"dps.impl.stiffness": 200.0})

    Args:
        url: the bus.
        timeout: seconds to wait for an answer.

    Raises:
        BridgeError: there is no bus.
        ValueError: the timeout is no positive number.
    """

    def __init__(self, url: str, *, timeout: float = 5.0) -> None:
        self._timeout = check_timeout(timeout)
        self._answers: dict[str, dict[str, Any]] = {}
        self._waiting = ""
        self._asked = -np.inf
        self._owners: dict[str, str] = {}  # of the channels that a hub protects, and that others own
        handlers = dict.fromkeys([channel + ANSWER for channel in (SET, GET, RESET)], self._hear)
        self._link = LcmLink(url, {**handlers, STATUS_CHANNEL: self._hear_status}, connect_timeout=_CONNECT_TIMEOUT)
        self._link.open()

    def set(self, values: Mapping[str, ArrayLike]) -> None:
        """Sets variables by address, all of them or none.

        Raises:
            LiveError: one of them is refused.
            SilenceError: nobody answers; they may have been set or not.
        """
        self._ask(SET, {"set": dict(values)})

    def get(self, addresses: Iterable[str]) -> Values:
        """The present values of variables and vector output ports, by address.

        Raises:
            LiveError: one of them is refused.
            SilenceError: nobody answers.
        """
        addresses = list(addresses)
        return to_arrays(_values(self._ask(GET, {"get": addresses}), addresses, GET))

    def reset(self) -> list[str]:
        """Releases the latch of the guards; what they had latched for, empty if they had not.

        Raises:
            LiveError: a cause persists; the fallbacks go on.
            SilenceError: nobody answers; it may have been released or not.
        """
        answer = self._ask(RESET, {"reset": True})
        released = answer.get("released")
        if not isinstance(released, list) or not all(isinstance(reason, str) for reason in released):
            raise _no_answer(RESET, "the list of reasons in 'released'", answer)
        return released

    def _ask(self, channel: str, request: dict[str, Any]) -> dict[str, Any]:
        self._waiting = _new_id()
        message = {"id": self._waiting, **request}
        limit, self._asked = time.monotonic() + self._timeout, -np.inf
        while self._waiting not in self._answers:
            now = time.monotonic()
            if now >= limit:
                raise _silence(self._link, self._timeout, channel, self._owners.get(channel))
            if channel in self._owners and now >= self._asked + _TAKE_AGAIN:
                # The hub refuses as long as the other one goes on publishing.
                self._link.publish((TAKE_PREFIX + channel, b""))
                self._asked = -np.inf
                del self._owners[channel]
            if now >= self._asked + _REPEAT:
                # Who begins to serve just now has not heard it; who has, knows it by its id.
                _publish(self._link, channel, message)
                self._asked = now
            self._link.take(_SLICE, _BURST)
        answer = self._answers.pop(self._waiting)
        if "error" in answer:
            raise LiveError(str(answer["error"]))
        if answer.get("ok") is not True:
            raise _no_answer(channel, "'ok' or an error", answer)
        return answer

    def _hear(self, channel: str, data: bytes) -> None:
        answer = _answer(data)
        if answer.get("id") == self._waiting:
            self._answers[self._waiting] = answer

    def _hear_status(self, channel: str, data: bytes) -> None:
        try:
            protected = HubStatistics.from_json(data).protected
        except (ValueError, TypeError, KeyError, AttributeError):
            return  # Not of a hub; on other buses anybody may say it.
        self._owners = {
            name: state.owner for name, state in protected.items() if state.owner not in (None, self._link.name)
        }

    def close(self) -> None:
        """Gives the connection back."""
        self._link.close()

    def __enter__(self) -> LiveClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def watch(
    url: str, addresses: Sequence[str], *, every: int = 1, lease: float = 2.0, timeout: float = 5.0
) -> Iterator[tuple[float, Values]]:
    """The values of variables and vector output ports of a DPS that runs with a `LiveService`, as time goes on.

    ::

        for time, values in watch("tcpq://127.0.0.1:7700", ["dps.impl.torque"], every=10):
            print(time, values["dps.impl.torque"])

    It ends when the DPS does. Who no longer iterates costs the loop nothing once the lease is over.

    Args:
        url: the bus.
        addresses: what to watch.
        every: so many cycles; fewer values come where the loop lacks the time to read all that is watched.
        lease: seconds, renewed as long as one iterates.
        timeout: seconds without a value after which one gives up.

    Yields:
        The DPS's time in seconds, and the values by address. Where the loop lacks the time to read all of them in one
        cycle, they are of this and the cycles before.

    Raises:
        BridgeError: there is no bus.
        LiveError: an address is refused.
        SilenceError: nothing comes.
        ValueError: the timeout is no positive number.
    """
    for message in samples(url, addresses, every, lease, timeout):
        yield message["time"], to_arrays(message["values"])


def samples(
    url: str, addresses: Sequence[str], every: int, lease: float, timeout: float, stop: threading.Event | None = None
) -> Iterator[dict[str, Any]]:
    """As `watch`, with all that is told beside the values, until ``stop`` is set; see `messages`."""
    check_timeout(timeout)
    request = {"id": _new_id(), "watch": list(addresses), "every": every, "lease": lease}
    _checked(WATCH, request)
    received: deque[dict[str, Any]] = deque()

    def hear(channel: str, data: bytes) -> None:
        message = _answer(data)
        if channel != WATCH + ANSWER or message.get("id") == request["id"]:
            received.append(message)

    channels = (WATCH + ANSWER, f"{WATCHED}{request['id']}")
    link = LcmLink(url, dict.fromkeys(channels, hear), connect_timeout=_CONNECT_TIMEOUT)
    link.open()
    renewed, heard, begun = -np.inf, time.monotonic(), False
    try:
        while stop is None or not stop.is_set():
            now = time.monotonic()
            if now >= renewed + lease / 3:
                _publish(link, WATCH, request)
                renewed = now
            link.take(_SLICE, _BURST)
            while received:
                message = received.popleft()
                heard = time.monotonic()
                if "error" in message:
                    raise LiveError(str(message["error"]))
                if "ended" in message:
                    return
                begun = True
                if "values" in message:
                    _check_sample(message, addresses)
                    yield message
            if time.monotonic() >= heard + timeout:
                if begun and link.connected:
                    raise SilenceError(
                        f"no value has come for {timeout:g} s: the loop stands still, or {every} cycles of it take "
                        "longer; then choose a longer timeout"
                    )
                raise _silence(link, timeout)
    finally:
        link.publish((WATCH, to_json({**request, "watch": []})))
        link.close()


def _publish(link: LcmLink, channel: str, message: dict[str, Any]) -> None:
    """
    Raises:
        LiveError: the DPS would refuse it anyway.
    """
    link.publish((channel, _checked(channel, message)))


def _checked(channel: str, message: dict[str, Any]) -> bytes:
    """Return the bytes of a request.

    Raises:
        LiveError: the DPS would refuse it anyway.
    """
    data = to_json(message)
    try:
        parse(channel, data)
    except ValueError as error:
        raise LiveError(str(error)) from None
    return data


def check_timeout(timeout: float) -> float:
    """Return ``timeout``.

    Raises:
        ValueError: it is no positive number of seconds.
    """
    if not timeout > 0.0:
        raise ValueError(f"the timeout is a positive time in seconds, not {timeout}")
    return timeout


def _answer(data: bytes) -> dict[str, Any]:
    """Return what is said on a channel of answers; empty if it is no JSON object, as whoever is on the bus may say."""
    try:
        return json_object(data, ValueError)
    except ValueError:
        return {}


def _values(message: Mapping[str, Any], addresses: Sequence[str], channel: str) -> dict[str, Any]:
    """Return the values of a message, by address.

    Raises:
        LiveError: they are not those of the addresses, or one of them is no number and no array of numbers.
    """
    values = message.get("values")
    if not isinstance(values, dict) or not set(addresses) <= values.keys():
        raise _no_answer(channel, f"the values of {', '.join(addresses)}", message)
    for address, value in values.items():
        if not _is_array(value):
            raise _no_answer(channel, f"a number or an array of numbers for {address}", value)
    return values


def _check_sample(message: Mapping[str, Any], addresses: Sequence[str]) -> None:
    """
    Raises:
        LiveError: a message of watched values is none.
    """
    _values(message, addresses, WATCHED)
    for name in ("time", "since"):
        if not _is_number(message.get(name)):
            raise _no_answer(WATCHED, f"a number of seconds in {name!r}", message)


def _is_array(value: Any) -> bool:
    """Whether this is a number, or a rectangular list of lists of numbers; NaN and infinity are numbers here."""
    try:
        array = np.array(value)
    except (ValueError, OverflowError):
        return False  # It is ragged.
    return array.dtype.kind in "iuf" or array.size == 0


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _no_answer(channel: str, expected: str, got: Any) -> LiveError:
    text = repr(got)
    return LiveError(
        f"what answered on {channel} is no DPS of vtbdrake: its answer should have {expected}, and is "
        f"{text if len(text) <= 100 else text[:100] + '...'}; see who publishes there"
    )


def _silence(link: LcmLink, seconds: float, channel: str = "", owner: str | None = None) -> SilenceError:
    what = "does a DPS run there (vtbdrake run)?" if link.connected else "the bus is lost"
    if owner is not None:
        what = f"the hub lets {owner} alone publish on {channel}, which goes on doing so"
    return SilenceError(f"nobody has answered on {link.url} for {seconds:g} s: {what}")


def _new_id() -> str:
    return uuid.uuid4().hex


def to_arrays(values: Mapping[str, Any]) -> Values:
    """Lists become arrays."""
    return {a: np.array(value, dtype=float) if isinstance(value, list) else value for a, value in values.items()}
