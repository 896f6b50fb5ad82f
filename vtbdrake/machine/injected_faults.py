"""Injected faults: errors, on request, of the messages between a machine and its controller."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import count
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vtbdrake.common.settings import check_settings, setting

SENSE = "sense"
ACT = "act"


class InjectedFaultError(ValueError):
    """A request for a fault that does not exist, or with impossible values."""


class Packet(NamedTuple):
    """A message on its way.

    Attributes:
        channel: The LCM channel.
        type: The message type, a class made by lcm-gen.
        data: The bytes.
        due: The cycle of the machine in which it arrives.
    """

    channel: str
    type: Any
    data: bytes
    due: int


Effect = Callable[[Packet], Iterable[Packet]]
"""A function from a packet to the packets that arrive instead, in this order."""


def _bits(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    corrupted = np.frombuffer(data, np.uint8).copy()
    flipped = random.choice(8 * len(data), size=int(random.integers(1, 9)), replace=False)
    np.bitwise_xor.at(corrupted, flipped // 8, (1 << (flipped % 8)).astype(np.uint8))
    return corrupted.tobytes()


def _nan(message_type: Any, data: bytes, random: np.random.Generator) -> bytes:
    try:
        message = message_type.decode(data)
    except Exception:  # Another fault has corrupted it.
        return data
    return bytes(_with_nan(message, "").encode())


def _with_nan(value: Any, typename: str) -> Any:
    """Return a message, a field of the type ``typename``, or a list of these, with NaN for floating-point numbers."""
    if isinstance(value, list | tuple):
        return [_with_nan(entry, typename) for entry in value]
    if hasattr(value, "__typenames__"):
        for name, kind in zip(value.__slots__, value.__typenames__, strict=True):
            setattr(value, name, _with_nan(getattr(value, name), kind))
        return value
    return math.nan if typename in ("double", "float") else value


CORRUPTIONS: dict[str, Callable[[Any, bytes, np.random.Generator], bytes]] = {
    "bits": _bits,
    "truncate": lambda _, data, random: data[: int(random.integers(0, len(data)))],
    "trailing": lambda _, data, random: data + random.bytes(int(random.integers(1, 65))),
    "random": lambda _, data, random: random.bytes(len(data)),
    "type": lambda _, data, random: bytes([data[0] ^ 0xFF]) + data[1:],  # No other type has a fingerprint so close.
    "nan": _nan,
}
"""Functions from a message's type, its bytes and a source of random numbers to the corrupted bytes.

``bits``: one to eight bits are flipped; ``truncate``: the end is missing, from the last byte to all; ``trailing``: 1 to
64 random bytes follow; ``random``: all bytes are random; ``type``: the fingerprint is wrong; ``nan``: every
floating-point number is NaN.
"""


@dataclass(frozen=True, kw_only=True)
class InjectedFault:
    """One thing that goes wrong with messages until it is ended."""

    name: ClassVar[str]
    sides: ClassVar[Sequence[str]] = (SENSE, ACT)

    side: str = setting(SENSE, "Messages that the machine sends, or those that it receives.", choices=(SENSE, ACT))
    channels: Sequence[str] = setting((), "The channels that are affected; all of that side if empty.")

    def __post_init__(self) -> None:
        check_settings(self, name=self.name, error=InjectedFaultError)
        if self.side not in self.sides:
            raise InjectedFaultError(f"{self.name}.side must be {' or '.join(self.sides)}, not {self.side!r}")
        object.__setattr__(self, "channels", tuple(self.channels))

    def effect(self, random: np.random.Generator, period: float) -> Effect:
        """Return the effect on the packets of the channels, from now on.

        Args:
            random: The source of random numbers.
            period: The period of the machine's cycles, in seconds.
        """
        return lambda packet: (packet,)

    def affects(self, channel: str) -> bool:
        """Return whether a channel of the fault's side is affected."""
        return not self.channels or channel in self.channels

    def to_dict(self) -> dict[str, Any]:
        """Return the fault as plain data for JSON, which `fault_from_dict` reads."""
        return {"fault": self.name, **asdict(self), "channels": list(self.channels)}


@dataclass(frozen=True, kw_only=True)
class ClockJump(InjectedFault):
    """The time in the messages is wrong by ``seconds``; the machine adds it when it makes them."""

    name = "clock_jump"
    sides = (SENSE,)
    seconds: float = setting(doc="The error of the time.", unit="s", ge=-1e9, le=1e9)


@dataclass(frozen=True, kw_only=True)
class NoBrake(InjectedFault):
    """The machine does not brake when commands stop: it goes on with the last ones."""

    name = "no_brake"
    sides = (SENSE,)


@dataclass(frozen=True, kw_only=True)
class OwnStop(InjectedFault):
    """Somebody presses the machine's own stop: it brakes and takes no command, until the fault is ended."""

    name = "own_stop"
    sides = (SENSE,)


@dataclass(frozen=True, kw_only=True)
class Freeze(InjectedFault):
    """The first message on a channel is repeated, byte for byte, in place of all that follow."""

    name = "freeze"

    def effect(self, random: np.random.Generator, period: float) -> Effect:
        frozen: dict[str, bytes] = {}
        return lambda packet: (packet._replace(data=frozen.setdefault(packet.channel, packet.data)),)


