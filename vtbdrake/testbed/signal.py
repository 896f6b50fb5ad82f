"""The interface of a data processing system: its sensor signals, actuator signals and commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import InputPort, OutputPort, PortDataType


class SignalError(ValueError):
    """A signal that is ill declared, missing, or does not fit the port that is to carry it."""


@dataclass(frozen=True)
class Signal:
    """One signal that crosses the boundary of a DPS.

    Attributes:
        name: the name of the port that carries it, on every side.
        size: entries of a vector signal; leave it out for an abstract one.
        model_value: a value of an abstract signal's type (an image, a pose, any object); None for a vector one.
        unit: SI unit of all entries; ``"1"`` if it has none.
        lower, upper: limits of its entries, scalars or arrays of shape (size,).
        rate: the largest change per second of an entry.
        acceleration: the largest change per second of that change.
        max_age: in seconds; an older sample is stale.
        idle: actuator signals: what the simulated actuator gets while the real one is driven.
        default: commands: the value until another one is given; zeros if left out.
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

    def __post_init__(self) -> None:
        if not self.name or any(c in self.name for c in ".:/ "):
            raise SignalError(f"a signal's name is one word without '.', ':', '/' or blanks, not {self.name!r}")
        if (self.size is None) == (self.model_value is None):
            raise SignalError(f"signal {self.name} is either a vector (give size=) or abstract (give model_value=)")
        if self.size is not None:
            self._check_vector()
        if not self.max_age > 0:
            raise SignalError(f"signal {self.name}: max_age must be positive, not {self.max_age} s")

    def _check_vector(self) -> None:
        assert self.size is not None
        if self.size < 1:
            raise SignalError(f"signal {self.name} must have at least one entry, not {self.size}")
        for name in ("lower", "upper", "rate", "acceleration", "idle", "default"):
            value = getattr(self, name)
            if value is None:
                continue
            array = np.asarray(value, dtype=float)
            if array.shape not in ((), (self.size,)):
                raise SignalError(f"signal {self.name} has {self.size} entries, but its {name} has shape {array.shape}")
            if np.isnan(array).any():
                raise SignalError(f"signal {self.name}: its {name} has a NaN")
        if (np.asarray(self.lower) > np.asarray(self.upper)).any():
            raise SignalError(f"signal {self.name}: its lower limit {self.lower} lies above its upper {self.upper}")
        for name in ("rate", "acceleration"):
            if (np.asarray(getattr(self, name)) <= 0).any():
                raise SignalError(f"signal {self.name}: its {name} limit must be positive, not {getattr(self, name)}")

    @property
    def is_vector(self) -> bool:
        return self.size is not None

    def vector(self, value: ArrayLike) -> np.ndarray:
        """``value`` (a scalar or one per entry) as an array of shape (size,)."""
        assert self.size is not None
        return np.array(np.broadcast_to(np.asarray(value, dtype=float), (self.size,)))

    def abstract_value(self) -> AbstractValue:
        """A new container of the signal's abstract type."""
        return Value(self.model_value)

    def check_port(self, port: InputPort | OutputPort, owner: str) -> None:
        """
        Raises:
            SignalError: ``port`` cannot carry this signal.
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
            found, expected = type(port.Allocate().get_value()), type(self.abstract_value().get_value())
            if found is not expected:
                raise SignalError(
                    f"signal {self.name} carries a {expected.__name__}, but the port {port.get_name()} of {owner} "
                    f"carries a {found.__name__}"
                )


@dataclass(frozen=True)
class Interface:
    """All signals of a DPS: sensor signals in, actuator signals out, commands u in.

    Raises:
        SignalError: two signals have one name, an actuator signal has no idle command, or a command is abstract.
    """

    sense: Sequence[Signal]
    act: Sequence[Signal]
    commands: Sequence[Signal] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        for name in ("sense", "act", "commands"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        self._refuse_twins([*self.sense, *self.commands], "sensor signals and commands")
        self._refuse_twins(self.act, "actuator signals")
        for signal in self.act:
            if signal.idle is None:
                raise SignalError(
                    f"actuator signal {signal.name} has no idle command: give idle=, what its simulated actuator gets "
                    "while the real one is driven"
                )
        for signal in self.commands:
            if not signal.is_vector:
                raise SignalError(f"command {signal.name} is abstract; a command is a vector (give size=)")

    @staticmethod
    def _refuse_twins(signals: Sequence[Signal], what: str) -> None:
        names = [signal.name for signal in signals]
        twins = sorted({name for name in names if names.count(name) > 1})
        if twins:
            raise SignalError(f"the names of {what} must differ, but these occur twice: {', '.join(twins)}")
