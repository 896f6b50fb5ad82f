"""Maps for messages of numbers: every signal is a field, or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

import numpy as np

from vtbdrake.control.kernels import ReceivedSignal
from vtbdrake.control.ranges import Range
from vtbdrake.lcm.fields import Field, compose, find_field
from vtbdrake.lcm.maps import LcmMap, Reader, Writer, never_sent
from vtbdrake.lcm.messages import MessageDecoder, MessageEncoder
from vtbdrake.lcm.wire import Layout, Place
from vtbdrake.testbed import Signal

MICROSECOND = 1e-6


@dataclass(frozen=True, kw_only=True)
class VectorMap(LcmMap):
    """An `LcmMap` of vector signals; `vector_map` makes one.

    Attributes:
        fields: by signal, the fields that its entries are, one after the other.
        stamp: the field with the sender's time in microseconds; empty if there is none.
    """

    fields: Mapping[str, Sequence[Field]]
    stamp: str = ""

    def check(self, signals: Sequence[Signal]) -> None:
        """
        Raises:
            ValueError: a signal is not a vector or not of the size of its fields.
        """
        lengths: dict[str, Signal] = {}
        for signal in signals:
            if signal.size is None:
                raise ValueError(f"signal {signal.name} is abstract; channel {self.channel} carries vectors")
            counts = [field.count for field in self.fields[signal.name]]
            known = sum(count for count in counts if count is not None)
            if None not in counts and known != signal.size:
                paths = ", ".join(field.path for field in self.fields[signal.name])
                raise ValueError(
                    f"signal {signal.name} has {signal.size} entries, but {paths} of {self.type.__name__} on channel "
                    f"{self.channel} has {known}"
                )
            for field in self.fields[signal.name]:
                if field.length:
                    other = lengths.setdefault(field.path.rpartition(".")[0] + field.length, signal)
                    if other.size != signal.size:
                        raise ValueError(
                            f"signals {other.name} and {signal.name} have {other.size} and {signal.size} entries, but "
                            f"field {field.length} of {self.type.__name__} is the length of both"
                        )

    def reader(self, signals: Sequence[Signal]) -> Reader:
        self.check(signals)
        return super().reader(signals)

    def intake(
        self, signals: Sequence[Signal], receptions: Sequence[ReceivedSignal], example: bytes
    ) -> MessageDecoder | None:
        layout = self._layout(self.type.decode(example))
        if layout is None:
            return None
        ranges = [Range(signal) for signal in signals]
        return MessageDecoder(
            example,
            fixed=layout.fixed,
            places=self._places(layout, signals),
            stamp=self._stamp(layout),
            receptions=receptions,
            sizes=[signal.size for signal in signals],
            lower=[entry for limits in ranges for entry in limits.lower],
            upper=[entry for limits in ranges for entry in limits.upper],
        )

    def writer(self, signals: Sequence[Signal]) -> Writer:
        self.check(signals)
        return _VectorWriter(self, signals)

    def form(self, signals: Sequence[Signal], ranges: Mapping[str, Range] | None = None) -> MessageEncoder | None:
        assert self.encode is not None
        layout = self._layout(self.encode({signal.name: np.zeros(signal.size or 0) for signal in signals}, 0))
        if layout is None:
            return None
        return MessageEncoder(
            layout.example,
            places=self._places(layout, signals),
            stamp=self._stamp(layout),
            names=[signal.name for signal in signals],
            sizes=[signal.size for signal in signals],
            boxes=[ranges[signal.name].box for signal in signals] if ranges else None,
        )

    def _layout(self, message: Any) -> Layout | None:
        try:
            return Layout(message)
        except TypeError:  # It holds more than numbers.
            return None

    def _places(self, layout: Layout, signals: Sequence[Signal]) -> list[tuple[int, int, int, int, str]]:
        """Of the signals' entries: which signal, from which entry on, at which byte, how many, their type."""
        places = []
        for i, signal in enumerate(signals):
            begin = 0
            for field in self.fields[signal.name]:
                place = layout.at[field.path]
                places.append((i, begin, place.offset, place.size, place.code))
                begin += place.size
        return places

    def _stamp(self, layout: Layout) -> Place | None:
        return layout.at[self.stamp] if self.stamp else None


def vector_map(
    channel: str, message_type: Any, fields: Mapping[str, str | Sequence[str]], *, stamp: str = "utime"
) -> VectorMap:
    """A map for messages whose signals are fields of numbers.

    Args:
        channel: the channel's name.
        message_type: a class made by lcm-gen.
        fields: by signal, the field that it is: a number or an array. Several fields, if its entries are spread over
            them. Dotted names reach into messages within the message.
        stamp: the field with the sender's time in microseconds; empty if there is none: late and repeated messages are
            then taken for new ones.

    Raises:
        ValueError: there is no such field, or it does not hold numbers.
    """
    found: dict[str, tuple[Field, ...]] = {}
    for name, paths in fields.items():
        found[name] = tuple(find_field(message_type, path) for path in ([paths] if isinstance(paths, str) else paths))
        if len(found[name]) > 1 and any(field.length for field in found[name]):
            raise ValueError(
                f"signal {name} on channel {channel} cannot be spread over {', '.join(paths)}: an array of variable "
                "length carries a signal alone"
            )
    if stamp and find_field(message_type, stamp).count != 1:
        raise ValueError(f"field {stamp} of {message_type.__name__} is no time; give stamp='' if there is none")
    sent_in = attrgetter(stamp) if stamp else None

    def decode(message: Any) -> dict[str, np.ndarray]:
        return {
            name: np.concatenate([np.ravel(np.asarray(attrgetter(field.path)(message), float)) for field in parts])
            for name, parts in found.items()
        }

    def encode(values: Mapping[str, Any], utime: int) -> Any:
        return compose(message_type, found, values, stamp, utime)

    return VectorMap(
        channel=channel,
        type=message_type,
        signals=tuple(found),
        decode=decode,
        encode=encode,
        sent=(lambda message: sent_in(message) * MICROSECOND) if sent_in else never_sent,
        fields=found,
        stamp=stamp,
    )


class _VectorWriter:
    """Writes the messages of a map; those that are numbers only by filling in a form."""

    def __init__(self, map: VectorMap, signals: Sequence[Signal]) -> None:
        self._map = map
        self._signals = signals
        self._write = LcmMap.writer(map, signals)
        self._forms: dict[tuple[str, ...], MessageEncoder | None] = {}
        self._learn(tuple(signal.name for signal in signals))

    def _learn(self, names: tuple[str, ...]) -> MessageEncoder | None:
        form = self._map.form([signal for signal in self._signals if signal.name in names])
        self._forms[names] = form
        return form

    def __call__(self, values: Mapping[str, Any], utime: int) -> bytes:
        names = tuple(values)
        form = self._forms[names] if names in self._forms else self._learn(names)
        message = form.fill(values, utime) if form is not None else None
        return self._write(values, utime) if message is None else message
