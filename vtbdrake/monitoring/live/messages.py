"""Requests and answers about a running DPS, as JSON on an LCM bus.

========== ===================================================== =======================================
channel    request                                               answer, on the channel ``..._ANSWER``
========== ===================================================== =======================================
VTB_SET    ``{"id": ID, "set": {ADDRESS: VALUE, ...}}``          ``{"id": ID, "ok": true}``
VTB_GET    ``{"id": ID, "get": [ADDRESS, ...]}``                 ``{"id": ID, "ok": true, "time": T, "values": {...}}``
VTB_RESET  ``{"id": ID, "reset": true}``                         ``{"id": ID, "ok": true, "released": [REASON, ...]}``
VTB_STATUS ``{"id": ID, "status": true}``                        ``{"id": ID, "ok": true, "status": {...}}``, see
                                                                 `LoopStatus`
VTB_WATCH  ``{"id": ID, "watch": [ADDRESS, ...], "every": N,     ``{"id": ID, "ok": true}``, and then the values on
           "lease": S}``, again before the lease is over         ``VTB_WATCHED/ID``, every N cycles
========== ===================================================== =======================================

The answer to a rejected request is ``{"id": ID, "error": REASON}``. Watched values are ``{"cycle": K, "since": T0,
"time": T, "values": {...}}``: they were read between the cycles of the DPS's times T0 and T, which are equal if there
was time to read all of them in one cycle. Numbers that are not finite are written as Python's ``json`` does: NaN,
Infinity. An empty list of addresses ends a watch. ``{"id": ID, "ended": true}`` says that the DPS has ended. A reset
releases the latch of the guards, unless a cause persists, and returns the reasons for which it had latched.

Every client of the bus may send requests, and each is answered: what arrives last counts, whoever sends it, whatever
its clock. On a hub that protects VTB_SET (``vtbdrake hub --protect VTB_SET``) one client at a time may publish there,
and an operator waits for as long as a planner goes on.
"""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass
from math import inf, isfinite
from operator import methodcaller
from typing import Any

SET = "VTB_SET"
GET = "VTB_GET"
RESET = "VTB_RESET"
STATUS = "VTB_STATUS"
WATCH = "VTB_WATCH"
WATCHED = "VTB_WATCHED/"
ANSWER = "_ANSWER"

MAX_LENGTH = 1 << 16
"""Limit on the bytes of a request."""
MAX_ADDRESSES = 64
"""Limit on the addresses of a request."""
SHORTEST_LEASE = 0.1
"""Shortest lease, in seconds."""
LONGEST_LEASE = 60.0
"""Longest lease, in seconds."""

_ID = re.compile(r"[\w.:-]{1,40}")


class RequestError(ValueError):
    """A request that is not valid or cannot be fulfilled."""


@dataclass(frozen=True)
class SetRequest:
    """A request to set variables, by address: all of them or none.

    Attributes:
        id: The id of the request, which the answer repeats.
        values: Numbers or lists of numbers, by address.
    """

    id: str
    values: dict[str, Any]


@dataclass(frozen=True)
class ReadRequest:
    """A request to read variables and output ports: once, or every ``every`` cycles for ``lease`` seconds.

    Attributes:
        id: The id of the request, which the answer repeats.
        addresses: The addresses of the variables and ports.
        every: Period in cycles; 0 to read once.
        lease: The time for which values are sent, in seconds; 0 to read once.
    """

    id: str
    addresses: tuple[str, ...]
    every: int = 0
    lease: float = 0.0


@dataclass(frozen=True)
class ResetRequest:
    """A request to release the latch of the guards."""

    id: str


@dataclass(frozen=True)
class StatusRequest:
    """A request to tell how the loop is."""

    id: str


Request = SetRequest | ReadRequest | ResetRequest | StatusRequest


@dataclass(frozen=True)
class LoopStatus:
    """How a loop is between two cycles.

    Attributes:
        time: The time of the DPS, in seconds.
        positions: Positions of the switches, by side (``sense``, ``act``) and signal. The actuator signals of a DPS
            alone are ``idle`` until it commands.
        ages: Time since the last message of each sensor signal arrived, in seconds; infinite before the first one.
        reasons: Why commands do not reach the machine, or why a switch to real would be refused; empty if neither.
        latched: The faults for which the fallbacks command.
        faults: The newest faults and warnings of the guards, each with the seconds since then, the newest first.
    """

    time: float
    positions: dict[str, dict[str, str]]
    ages: dict[str, float]
    reasons: list[str]
    latched: list[str]
    faults: list[tuple[str, float]]


