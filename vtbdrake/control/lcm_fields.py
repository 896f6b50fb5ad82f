"""Maps for messages that are numbers: every signal is a field, or several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from math import nan, prod
from operator import attrgetter, itemgetter
from typing import Any

import numpy as np

from vtbdrake.control.lcm_maps import LcmMap, Reader, Sample, Writer, never_sent
from vtbdrake.control.lcm_wire import FORMATS, Layout
from vtbdrake.testbed import Signal

MICROSECOND = 1e-6


@dataclass(frozen=True)
class Field:
    """A field of numbers in a message: a scalar, an array of fixed dimensions, or one as long as another field says.

    Attributes:
        path: its name; dotted if it lies in a message within the message.
        dimensions: of a fixed array; empty for a scalar.
        length: the field that tells its length, beside it; empty if its dimensions are fixed.
        integer: whether it takes integers only.
    """

    path: str
    dimensions: tuple[int, ...]
    length: str
    integer: bool

    @property
    def count(self) -> int | None:
        """How many numbers it has; None if the message tells."""
        return None if self.length else prod(self.dimensions)

    def write(self, message: Any, numbers: list[float]) -> None:
        owner, name = owner_of(message, self.path)
        values: Any = [round(number) for number in numbers] if self.integer else numbers
        if self.length:
            setattr(owner, self.length, len(values))
            setattr(owner, name, values)
        elif self.dimensions:
            setattr(owner, name, np.reshape(np.array(values), self.dimensions).tolist())
        else:
            setattr(owner, name, values[0])


def owner_of(message: Any, path: str) -> tuple[Any, str]:
    """The message within ``message`` that has the field, and the field's own name."""
    parents, _, name = path.rpartition(".")
    return (attrgetter(parents)(message) if parents else message), name


def find_field(message_type: Any, path: str) -> Field:
    """
    Raises:
        ValueError: the type has no such field, or it is not one of numbers that a signal can be.
    """
    try:
        owner, name = owner_of(message_type(), path)
        kind = type(owner)
        index = kind.__slots__.index(name)
    except (AttributeError, ValueError):
        fields = ", ".join(message_type.__slots__)
        raise ValueError(f"{message_type.__name__} has no field {path!r}; it has {fields}") from None
    typename, dimensions = kind.__typenames__[index], kind.__dimensions__[index] or []
    variable = [dimension for dimension in dimensions if isinstance(dimension, str)]
    if typename not in FORMATS or (variable and len(dimensions) > 1):
        shape = "".join(f"[{dimension}]" for dimension in dimensions)
        raise ValueError(
            f"field {path} of {message_type.__name__} is a {typename}{shape}: a vector signal travels in numbers, in "
            "arrays of fixed dimensions, or in an array of one dimension; write an LcmMap for it"
        )
    integer = typename not in ("float", "double")
    return Field(path, () if variable else tuple(dimensions), variable[0] if variable else "", integer)


@dataclass(frozen=True, kw_only=True)
class FieldMap(LcmMap):
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
        return _FieldReader(self, signals)

    def writer(self, signals: Sequence[Signal]) -> Writer:
        self.check(signals)
        return _FieldWriter(self, signals)


def vector_map(
    channel: str, message_type: Any, fields: Mapping[str, str | Sequence[str]], *, stamp: str = "utime"
) -> FieldMap:
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

    return FieldMap(
        channel=channel,
        type=message_type,
        signals=tuple(found),
        decode=decode,
        encode=encode,
        sent=(lambda message: sent_in(message) * MICROSECOND) if sent_in else never_sent,
        fields=found,
        stamp=stamp,
    )


def compose(
    message_type: Any, fields: Mapping[str, Sequence[Field]], values: Mapping[str, Any], stamp: str, utime: int
) -> Any:
    """The message of these values; what is not given is zero, and arrays that may be empty are.

    Raises:
        LookupError: the message cannot leave out a signal that is missing.
    """
    message = message_type()
    if stamp:
        owner, name = owner_of(message, stamp)
        setattr(owner, name, utime)
    for signal, value in values.items():
        numbers = np.asarray(value, dtype=float).tolist()
        for field in fields[signal]:
            count = len(numbers) if field.count is None else field.count
            field.write(message, numbers[:count])
            numbers = numbers[count:]
    for owner in {id(owner): owner for owner, _ in (owner_of(message, path) for path in _paths(fields))}.values():
        _fill(owner)
    for signal in fields.keys() - values.keys():
        for field in fields[signal]:
            owner, _ = owner_of(message, field.path)
            if not field.length or getattr(owner, field.length):
                raise LookupError(signal)
    return message


