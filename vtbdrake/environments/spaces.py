"""What an agent acts on and what it observes: the testbed's variables behind two boxes, with the signals' limits."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from operator import le
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import Context, PortDataType

from vtbdrake.common.argument_checks import as_addresses, as_array, suggestion
from vtbdrake.common.arrays import Array
from vtbdrake.state import AddressError, Variable
from vtbdrake.state.declarations import DISCRETE
from vtbdrake.state.systems import output_ports
from vtbdrake.state.variables import with_unit
from vtbdrake.testbed import Signal, VirtualTestbed
from vtbdrake.testbed.switch import COMMAND, T_ACT, T_SENSE, Position

Limits = tuple[ArrayLike, ArrayLike]
Action = Sequence[str] | Mapping[str, Limits | None]
"""Names of what an agent acts on; or, name -> (lower, upper), where the limits are others than the signal's."""

# A number in single precision at a limit is up to this share of the limit beyond it.
_ROUNDING = 1e-6


class ActionError(ValueError):
    """An action has another shape, is not finite, or lies beyond the limits."""


@dataclass(frozen=True)
class Channel:
    """A part of an action, or of an observation.

    Attributes:
        name: The name that the user gave: a signal's, or an address.
        address: The address of the variable or the vector port.
        lower, upper: The limits, each of shape (size,).
        unit: The unit of the entries.
        entry_names: The names of the entries; empty if they have none.
    """

    name: str
    address: str
    lower: Array
    upper: Array
    unit: str = "1"
    entry_names: Sequence[str] = ()

    @property
    def size(self) -> int:
        """Return the number of entries."""
        return len(self.lower)

    def entry_text(self, index: int) -> str:
        """Return an entry's name, as errors tell it."""
        if self.entry_names:
            return f"{self.name}[{index}] ({self.entry_names[index]})"
        return f"{self.name}[{index}]" if self.size > 1 else self.name


