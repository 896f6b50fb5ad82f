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

from vtbdrake.argument_checks import as_array


class SignalError(ValueError):
    """A signal is declared wrongly, is missing, or does not fit its port."""


@dataclass(frozen=True, repr=False)
class Signal:
    """One signal that crosses the boundary of a DPS.

    Attributes:
        name: Name of the signal's port, in the DPS, in the simulated world and on the machine.
        size: Number of entries of a vector signal; None for an abstract one.
        model_value: A value of an abstract signal's type (an image, a pose, any object); None for a vector signal. The
            size of a model image is that of all images; a model image of size zero allows any.
        unit: SI unit of all entries; ``"1"`` for numbers without a unit.
        lower, upper: Limits of the entries, scalars or arrays of shape (size,).
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

    def __repr__(self) -> str:
        """Show the fields that differ from the defaults."""
        shown = [repr(self.name)]
        for item in fields(self)[1:]:
            value = getattr(self, item.name)
            if not (np.ndim(value) == 0 and isinstance(value, type(item.default)) and value == item.default):
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
        if not isinstance(self.max_age, int | float | np.number) or not self.max_age > 0:
            raise SignalError(f"signal {self.name}: max_age must be positive, in s, not {self.max_age!r}")

    def _check_vector(self) -> None:
        if not isinstance(self.size, int | np.integer) or isinstance(self.size, bool) or self.size < 1:
            raise SignalError(f"signal {self.name} must have at least one entry, not {self.size!r}")
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

    def _check_abstract(self) -> None:
        for name, nothing in (("lower", -inf), ("upper", inf), ("rate", inf), ("acceleration", inf), ("default", None)):
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
        return np.array(np.broadcast_to(np.asarray(value, dtype=float), (self.size,)))

    def default_vector(self) -> np.ndarray:
        """Return the default of a command as an array of shape (size,)."""
        return self.vector(0.0 if self.default is None else self.default)

    def abstract_value(self) -> AbstractValue:
        """Return a new container of the signal's abstract type."""
        return Value(self.model_value)

    def check_value(self, value: Any) -> None:
        """Raise a SignalError if ``value`` has another size or type than the signal, or a NaN."""
        if self.is_vector:
            try:
                array = np.asarray(value, dtype=float)
            except (TypeError, ValueError) as error:
                raise SignalError(f"signal {self.name} has {self.size} numbers, not {value!r}") from error
            if array.shape != (self.size,):
                raise SignalError(f"signal {self.name} has {self.size} entries, not the shape {array.shape}")
            if np.isnan(array).any():
                raise SignalError(
                    f"signal {self.name}: entry {int(np.argmax(np.isnan(array)))} is NaN: do not feed unknown values"
                )
            return
        model = self.abstract_value().get_value()
        if not isinstance(value, type(model)):
            raise SignalError(f"signal {self.name} carries a {type(model).__name__}, not a {type(value).__name__}")
        if _pixels(model) not in (_ANY_SIZE, _pixels(value)):
            raise SignalError(f"signal {self.name} carries images of {_pixels(model)}, not one of {_pixels(value)}")

    def check_port(self, port: InputPort | OutputPort, owner: str) -> None:
        """Raise a SignalError if ``port`` of the system ``owner`` cannot carry this signal."""
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
                    f"{owner} those of {_pixels(actual)}: give a model_value of that size"
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
        SignalError: Two signals have one name, an actuator signal has no idle value, or a command is abstract.
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

    def __repr__(self) -> str:
        sides = {item.name: ", ".join(signal.name for signal in getattr(self, item.name)) for item in fields(self)}
        return f"Interface({', '.join(f'{side}=[{names}]' for side, names in sides.items())})"

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
