"""What is said on the bus about a running DPS, as JSON.

========== ===================================================== =======================================
channel    request                                               answer, on the channel ``..._ANSWER``
========== ===================================================== =======================================
VTB_SET    ``{"id": ID, "set": {ADDRESS: VALUE, ...}}``          ``{"id": ID, "ok": true}``
VTB_GET    ``{"id": ID, "get": [ADDRESS, ...]}``                 ``{"id": ID, "ok": true, "time": T, "values": {...}}``
VTB_RESET  ``{"id": ID, "reset": true}``                         ``{"id": ID, "ok": true, "released": [REASON, ...]}``
VTB_WATCH  ``{"id": ID, "watch": [ADDRESS, ...], "every": N,     ``{"id": ID, "ok": true}``, and then the values on
           "lease": S}``, again before the lease is over         ``VTB_WATCHED/ID``, every N cycles
========== ===================================================== =======================================

Who is refused gets ``{"id": ID, "error": REASON}``. Values watched are ``{"cycle": K, "since": T0, "time": T, "values":
{...}}``: read between the cycles of the DPS's times T0 and T, which are one and the same as long as there is time for
all of them in one cycle. What is not finite is there as Python's ``json`` writes and reads it: NaN, Infinity. Who
watches nothing (an empty list) has ended. ``{"id": ID, "ended": true}`` tells that the DPS has. A reset releases the
latch of the guards, unless a cause persists; what it had latched for is told.

Whoever is on the bus may say these things. ``vtbdrake hub`` protects VTB_SET and VTB_RESET: one client at a time uses
them, the next one half a second later.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from operator import methodcaller
from typing import Any

from vtbdrake.control.json_object import json_object

SET, GET, RESET, WATCH = "VTB_SET", "VTB_GET", "VTB_RESET", "VTB_WATCH"
WATCHED = "VTB_WATCHED/"
ANSWER = "_ANSWER"

MAX_LENGTH = 1 << 16
"""Of a request, in bytes."""
MAX_ADDRESSES = 64
"""Of a request."""
SHORTEST_LEASE, LONGEST_LEASE = 0.1, 60.0
"""In seconds."""

_ID = re.compile(r"[\w.:-]{1,40}")


class RequestError(ValueError):
    """A request that cannot be fulfilled."""


@dataclass(frozen=True)
class SetRequest:
    """Wants variables to be set, by address, all of them or none."""

    id: str
    values: dict[str, Any]


@dataclass(frozen=True)
class ReadRequest:
    """Wants variables and output ports to be read: once, or every so many cycles for ``lease`` seconds.

    Attributes:
        every: 0 for once.
    """

    id: str
    addresses: tuple[str, ...]
    every: int = 0
    lease: float = 0.0


@dataclass(frozen=True)
class ResetRequest:
    """Wants the latch of the guards released."""

    id: str


Request = SetRequest | ReadRequest | ResetRequest


def to_json(message: Any) -> bytes:
    """The bytes of a message; it may hold arrays of numpy."""
    return json.dumps(message, separators=(",", ":"), default=methodcaller("tolist")).encode()


def parse_id(data: bytes) -> str:
    """Whose request this is; empty if that cannot be made out."""
    try:
        found = _parsed(data).get("id")
    except RequestError:
        return ""
    return found if isinstance(found, str) and _ID.fullmatch(found) else ""


def parse(channel: str, data: bytes) -> Request:
    """
    Raises:
        RequestError: it is none.
    """
    try:
        return _request(channel, data)
    except RecursionError:
        raise RequestError("a request is nested too deep: a value is a number, or a list of such") from None


def _request(channel: str, data: bytes) -> Request:
    message = _parsed(data)
    id = message.get("id")
    if not isinstance(id, str) or not _ID.fullmatch(id):
        raise RequestError(f"a request has an id of up to 40 letters, digits and _.:-, not {_short(id)}")
    if channel == SET:
        return SetRequest(id, _values(_only(message, "set")))
    if channel == RESET:
        if _only(message, "reset") is not True:
            raise RequestError(f"reset is true, not {_short(message['reset'])}")
        return ResetRequest(id)
    if channel == GET:
        return ReadRequest(id, _addresses(_only(message, "get"), least=1))
    addresses = _addresses(_only(message, "watch", "every", "lease"), least=0)
    every, lease = message.get("every", 1), message.get("lease", 2.0)
    if type(every) is not int or every < 1:
        raise RequestError(f"every is a number of cycles, 1 or more, not {_short(every)}")
    if not _is_number(lease) or not SHORTEST_LEASE <= lease <= LONGEST_LEASE:
        raise RequestError(f"lease lies in {SHORTEST_LEASE:g} to {LONGEST_LEASE:g} s, not at {_short(lease)}")
    return ReadRequest(id, addresses, every, lease)


def _parsed(data: bytes) -> dict[str, Any]:
    if len(data) > MAX_LENGTH:
        raise RequestError(f"a request has at most {MAX_LENGTH} bytes, not {len(data)}")
    return json_object(data, RequestError, show=_short)


def _only(message: dict[str, Any], what: str, *others: str) -> Any:
    known = ("id", what, *others)
    if what not in message or not message.keys() <= set(known):
        raise RequestError(f"this request has {', '.join(known)}, not {_short(', '.join(message))}")
    return message[what]


def _addresses(given: Any, *, least: int) -> tuple[str, ...]:
    if not isinstance(given, list) or not all(isinstance(address, str) for address in given):
        raise RequestError(f"addresses are a list of texts, not {_short(given)}")
    if not least <= len(given) <= MAX_ADDRESSES:
        raise RequestError(f"a request has {least} to {MAX_ADDRESSES} addresses, not {len(given)}")
    return tuple(dict.fromkeys(given))


def _values(given: Any) -> dict[str, Any]:
    if not isinstance(given, dict):
        raise RequestError(f"values are given by address, not as {_short(given)}")
    if not 1 <= len(given) <= MAX_ADDRESSES:
        raise RequestError(f"a request has 1 to {MAX_ADDRESSES} values, not {len(given)}")
    for address, value in given.items():
        _check_value(address, value)
    return given


def _check_value(address: str, value: Any) -> None:
    if isinstance(value, list):
        for item in value:
            _check_value(address, item)
    elif not _is_number(value):
        raise RequestError(f"the value of {address} is a finite number or a list of such, not {_short(value)}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e308 and isfinite(value)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."


def nested(entries: Sequence[float], shape: Sequence[int]) -> Any:
    """Entries in C order as nested lists of a shape; a number, if that is ()."""
    if not shape:
        return entries[0]
    size = len(entries) // shape[0] if shape[0] else 0
    return [nested(entries[k * size : (k + 1) * size], shape[1:]) for k in range(shape[0])]
