"""The interface of a data processing system: its sensor signals, actuator signals and commands."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, InputPort, OutputPort, PortDataType

from vtbdrake.common.argument_checks import as_array
from vtbdrake.state.variables import html_table


class SignalError(ValueError):
    """A signal is declared wrongly, is missing, or does not fit its port."""


@dataclass(frozen=True, repr=False)
class Signal:
    """One signal that crosses the boundary of a DPS.

    Attributes:
        name: Name of the signal's port, in the DPS, in the simulated world and on the machine.
        size: Number of entries of a vector signal; None for an abstract one.
        model_value: A value of an abstract signal's type (an image, a pose, any object); None for a vector signal. All
            images have the size of the model image; a model image of size zero allows any.
        unit: SI unit of all entries; ``"1"`` for numbers without a unit. Entries of several kinds have a list of the
            units of equal groups, such as ``"rad/s, m/s"``, or of each, such as ``"1, 1, 1, 1, m, m, m"``.
        lower, upper: Limits of the entries, scalars or arrays of shape (size,).
        entry_names: Short names of the entries of a vector signal, such as joints' names; empty if they have none.
        values: The values that an entry can have, if it is one of an enumeration: numbers, or an ``IntEnum``, whose
            names errors tell. The limits are by default the least and the largest of them. None: all within the limits.
        rate: Limit of the first derivative by time, a scalar or shape (size,).
        acceleration: Limit of the second derivative by time, a scalar or shape (size,).
        max_age: Largest age in seconds; an older sample is stale. A command u that a bridge received returns to its
            default then.
        idle: For an actuator signal, the command of the simulated actuator while the real one is driven.
        default: The value of a command until another one is given; by default zeros.
    """

    name: str
    size: int | None = None
    model_value: Any = None
    unit: str = "1"
    lower: ArrayLike = -inf
    upper: ArrayLike = inf
    rate: ArrayLike = inf
    acceleration: ArrayLike = inf
    max_age: float = inf
    idle: Any = None
    default: ArrayLike | None = None
    values: Iterable[float] | None = None
    entry_names: Sequence[str] = ()

    def __repr__(self) -> str:
        """Show the fields that differ from the defaults."""
        shown = [repr(self.name)]
        for item in fields(self)[1:]:
            value = getattr(self, item.name)
            is_plain = np.ndim(value) == 0 or isinstance(value, tuple)
            if not (is_plain and isinstance(value, type(item.default)) and value == item.default):
                text = f"<{type(value).__name__}>" if item.name == "model_value" else _brief(value)
                shown.append(f"{item.name}={text}")
        return f"Signal({', '.join(shown)})"

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name or any(c in ".:/[]" or c.isspace() for c in self.name):
            raise SignalError(f"a signal's name is one word without '.', ':', '/', '[' or blanks, not {self.name!r}")
        if not isinstance(self.unit, str):
            raise SignalError(f"signal {self.name}: its unit is a text, 'm/s', say, not {self.unit!r}")
        if (self.size is None) == (self.model_value is None):
            raise SignalError(f"signal {self.name} is either a vector (give size=) or abstract (give model_value=)")
        if self.size is not None:
            self._check_vector()
        else:
            self._check_abstract()
        self._take_entry_names()
        if not isinstance(self.max_age, int | float | np.number) or not self.max_age > 0:
            raise SignalError(f"signal {self.name}: max_age must be positive, in s, not {self.max_age!r}")

    def _take_entry_names(self) -> None:
        names = tuple(self.entry_names)
        if isinstance(self.entry_names, str) or not all(isinstance(name, str) for name in names):
            raise SignalError(f"signal {self.name}: its entry_names are texts, not {self.entry_names!r}")
        if names and len(names) != self.size:
            raise SignalError(f"signal {self.name} has {self.size or 'no'} entries, but {len(names)} entry_names")
        object.__setattr__(self, "entry_names", names)

    def _take_values(self) -> None:
        if self.values is None:
            return
        try:
            values = tuple(self.values)
            numbers = as_array(f"signal {self.name}: its values", values)
        except (TypeError, ValueError):
            raise SignalError(
                f"signal {self.name}: its values are numbers, or an IntEnum, not {self.values!r}"
            ) from None
        if numbers.ndim != 1 or not numbers.size or not np.isfinite(numbers).all():
            raise SignalError(f"signal {self.name}: its values are finite numbers, at least one, not {self.values!r}")
        object.__setattr__(self, "values", values)
        for name, unlimited, end in (("lower", -inf, min(values)), ("upper", inf, max(values))):
            if np.ndim(limit := getattr(self, name)) == 0 and limit == unlimited:
                object.__setattr__(self, name, float(end))

    def _check_vector(self) -> None:
        if not isinstance(self.size, int | np.integer) or isinstance(self.size, bool) or self.size < 1:
            raise SignalError(f"signal {self.name} must have at least one entry, not {self.size!r}")
        self._take_values()
        for name in ("lower", "upper", "rate", "acceleration", "idle", "default"):
            value = getattr(self, name)
            if value is None and name in ("idle", "default"):
                continue
            try:
                array = as_array(f"signal {self.name}: its {name}", value)
            except ValueError as error:
                raise SignalError(str(error)) from None
            if array.shape not in ((), (self.size,)):
                raise SignalError(f"signal {self.name} has {self.size} entries, but its {name} has shape {array.shape}")
            if np.isnan(array).any():
                raise SignalError(f"signal {self.name}: its {name} has a NaN")
            if name in ("idle", "default") and np.isinf(array).any():
                raise SignalError(f"signal {self.name}: its {name} must be finite, not {value!r}")
        if (np.asarray(self.lower) > np.asarray(self.upper)).any():
            raise SignalError(f"signal {self.name}: its lower limit {self.lower} lies above its upper {self.upper}")
        for name in ("rate", "acceleration"):
            if (np.asarray(getattr(self, name)) <= 0).any():
                raise SignalError(f"signal {self.name}: its {name} limit must be positive, not {getattr(self, name)}")
        for name in ("idle", "default"):
            value = getattr(self, name)
            if value is not None and ((value < np.asarray(self.lower)) | (value > np.asarray(self.upper))).any():
                raise SignalError(
                    f"signal {self.name}: its {name} {value} lies outside its limits, {self.lower} to {self.upper}"
                )
            if value is not None and (index := self.foreign_entry(value)) is not None:
                raise SignalError(
                    f"signal {self.name}: its {name} {np.ravel(value)[index]:g} is not one of its values, "
                    f"{self.values_text()}"
                )

    def _check_abstract(self) -> None:
        nothings = {"lower": -inf, "upper": inf, "rate": inf, "acceleration": inf, "default": None, "values": None}
        for name, nothing in nothings.items():
            value = getattr(self, name)
            if value is not None and not (np.ndim(value) == 0 and value == nothing):
                raise SignalError(f"signal {self.name} is abstract: only a vector has a {name}")
        if self.idle is not None:
            try:
                self.check_value(self.idle)
            except SignalError as error:
                raise SignalError(f"the idle value does not fit: {error}") from None

    @property
    def is_vector(self) -> bool:
        return self.size is not None

    def vector(self, value: ArrayLike) -> np.ndarray:
        """Return ``value`` (a scalar or one per entry) as an array of shape (size,)."""
        assert self.size is not None
        return np.array(np.broadcast_to(as_array(f"a value of the signal {self.name}", value), (self.size,)))

    def default_vector(self) -> np.ndarray:
        """Return the default of a command as an array of shape (size,)."""
        return self.vector(0.0 if self.default is None else self.default)

    def foreign_entry(self, value: ArrayLike) -> int | None:
        """Return the index of the first entry that is not one of ``values``; None if all are, or if all may be."""
        if self.values is None:
            return None
        foreign = ~np.isin(np.ravel(np.asarray(value, dtype=float)), np.array(list(self.values), dtype=float))
        return int(np.argmax(foreign)) if foreign.any() else None

    @property
    def choices(self) -> tuple[tuple[float, str], ...]:
        """Return the values that an entry can have, each with its name in an enumeration, if it has one."""
        return tuple((float(value), str(getattr(value, "name", "")).lower()) for value in self.values or ())

    def values_text(self) -> str:
        """Return the values that an entry can have as text, with the names of an enumeration: ``0 (follow), 1``."""
        return ", ".join(f"{value:g} ({name})" if name else f"{value:g}" for value, name in self.choices)

    def abstract_value(self) -> AbstractValue:
        """Return a new container of the signal's abstract type."""
        return Value(self.model_value)

    def check_value(self, value: Any) -> None:
        """Raise a SignalError if ``value`` has another size or type than the signal, or a NaN."""
        if self.is_vector:
            try:
                array = as_array(f"signal {self.name}", value)
            except ValueError:
                raise SignalError(f"signal {self.name} has {self.size} numbers, not {value!r}") from None
            if array.shape != (self.size,):
                raise SignalError(f"signal {self.name} has {self.size} entries, not the shape {array.shape}")
            if np.isnan(array).any():
                raise SignalError(
                    f"signal {self.name}: entry {int(np.argmax(np.isnan(array)))} is NaN: do not feed unknown values"
                )
            if (index := self.foreign_entry(array)) is not None:
                raise SignalError(f"signal {self.name} is one of {self.values_text()}, not {float(array[index])}")
            return
        model = self.abstract_value().get_value()
        if not isinstance(value, type(model)):
            raise SignalError(f"signal {self.name} carries a {type(model).__name__}, not a {type(value).__name__}")
        if _pixels(model) not in (_ANY_SIZE, _pixels(value)):
            raise SignalError(f"signal {self.name} carries images of {_pixels(model)}, not one of {_pixels(value)}")

    def check_port(self, port: InputPort | OutputPort, owner: str) -> None:
        """Raise a SignalError if ``port`` of the system ``owner`` cannot carry this signal.

        Args:
            port: The port that shall carry the signal.
            owner: Name of the port's system, for the message.
        """
        is_vector = port.get_data_type() == PortDataType.kVectorValued
        if is_vector != self.is_vector:
            kinds = {True: "vector", False: "abstract"}
            raise SignalError(
                f"signal {self.name} is {kinds[self.is_vector]}, but the port {port.get_name()} of {owner} is "
                f"{kinds[is_vector]}"
            )
        if is_vector and port.size() != self.size:
            raise SignalError(
                f"signal {self.name} has {self.size} entries, but the port {port.get_name()} of {owner} has "
                f"{port.size()}"
            )
        if not is_vector and isinstance(port, OutputPort):
            actual, expected = port.Allocate().get_value(), self.abstract_value().get_value()
            if type(actual) is not type(expected):
                raise SignalError(
                    f"signal {self.name} carries a {type(expected).__name__}, but the port {port.get_name()} of "
                    f"{owner} carries a {type(actual).__name__}"
                )
            if _ANY_SIZE not in (_pixels(expected), _pixels(actual)) and _pixels(expected) != _pixels(actual):
                raise SignalError(
                    f"signal {self.name} carries images of {_pixels(expected)}, but the port {port.get_name()} of "
                    f"{owner} images of {_pixels(actual)}: give a model_value of that size"
                )


