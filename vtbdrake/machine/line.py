"""One direction of the way between a machine and its controller, with what goes wrong on it."""

from __future__ import annotations

import heapq
from itertools import count

import numpy as np

from vtbdrake.machine.faults import FAULTS, ClockJump, Effect, InjectedFault, Packet


class Line:
    """Carries packets, with a delay, and through all faults that have begun.

    Attributes:
        side: ``sense`` or ``act``: the faults of the other side are not its own.
        faults: those that have begun, by name.
    """

    def __init__(self, side: str, *, delay: int, period: float, random: np.random.Generator) -> None:
        """
        Args:
            delay: in cycles, on top of that of faults.
            period: of a cycle, in seconds.
        """
        self.side = side
        self.faults: dict[str, InjectedFault] = {}
        self._effects: list[tuple[InjectedFault, Effect]] = []
        self._delay = delay
        self._period = period
        self._random = random
        self._waiting: list[tuple[int, int, Packet]] = []
        self._numbers = count()

    def begin(self, fault: InjectedFault) -> None:
        """Begins a fault; it takes the place of one of the same name."""
        self.faults[fault.name] = fault
        effect = fault.begin(self._random, self._period)
        effects = [(other, its) for other, its in self._effects if other.name != fault.name]
        order = list(FAULTS)
        self._effects = sorted([*effects, (fault, effect)], key=lambda entry: order.index(entry[0].name))

    def end(self) -> None:
        """Ends all faults. What is on its way arrives when it is due."""
        self.faults.clear()
        self._effects.clear()

    def clock_error(self, channel: str) -> float:
        """What is to be added to the time of messages on ``channel``, in seconds."""
        jump = self.faults.get(ClockJump.name)
        return jump.seconds if isinstance(jump, ClockJump) and _concerns(jump, channel) else 0.0

    def send(self, packet: Packet) -> None:
        """Takes a packet that would be due now if all were well."""
        packets = [packet]
        for fault, effect in self._effects:
            if _concerns(fault, packet.channel):
                packets = [arrived for sent in packets for arrived in effect(sent)]
        for late in packets:
            if self._delay:
                late = late._replace(due=late.due + self._delay)
            heapq.heappush(self._waiting, (late.due, next(self._numbers), late))

    def arrivals(self, cycle: int) -> list[Packet]:
        """What arrives up to ``cycle``, in order."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= cycle:
            arrived.append(heapq.heappop(self._waiting)[2])
        return arrived


def _concerns(fault: InjectedFault, channel: str) -> bool:
    return not fault.channels or channel in fault.channels
