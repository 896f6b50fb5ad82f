"""Maps for messages of numbers: every signal is a field, or several."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import nan
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

import numpy as np

from vtbdrake.control.lcm_fields import Field, compose, find_field
from vtbdrake.control.lcm_maps import LcmMap, Reader, Sample, Writer, never_sent
from vtbdrake.control.lcm_wire import Excerpt, Layout, Place
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

    @cached_property
    def paths(self) -> tuple[str, ...]:
        """The mapped fields, in the order of the signals."""
        return tuple(field.path for name in self.signals for field in self.fields[name])

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
        return _VectorReader(self, signals)

    def writer(self, signals: Sequence[Signal]) -> Writer:
        self.check(signals)
        return _VectorWriter(self, signals)


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


class _VectorReader:
    """Reads messages that are laid out like an earlier one by one call of `struct`, and the others field by field."""

    _LAYOUTS = 4  # how many to remember: messages of a channel are laid out alike, or change between a few ways

    def __init__(self, map: VectorMap, signals: Sequence[Signal]) -> None:
        self._read = LcmMap.reader(map, signals)
        self._map = map
        self._sizes = {signal.name: signal.size for signal in signals}
        ends = np.cumsum([signal.size for signal in signals]).tolist()
        self._parts = [(s.name, slice(end - (s.size or 0), end)) for s, end in zip(signals, ends, strict=True)]
        self._known: dict[int, tuple[Excerpt, itemgetter[Any], int]] = {}  # by the messages' size
        self._flat = True  # until a message turns out to hold more than numbers

    def __call__(self, data: bytes) -> Sample:
        known = self._known.get(len(data))
        if known is not None:
            excerpt, pick, stamp = known
            numbers = excerpt.unpack(data)
            if excerpt.fixed(numbers) == excerpt.expected:
                picked = pick(numbers)
                entries = np.array(picked, dtype=float)
                sent = numbers[stamp] * MICROSECOND if stamp else nan
                return Sample(sent, {name: entries[part] for name, part in self._parts}, picked)
        sample = self._read(data)
        if self._flat and known is None and len(self._known) < self._LAYOUTS:
            self._learn(data, sample)
        return sample

    def _learn(self, data: bytes, sample: Sample) -> None:
        if any(len(sample.values[name]) != size for name, size in self._sizes.items()):
            return
        try:
            layout = Layout(self._map.type.decode(data))
        except TypeError:
            self._flat = False
            return
        excerpt = Excerpt(layout, {self._map.stamp, *self._map.paths})
        places = [place for path in self._map.paths for place in range(excerpt.at[path].start, excerpt.at[path].stop)]
        together = places == list(range(places[0], places[-1] + 1))
        pick = itemgetter(slice(places[0], places[-1] + 1)) if together else itemgetter(*places)
        stamp = excerpt.at[self._map.stamp].start if self._map.stamp else 0
        self._known[len(data)] = (excerpt, pick, stamp)


class _Blank(NamedTuple):
    """A stretch of a message where numbers go.

    Attributes:
        write: writes them, into a message, at an offset.
        offset: in bytes.
        part: which entries of the signal they are.
        integer: whether they are rounded.
    """

    write: Callable[..., None]
    offset: int
    part: slice
    integer: bool


class _Form:
    """A message of numbers only, in which the time and the signals are left to be filled in."""

    def __init__(self, layout: Layout, map: VectorMap, names: Iterable[str]) -> None:
        self._message = bytearray(layout.example)
        self._stamp = _blank(layout.at[map.stamp], 0, integer=True) if map.stamp else None
        self._blanks: list[tuple[str, list[_Blank]]] = []
        for name in names:
            begin, blanks = 0, []
            for field in map.fields[name]:
                place = layout.at[field.path]
                blanks.append(_blank(place, begin, integer=field.integer))
                begin += place.size
            self._blanks.append((name, blanks))

    def fill(self, values: Mapping[str, Any], utime: int) -> bytes:
        """
        Raises:
            struct.error, OverflowError: a number does not fit its field.
        """
        message = self._message
        if self._stamp is not None:
            self._stamp.write(message, self._stamp.offset, utime)
        for name, blanks in self._blanks:
            entries = np.asarray(values[name], dtype=float).tolist()
            for write, offset, part, integer in blanks:
                numbers = entries[part]
                write(message, offset, *(map(round, numbers) if integer else numbers))
        return bytes(message)


def _blank(place: Place, begin: int, *, integer: bool) -> _Blank:
    write = struct.Struct(f">{place.size}{place.code}").pack_into
    return _Blank(write, place.offset, slice(begin, begin + place.size), integer)


class _VectorWriter:
    """Writes the messages of a map; those that are numbers only by filling in a form."""

    def __init__(self, map: VectorMap, signals: Sequence[Signal]) -> None:
        self._map = map
        self._write = LcmMap.writer(map, signals)
        self._forms: dict[tuple[str, ...], _Form | None] = {}
        self._learn({signal.name: np.zeros(signal.size or 0) for signal in signals})

    def _learn(self, values: Mapping[str, Any]) -> _Form | None:
        encode = self._map.encode
        assert encode is not None
        message = encode(values, 0)
        message.encode()
        try:
            form: _Form | None = _Form(Layout(message), self._map, values)
        except TypeError:
            form = None
        self._forms[tuple(values)] = form
        return form

    def __call__(self, values: Mapping[str, Any], utime: int) -> bytes:
        names = tuple(values)
        form = self._forms[names] if names in self._forms else self._learn(values)
        return self._write(values, utime) if form is None else form.fill(values, utime)