def to_json(message: Any) -> bytes:
    """Return a message as JSON; it may contain arrays of NumPy."""
    return json.dumps(message, separators=(",", ":"), default=methodcaller("tolist")).encode()


def json_object(data: bytes) -> dict[str, Any]:
    """Return the JSON object of a message.

    Raises:
        RequestError: The data are too long, not JSON, or not an object.
    """
    if len(data) > MAX_LENGTH:
        raise RequestError(f"a request must have at most {MAX_LENGTH} bytes, not {len(data)}")
    try:
        message = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise RequestError(f"a request must be JSON: {error}") from None
    if not isinstance(message, dict):
        raise RequestError(f"a request must be a JSON object, not {_short(message)}")
    return message


def request_id(data: bytes) -> str:
    """Return the id of a request, or an empty string if it has no valid one."""
    try:
        id = json_object(data).get("id")
    except RequestError:
        return ""
    return id if isinstance(id, str) and _ID.fullmatch(id) else ""


def parse_request(channel: str, data: bytes) -> Request:
    """Return the request in a message.

    Args:
        channel: The LCM channel of the message, such as ``VTB_SET``.
        data: The content of the message, JSON.

    Raises:
        RequestError: The message is not a valid request.
    """
    try:
        return _request(channel, json_object(data))
    except RecursionError:
        raise RequestError("a request is nested too deep: a value is a number or a list of numbers") from None


def _request(channel: str, message: dict[str, Any]) -> Request:
    id = message.get("id")
    if not isinstance(id, str) or not _ID.fullmatch(id):
        raise RequestError(f"the id must be up to 40 letters, digits and _.:-, not {_short(id)}")
    if channel == SET:
        return SetRequest(id, _values(_field(message, "set")))
    if channel == RESET:
        if _field(message, "reset") is not True:
            raise RequestError(f"reset must be true, not {_short(message['reset'])}")
        return ResetRequest(id)
    if channel == STATUS:
        if _field(message, "status") is not True:
            raise RequestError(f"status must be true, not {_short(message['status'])}")
        return StatusRequest(id)
    if channel == GET:
        return ReadRequest(id, _addresses(_field(message, "get"), least=1))
    addresses = _addresses(_field(message, "watch", "every", "lease"), least=0)
    every, lease = message.get("every", 1), message.get("lease", 2.0)
    if type(every) is not int or every < 1:
        raise RequestError(f"every must be a number of cycles of at least 1, not {_short(every)}")
    if not is_number(lease) or not SHORTEST_LEASE <= lease <= LONGEST_LEASE:
        raise RequestError(f"lease must be {SHORTEST_LEASE:g} to {LONGEST_LEASE:g} s, not {_short(lease)}")
    return ReadRequest(id, addresses, every, lease)


def _field(message: dict[str, Any], name: str, *optional: str) -> Any:
    keys = ("id", name, *optional)
    if name not in message or not message.keys() <= set(keys):
        raise RequestError(f"this request must have {', '.join(keys)}, not {_short(', '.join(message))}")
    return message[name]


def _addresses(addresses: Any, *, least: int) -> tuple[str, ...]:
    if not isinstance(addresses, list) or not all(isinstance(address, str) for address in addresses):
        raise RequestError(f"addresses must be a list of strings, not {_short(addresses)}")
    if not least <= len(addresses) <= MAX_ADDRESSES:
        raise RequestError(f"a request must have {least} to {MAX_ADDRESSES} addresses, not {len(addresses)}")
    return tuple(dict.fromkeys(addresses))


def _values(values: Any) -> dict[str, Any]:
    if not isinstance(values, dict):
        raise RequestError(f"values must be an object of addresses and values, not {_short(values)}")
    if not 1 <= len(values) <= MAX_ADDRESSES:
        raise RequestError(f"a request must have 1 to {MAX_ADDRESSES} values, not {len(values)}")
    for address, value in values.items():
        _check_value(address, value)
    return values


def _check_value(address: str, value: Any) -> None:
    if isinstance(value, list):
        for item in value:
            _check_value(address, item)
        return
    if not is_number(value):
        raise RequestError(f"the value of {address} must be a number or a list of numbers, not {_short(value)}")
    if abs(value) > sys.float_info.max and value not in (inf, -inf):
        raise RequestError(
            f"the value of {address} must lie within +-{sys.float_info.max:.3g}, the largest number, "
            f"unlike {_short(value)}"
        )
    if not isfinite(value):
        raise RequestError(f"the value of {address} must be a finite number or a list of them, not {_short(value)}")


def is_number(value: Any) -> bool:
    """Return whether a JSON value is a number."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
