"""Faults of the lines between a machine and its controller: each does one thing to messages, given as bytes."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, NamedTuple

import numpy as np

from vtbdrake.machine.damage import DAMAGE

SENSE, ACT = "sense", "act"


class InjectedFaultError(ValueError):
    """A fault that does not exist, or is told something that it cannot do."""


class Packet(NamedTuple):
    """A message on its way.

    Attributes:
        channel: its channel.
        type: what it is one of, a class made by lcm-gen.
        data: its bytes.
        due: the cycle of the machine in which it arrives.
    """

    channel: str
    type: Any
    data: bytes
    due: int


Effect = Callable[[Packet], Iterable[Packet]]
"""What arrives instead of a packet, in this order."""


@dataclass(frozen=True, kw_only=True)
class InjectedFault(ABC):
    """One thing that goes wrong with messages until it is ended.

    Attributes:
        side: ``sense``: of what the machine sends; ``act``: of what it receives.
        channels: those that are affected; all of that side if empty.
    """

    name: ClassVar[str]

    side: str = SENSE
    channels: Sequence[str] = ()

    def __post_init__(self) -> None:
        if self.side not in (SENSE, ACT):
            raise InjectedFaultError(f"the side of the fault {self.name} is {SENSE} or {ACT}, not {self.side!r}")
        if isinstance(self.channels, str):
            raise InjectedFaultError(f"the fault {self.name} takes a list of channels, such as [{self.channels!r}]")
        object.__setattr__(self, "channels", tuple(self.channels))
        self.check()

    def check(self) -> None:  # noqa: B027 (most faults have nothing to check)
        """
        Raises:
            InjectedFaultError: a value is out of its range.
        """

    @abstractmethod
    def begin(self, random: np.random.Generator, period: float) -> Effect:
        """Its effect from now on, on the packets of its channels, at a machine with cycles of ``period`` seconds."""

    def to_dict(self) -> dict[str, Any]:
        """Plain data, fit for JSON; `fault_from_dict` reads it."""
        return {"fault": self.name, **asdict(self), "channels": list(self.channels)}

    def _check_range(self, name: str, lower: float, upper: float) -> None:
        value = getattr(self, name)
        if isinstance(value, bool) or not isinstance(value, int | float) or not lower <= value <= upper:
            raise InjectedFaultError(
                f"{name} of the fault {self.name} lies between {lower:g} and {upper:g}, not at {value!r}"
            )


@dataclass(frozen=True, kw_only=True)
class Freeze(InjectedFault):
    """The first message on a channel is repeated, byte for byte, in place of all that follow."""

    name = "freeze"

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        held: dict[str, bytes] = {}
        return lambda packet: (packet._replace(data=held.setdefault(packet.channel, packet.data)),)


@dataclass(frozen=True, kw_only=True)
class Corrupt(InjectedFault):
    """Messages arrive damaged.

    Attributes:
        kind: one of `DAMAGE`, see there.
        fraction: the probability of each to be damaged.
    """

    name = "corrupt"
    kind: str = "bits"
    fraction: float = 1.0

    def check(self) -> None:
        self._check_range("fraction", 0.0, 1.0)
        if self.kind not in DAMAGE:
            raise InjectedFaultError(f"the kind of corruption is one of {', '.join(DAMAGE)}, not {self.kind!r}")

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        damage = DAMAGE[self.kind]

        def effect(packet: Packet) -> Iterable[Packet]:
            if random.random() >= self.fraction:
                return (packet,)
            return (packet._replace(data=damage(packet.type, packet.data, random)),)

        return effect


@dataclass(frozen=True, kw_only=True)
class Duplicate(InjectedFault):
    """Every message arrives ``copies`` times more."""

    name = "duplicate"
    copies: int = 1

    def check(self) -> None:
        self._check_range("copies", 1, 1000)
        if not isinstance(self.copies, int):
            raise InjectedFaultError(f"copies of the fault {self.name} is a whole number, not {self.copies!r}")

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        return lambda packet: (packet,) * (1 + self.copies)


@dataclass(frozen=True, kw_only=True)
class Drop(InjectedFault):
    """Messages are lost, each with the probability ``fraction``."""

    name = "drop"
    fraction: float = 1.0

    def check(self) -> None:
        self._check_range("fraction", 0.0, 1.0)

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        return lambda packet: () if random.random() < self.fraction else (packet,)


@dataclass(frozen=True, kw_only=True)
class Delay(InjectedFault):
    """Messages arrive ``seconds`` later, in whole cycles of the machine, rounded up."""

    name = "delay"
    seconds: float

    def check(self) -> None:
        self._check_range("seconds", 0.0, 1e6)

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        cycles = whole_cycles(self.seconds, period)
        return lambda packet: (packet._replace(due=packet.due + cycles),)


@dataclass(frozen=True, kw_only=True)
class Reorder(InjectedFault):
    """Of every two messages of a channel the second arrives first, and the first right after it.

    One that waits for its partner when the fault ends is lost.
    """

    name = "reorder"

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        held: dict[str, Packet] = {}

        def effect(packet: Packet) -> Iterable[Packet]:
            first = held.pop(packet.channel, None)
            if first is None:
                held[packet.channel] = packet
                return ()
            return (packet, first._replace(due=packet.due))

        return effect


@dataclass(frozen=True, kw_only=True)
class ClockJump(InjectedFault):
    """The time that messages tell is wrong by ``seconds``; it is the machine's own, so the side is ``sense``."""

    name = "clock_jump"
    seconds: float

    def check(self) -> None:
        self._check_range("seconds", -1e9, 1e9)
        _only_sense(self)

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        # The line adds it to the time before a message is made.
        return lambda packet: (packet,)


@dataclass(frozen=True, kw_only=True)
class NoBrake(InjectedFault):
    """The machine does not brake when commands stop: it goes on with the last ones."""

    name = "no_brake"

    def check(self) -> None:
        _only_sense(self)

    def begin(self, random: np.random.Generator, period: float) -> Effect:
        return lambda packet: (packet,)


def _only_sense(fault: InjectedFault) -> None:
    if fault.side != SENSE:
        raise InjectedFaultError(
            f"the fault {fault.name} is not one of received messages: leave out side={fault.side!r}"
        )


# In the order in which they act where there are several.
FAULTS: dict[str, type[InjectedFault]] = {
    kind.name: kind for kind in (ClockJump, NoBrake, Freeze, Corrupt, Duplicate, Drop, Delay, Reorder)
}


def fault_from_dict(data: Mapping[str, Any]) -> InjectedFault:
    """What `InjectedFault.to_dict` gave, or somebody wrote: ``{"fault": "drop", "fraction": 0.5}``.

    Raises:
        InjectedFaultError: there is no such fault, or it does not take this.
    """
    name = data.get("fault")
    kind = FAULTS.get(name) if isinstance(name, str) else None
    if kind is None:
        raise InjectedFaultError(f"a fault is one of {', '.join(FAULTS)}, not {name!r}")
    given = {key: value for key, value in data.items() if key != "fault"}
    known = [item.name for item in fields(kind)]
    if unknown := sorted(map(str, given.keys() - set(known))):
        raise InjectedFaultError(f"the fault {name} takes {', '.join(known)}, not {', '.join(unknown)}")
    try:
        return kind(**given)
    except TypeError as error:
        raise InjectedFaultError(f"the fault {name} is not complete: {error}") from None


def whole_cycles(seconds: float, period: float) -> int:
    """How many cycles that is, rounded up (but 0.003 s are three cycles of 0.001 s)."""
    return math.ceil(seconds / period - 1e-6)