def _paths(fields: Mapping[str, Sequence[Field]]) -> list[str]:
    return [field.path for parts in fields.values() for field in parts]


def _fill(message: Any) -> None:
    """Gives arrays that share their length with one that was written that length."""
    kind = type(message)
    for name, typename, dimensions in zip(kind.__slots__, kind.__typenames__, kind.__dimensions__, strict=True):
        if typename in FORMATS and len(dimensions or ()) == 1 and isinstance(dimensions[0], str):
            missing = getattr(message, dimensions[0]) - len(getattr(message, name))
            if missing > 0:
                setattr(message, name, [0] * missing)


class _FieldReader:
    """Reads messages that are laid out like an earlier one by one call of `struct`, and the others field by field."""

    _LAYOUTS = 4  # how many to remember: messages of a channel are laid out alike, or change between a few ways

    def __init__(self, map: FieldMap, signals: Sequence[Signal]) -> None:
        self._read = LcmMap.reader(map, signals)
        self._map = map
        self._sizes = {signal.name: signal.size for signal in signals}
        ends = np.cumsum([signal.size for signal in signals]).tolist()
        self._parts = [(s.name, slice(end - (s.size or 0), end)) for s, end in zip(signals, ends, strict=True)]
        self._layouts: dict[int, tuple[Layout, itemgetter[Any], int]] = {}
        self._flat = True  # until a message turns out to hold more than numbers

    def __call__(self, data: bytes) -> Sample:
        known = self._layouts.get(len(data))
        if known is not None:
            layout, pick, stamp = known
            numbers = layout.unpack(data)
            if numbers is not None:
                picked = pick(numbers)
                entries = np.array(picked, dtype=float)
                sent = numbers[stamp] * MICROSECOND if stamp else nan
                return Sample(sent, {name: entries[part] for name, part in self._parts}, picked)
        sample = self._read(data)
        if self._flat and known is None and len(self._layouts) < self._LAYOUTS:
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
        places = list(
            chain.from_iterable(range(layout.at[path].start, layout.at[path].stop) for path in self._map.paths)
        )
        together = places == list(range(places[0], places[-1] + 1))
        pick = itemgetter(slice(places[0], places[-1] + 1)) if together else itemgetter(*places)
        stamp = layout.at[self._map.stamp].start if self._map.stamp else 0
        self._layouts[len(data)] = (layout, pick, stamp)


class _FieldWriter:
    """Writes the messages of a map, those that are numbers only by one call of `struct`."""

    def __init__(self, map: FieldMap, signals: Sequence[Signal]) -> None:
        self._map = map
        self._write = LcmMap.writer(map, signals)
        self._layouts: dict[tuple[str, ...], Layout | None] = {}
        self._learn({signal.name: np.zeros(signal.size or 0) for signal in signals})

    def _learn(self, values: Mapping[str, Any]) -> Layout | None:
        encode = self._map.encode
        assert encode is not None
        message = encode(values, 0)
        message.encode()
        try:
            layout: Layout | None = Layout(message)
        except TypeError:
            layout = None
        self._layouts[tuple(values)] = layout
        return layout

    def __call__(self, values: Mapping[str, Any], utime: int) -> bytes:
        names = tuple(values)
        layout = self._layouts[names] if names in self._layouts else self._learn(values)
        if layout is None:
            return self._write(values, utime)
        numbers = layout.template.copy()
        if self._map.stamp:
            numbers[layout.at[self._map.stamp].start] = utime
        for name, value in values.items():
            entries = np.asarray(value, dtype=float).tolist()
            for field in self._map.fields[name]:
                place = layout.at[field.path]
                count = place.stop - place.start
                numbers[place] = [round(entry) for entry in entries[:count]] if field.integer else entries[:count]
                entries = entries[count:]
        return layout.pack(numbers)