# An image of size zero accepts images of any size.
_ANY_SIZE = "0 x 0 pixels"


def _pixels(value: Any) -> str:
    """Return the size of one of Drake's images; empty for anything else."""
    return f"{value.width()} x {value.height()} pixels" if hasattr(value, "mutable_data") else ""


def _brief(value: Any) -> str:
    if np.ndim(value) == 0:
        return f"{value:g}" if isinstance(value, float) else repr(value)
    return np.array2string(np.asarray(value), precision=4, threshold=4, edgeitems=1, separator=", ").replace("\n", "")


@dataclass(frozen=True, repr=False)
class Interface:
    """All signals of a DPS: sensor signals in, actuator signals out, commands u in.

    Args:
        sense: Sensor signals; each is an input port of the DPS.
        act: Actuator signals; each is an output port of the DPS, and has an ``idle`` value.
        commands: Commands u, what an operator or a task asks of the DPS: vectors, each an input port of the DPS whose
            value is the variable ``u.<name>`` of the testbed.

    Raises:
        SignalError: Two signals have one name, an actuator signal has no idle value, or a command is abstract or has a
            default that is not one of its values.
    """

    sense: Sequence[Signal]
    act: Sequence[Signal]
    commands: Sequence[Signal] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        for name in ("sense", "act", "commands"):
            declared = getattr(self, name)
            if not isinstance(declared, Signal | Iterable):
                raise SignalError(f"an interface's {name} is a list of Signal(...), [] for none, not {declared!r}")
            signals = (declared,) if isinstance(declared, Signal) else tuple(declared)
            if wrong := [item for item in signals if not isinstance(item, Signal)]:
                raise SignalError(f"an interface's {name} is a list of Signal(...), but has {wrong[0]!r}")
            object.__setattr__(self, name, signals)
        self._refuse_twins([*self.sense, *self.commands], "sensor signals and commands")
        self._refuse_twins(self.act, "actuator signals")
        for signal in self.act:
            if signal.idle is None:
                raise SignalError(
                    f"actuator signal {signal.name} has no idle value: give idle=, the command of its simulated "
                    "actuator while the real one is driven"
                )
        for signal in self.commands:
            if not signal.is_vector:
                raise SignalError(f"command {signal.name} is abstract; a command is a vector (give size=)")
            if signal.foreign_entry(signal.default_vector()) is not None:
                raise SignalError(
                    f"command {signal.name} is one of {signal.values_text()}: give default=, which is 0 otherwise"
                )

    def __repr__(self) -> str:
        sides = {item.name: ", ".join(signal.name for signal in getattr(self, item.name)) for item in fields(self)}
        return f"Interface({', '.join(f'{side}=[{names}]' for side, names in sides.items())})"

    def _repr_html_(self) -> str:
        """Show the signals in a notebook."""
        sides = (("sensor", self.sense), ("actuator", self.act), ("command", self.commands))
        signals = [(kind, signal.name, str(signal.size or ""), signal.unit) for kind, side in sides for signal in side]
        return html_table([("signal", "name", "size", "unit"), *signals])

    @staticmethod
    def _refuse_twins(signals: Sequence[Signal], kind: str) -> None:
        names = [signal.name for signal in signals]
        twins = sorted({name for name in names if names.count(name) > 1})
        if twins:
            raise SignalError(f"the names of {kind} must differ, but these occur twice: {', '.join(twins)}")


class Feed:
    """Sets the values of input ports in one context, by signal; a port holds its last value.

    After the first call, a value is changed in place, which takes one or two microseconds. `GetMutableData` must be
    called before each change, to invalidate caches; the view of a vector's numbers can be kept.

    Args:
        ports: By name, the signal and its input port.
        context: The context of the ports' system.
    """

    def __init__(self, ports: Mapping[str, tuple[Signal, InputPort]], context: Context) -> None:
        self._ports = ports
        self._context = context
        self._fixed: dict[str, tuple[Callable[[], Any], np.ndarray | None]] = {}

    def __call__(self, name: str, value: Any) -> None:
        """Set the value of a signal's port: for a vector signal an array of its size."""
        access = self._fixed.get(name)
        if access is None:
            signal, port = self._ports[name]
            fixed = port.FixValue(self._context, value if signal.is_vector else _wrapped(signal, value))
            numbers = fixed.GetMutableData().get_mutable_value().get_mutable_value() if signal.is_vector else None
            self._fixed[name] = (fixed.GetMutableData, numbers)
            return
        changed, numbers = access
        data = changed()
        if numbers is None:
            data.set_value(value)
        else:
            numbers[:] = value


def _wrapped(signal: Signal, value: Any) -> Any:
    wrapped = signal.abstract_value()
    wrapped.set_value(value)
    return wrapped