class Channels:
    """Several channels side by side, in one vector.

    Args:
        channels: The channels.

    Attributes:
        lower, upper: The limits of all entries, each of shape (size,).
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._channels = tuple(channels)
        self.lower = np.concatenate([channel.lower for channel in channels])
        self.upper = np.concatenate([channel.upper for channel in channels])
        self._limits = self.lower.tolist(), self.upper.tolist()
        slack = _ROUNDING * np.maximum(np.abs(self.lower), np.abs(self.upper))
        self._lowest, self._highest = self.lower - slack, self.upper + slack
        ends = np.cumsum([0, *(channel.size for channel in channels)]).tolist()
        self._slices = tuple(slice(*ends[k : k + 2]) for k in range(len(channels)))

    @property
    def addresses(self) -> tuple[str, ...]:
        """Return the addresses of the channels."""
        return tuple(channel.address for channel in self._channels)

    def parts(self) -> list[tuple[Channel, slice]]:
        """Return the channels, each with its entries in the vector."""
        return list(zip(self._channels, self._slices, strict=True))

    def checked(self, actions: Any, *, count: int | None = None) -> Array:
        """Return an action, or one for each of several environments, as an array; single precision may round a limit.

        Args:
            actions: Numbers of shape (size,), or (count, size).
            count: The number of environments; None: the action is for one, which is no vector.

        Raises:
            ActionError: It is none; the entry is named.
        """
        shape = self.lower.shape if count is None else (count, *self.lower.shape)
        try:
            array = as_array("an action", actions)
        except ValueError:
            raise ActionError(f"{self._shape_text(count)}, not {actions!r}") from None
        if array.shape != shape:
            raise ActionError(f"{self._shape_text(count)}, in the shape {shape}, not {array.shape}")
        if self._is_within(array):
            return array
        if ((array >= self._lowest) & (array <= self._highest)).all():
            return np.clip(array, self.lower, self.upper)
        raise ActionError(self._refusal(array))

    def _is_within(self, array: Array) -> bool:
        if array.ndim == 1:  # For few numbers, Python takes less time than numpy.
            values = array.tolist()
            return all(map(le, self._limits[0], values)) and all(map(le, values, self._limits[1]))
        return bool(((array >= self.lower) & (array <= self.upper)).all())

    def _shape_text(self, count: int | None) -> str:
        names = ", ".join(f"{c.name} ({c.size})" if c.size > 1 else c.name for c in self._channels)
        return f"{'an action takes' if count is None else f'{count} environments take'} numbers for {names}"

    def _refusal(self, array: Array) -> str:
        rows = array.reshape(-1, len(self.lower))
        row, index = np.argwhere(~((rows >= self._lowest) & (rows <= self._highest)))[0].tolist()
        channel, entries = next((c, s) for c, s in self.parts() if index < s.stop)
        place, value = index - entries.start, rows[row, index]
        allowed = with_unit(f"[{channel.lower[place]:g}, {channel.upper[place]:g}]", channel.unit)
        remedy = (
            "look for what made it so in the policy"
            if not np.isfinite(value)
            else "clip it, as gymnasium.wrappers.ClipAction does, or rescale it, as RescaleAction does"
        )
        of_row = f"environment {row}: " if array.ndim > 1 else ""
        return f"{of_row}the action's entry {channel.entry_text(place)} is {value:g}, not in {allowed}: {remedy}"


def action_channels(testbed: VirtualTestbed, action: Action) -> Channels:
    """Return the channels of an action.

    Args:
        testbed: The testbed.
        action: Names of actuator signals (the agent takes the place of the DPS), of commands u, or addresses of
            variables.

    Raises:
        ValueError: There is no such name, or it has no limits.
    """
    limits = dict(action) if isinstance(action, Mapping) else {}
    names = as_addresses("action", list(action) if isinstance(action, Mapping) else action)
    _check_names("action", names)
    return Channels([_acted(testbed, name, limits.get(name)) for name in names])


def switch_values(testbed: VirtualTestbed, channels: Channels) -> dict[str, float]:
    """Return the values of the switches, by address, at which the agent instead of the DPS commands its actuators.

    Args:
        testbed: The testbed.
        channels: What the agent acts on.
    """
    agents = {signal.name for signal in testbed.interface.act if f"{T_ACT}{signal.name}.idle" in channels.addresses}
    return {f"{T_ACT}{name}": float(Position.REAL.number) for name in agents}


def observation_channels(testbed: VirtualTestbed, observation: Sequence[str]) -> Channels:
    """Return the channels of an observation.

    Args:
        testbed: The testbed.
        observation: Names of sensor signals or of commands u, or addresses of variables or vector output ports.

    Raises:
        ValueError: There is no such name, or it is no vector.
    """
    names = as_addresses("observation", observation)
    _check_names("observation", names)
    return Channels([_observed(testbed, name) for name in names])


def reader_into(testbed: VirtualTestbed, channels: Channels, context: Context) -> Callable[[], Array]:
    """Return a function that reads the channels in a context, shape (size,).

    Args:
        testbed: The testbed.
        channels: The channels.
        context: The root context, which is read at each call.
    """
    readers = [(testbed.bound_reader(context, channel.address), entries) for channel, entries in channels.parts()]
    if len(readers) == 1 and np.ndim(readers[0][0]()) == 1:
        return readers[0][0]

    def read() -> Array:
        values = np.empty(len(channels.lower))
        for evaluate, entries in readers:
            value = evaluate()
            values[entries] = value.ravel() if np.ndim(value) > 1 else value
        return values

    return read


def writer_into(testbed: VirtualTestbed, channels: Channels, context: Context) -> Callable[[Array], None]:
    """Return a function that writes checked numbers, shape (size,), into the channels in a context.

    Args:
        testbed: The testbed.
        channels: The channels.
        context: The root context, which is changed at each call.
    """
    variables = testbed.variables()
    writers = [(_writer(variables[channel.address], context), entries) for channel, entries in channels.parts()]

    def write(values: Array) -> None:
        for write_part, entries in writers:
            write_part(values[entries])

    return write


def _writer(variable: Variable, context: Context) -> Callable[[Array], None]:
    place, shape = variable.place, variable.shape
    if place is not None and place.group == DISCRETE and variable.refuse is None:
        leaf_context = place.system.GetMyMutableContextFromRoot(context)
        if leaf_context.get_discrete_state(place.index).size() == np.prod(shape, dtype=int):
            return partial(leaf_context.SetDiscreteState, place.index)
    return lambda values: variable.set(context, values.reshape(shape))


def _check_names(kind: str, names: Sequence[str]) -> None:
    if not names:
        raise ValueError(f"an environment needs at least one {kind}: give {kind}=[name, ...]")
    if len(set(names)) < len(names):
        raise ValueError(f"a name is given twice as {kind}: {', '.join(names)}")


def _acted(testbed: VirtualTestbed, name: str, limits: Limits | None) -> Channel:
    signals = {signal.name: signal for signal in testbed.interface.act}
    if name in signals:
        _check_vector(signals[name], "an action")
        address = f"{T_ACT}{name}.idle"
    else:
        address = _command_or_address(testbed, name)
    try:
        variable = testbed.variables()[address]
    except AddressError:
        raise ValueError(f"there is nothing to act on named {name!r}{_choices(testbed, name, signals)}") from None
    if variable.derived:
        raise ValueError(f"{name} is derived from other variables, so that no action can set it")
    if variable.choices:
        raise ValueError(f"{name} takes some values only, and an action is any number within limits: act on another")
    size = int(np.prod(variable.shape, dtype=int))
    lower, upper = (np.broadcast_to(np.ravel(bound), size).astype(float) for bound in variable.bounds)
    if limits is not None:
        lower, upper = _narrowed(name, lower, upper, limits)
    if not (np.isfinite(lower) & np.isfinite(upper)).all():
        raise ValueError(
            f"{name} has no limits, which an action needs: declare lower= and upper= of its Signal, or give them here, "
            f"action={{{name!r}: (lower, upper)}}"
        )
    return Channel(name, address, lower, upper, variable.unit, variable.entry_names)


def _narrowed(name: str, lower: Array, upper: Array, limits: Limits) -> tuple[Array, Array]:
    try:
        new = [np.broadcast_to(as_array(f"the limits of {name}", limit), lower.shape) for limit in limits]
        low, high = np.array(new[0]), np.array(new[1])
    except (TypeError, ValueError, IndexError):
        raise ValueError(f"the limits of {name} are (lower, upper), numbers or one per entry, not {limits!r}") from None
    if not ((low >= lower) & (high <= upper) & (low < high)).all():
        raise ValueError(
            f"the limits of {name} must be lower < upper and lie within {lower.tolist()} and {upper.tolist()}, not "
            f"{limits!r}"
        )
    return low, high


def _observed(testbed: VirtualTestbed, name: str) -> Channel:
    signals = {signal.name: signal for signal in testbed.interface.sense}
    if name in signals:
        signal = signals[name]
        _check_vector(signal, "an observation")
        lower, upper = signal.vector(signal.lower), signal.vector(signal.upper)
        return Channel(name, f"{T_SENSE}{name}.value", lower, upper, signal.unit, signal.entry_names)
    address = _command_or_address(testbed, name)
    variables, ports = testbed.variables(), output_ports(testbed.diagram)
    if address in variables:
        variable = variables[address]
        size = int(np.prod(variable.shape, dtype=int))
        low, high = (np.broadcast_to(np.ravel(bound), size).astype(float) for bound in variable.bounds)
        return Channel(name, address, low, high, variable.unit, variable.entry_names)
    if address not in ports:
        raise ValueError(f"there is nothing to observe named {name!r}{_choices(testbed, name, signals)}")
    port = ports[address][1]
    if port.get_data_type() != PortDataType.kVectorValued:
        raise ValueError(f"{name} is an abstract port, and an observation is a vector: observe what is computed of it")
    return Channel(name, address, np.full(port.size(), -np.inf), np.full(port.size(), np.inf))


def _command_or_address(testbed: VirtualTestbed, name: str) -> str:
    commands = {signal.name for signal in testbed.interface.commands}
    return f"{COMMAND}{name}" if name in commands else name


def _check_vector(signal: Signal, role: str) -> None:
    if not signal.is_vector:
        raise ValueError(f"signal {signal.name} is abstract, and {role} is a vector: take a signal with a size")


def _choices(testbed: VirtualTestbed, name: str, signals: Mapping[str, Signal]) -> str:
    commands = [signal.name for signal in testbed.interface.commands]
    names = [signal.name for signal in signals.values() if signal.is_vector] + commands
    near = suggestion(name, [*names, *testbed.addresses()])
    return f"; signals and commands are {', '.join(names)}{near}" if names else near