@dataclass(frozen=True, kw_only=True)
class Corrupt(InjectedFault):
    """Messages arrive corrupted."""

    name = "corrupt"
    kind: str = setting("bits", "What happens to the bytes, see `CORRUPTIONS`.", choices=tuple(CORRUPTIONS))
    fraction: float = setting(1.0, "The probability for each message.", ge=0.0, le=1.0)

    def effect(self, random: np.random.Generator, period: float) -> Effect:
        corrupt = CORRUPTIONS[self.kind]

        def effect(packet: Packet) -> Iterable[Packet]:
            if random.random() >= self.fraction:
                return (packet,)
            return (packet._replace(data=corrupt(packet.type, packet.data, random)),)

        return effect


@dataclass(frozen=True, kw_only=True)
class Duplicate(InjectedFault):
    """Every message arrives again, ``copies`` times."""

    name = "duplicate"
    copies: int = setting(1, "How often a message arrives again.", ge=1, le=1000)

    def effect(self, random: np.random.Generator, period: float) -> Effect:
        return lambda packet: (packet,) * (1 + self.copies)


@dataclass(frozen=True, kw_only=True)
class Drop(InjectedFault):
    """Messages are lost, each with the probability ``fraction``."""

    name = "drop"
    fraction: float = setting(1.0, "The probability for each message.", ge=0.0, le=1.0)

    def effect(self, random: np.random.Generator, period: float) -> Effect:
        return lambda packet: () if random.random() < self.fraction else (packet,)


@dataclass(frozen=True, kw_only=True)
class Delay(InjectedFault):
    """Messages arrive ``seconds`` later, in whole cycles of the machine, rounded up."""

    name = "delay"
    seconds: float = setting(doc="The delay.", unit="s", ge=0.0, le=1e6)

    def effect(self, random: np.random.Generator, period: float) -> Effect:
        cycles = whole_cycles(self.seconds, period)
        return lambda packet: (packet._replace(due=packet.due + cycles),)


@dataclass(frozen=True, kw_only=True)
class Reorder(InjectedFault):
    """Every two messages of a channel are swapped: the second arrives first, and the first right after it.

    A message that waits for its partner when the fault ends is lost.
    """

    name = "reorder"

    def effect(self, random: np.random.Generator, period: float) -> Effect:
        waiting: dict[str, Packet] = {}

        def effect(packet: Packet) -> Iterable[Packet]:
            first = waiting.pop(packet.channel, None)
            if first is None:
                waiting[packet.channel] = packet
                return ()
            return (packet, first._replace(due=packet.due))

        return effect


# Several faults act in this order.
FAULTS: dict[str, type[InjectedFault]] = {
    kind.name: kind for kind in (ClockJump, NoBrake, OwnStop, Freeze, Corrupt, Duplicate, Drop, Delay, Reorder)
}


def fault_from_dict(data: Mapping[str, Any]) -> InjectedFault:
    """Return the fault that plain data describe, such as ``{"fault": "drop", "fraction": 0.5}``.

    Raises:
        InjectedFaultError: There is no such fault, or it has no such fields or values.
    """
    name = data.get("fault")
    kind = FAULTS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise InjectedFaultError(f"a fault must be one of {', '.join(FAULTS)}, not {name!r}")
    values = {key: value for key, value in data.items() if key != "fault"}
    names = [item.name for item in fields(kind)]
    if unknown := sorted(map(str, values.keys() - set(names))):
        raise InjectedFaultError(f"the fault {name} has no {', '.join(unknown)}; it has: {', '.join(names)}")
    try:
        return kind(**values)
    except TypeError as error:
        raise InjectedFaultError(f"the fault {name} is not complete: {error}") from None


def whole_cycles(seconds: float, period: float) -> int:
    """Return a time as a number of cycles, rounded up (but 0.003 s are three cycles of 0.001 s).

    Args:
        seconds: The time, in s.
        period: The period of the machine's cycles, in s.
    """
    return math.ceil(seconds / period - 1e-6)


class DelayLine:
    """One direction between a machine and its controller: a latency, and the faults that have begun.

    Args:
        delay: The latency of every packet without faults, in cycles.
        period: The period of a cycle, in seconds.
        random: The source of random numbers of the faults.
    """

    def __init__(self, *, delay: int, period: float, random: np.random.Generator) -> None:
        self.faults: dict[str, InjectedFault] = {}  # the faults that have begun, by name
        self._effects: dict[str, Effect] = {}
        self._delay = delay
        self._period = period
        self._random = random
        self._waiting: list[tuple[int, int, Packet]] = []
        self._numbers = count()

    def begin(self, fault: InjectedFault) -> None:
        """Begin a fault, in place of one of the same name."""
        self.faults[fault.name] = fault
        self._effects[fault.name] = fault.effect(self._random, self._period)

    def end_faults(self) -> None:
        """End all faults. Packets that are on their way arrive when they are due."""
        self.faults.clear()
        self._effects.clear()

    def clock_error(self, channel: str) -> float:
        """Return the time in seconds by which the time in messages on ``channel`` is wrong."""
        jump = self.faults.get(ClockJump.name)
        return jump.seconds if isinstance(jump, ClockJump) and jump.affects(channel) else 0.0

    def send(self, packet: Packet) -> None:
        """Take a packet, whose ``due`` is the present cycle."""
        packets = [packet]
        for name in FAULTS:
            if name in self.faults and self.faults[name].affects(packet.channel):
                packets = [arrived for sent in packets for arrived in self._effects[name](sent)]
        for sent in packets:
            due = sent.due + self._delay
            heapq.heappush(self._waiting, (due, next(self._numbers), sent._replace(due=due)))

    def arrivals(self, cycle: int) -> list[Packet]:
        """Return the packets that arrive up to ``cycle``, in order."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= cycle:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived
