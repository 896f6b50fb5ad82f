"""Declarations of a system in Python: its state and parameters by name, and the codecs of its abstract state."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    ContinuousStateIndex,
    DependencyTicket,
    DiscreteStateIndex,
    DiscreteValues,
    LeafSystem,
    NumericParameterIndex,
    ValueProducer,
)

from vtbdrake.common.argument_checks import as_array, suggestion

CONTINUOUS = "continuous"
DISCRETE = "discrete"
PARAMETER = "parameter"


@dataclass(frozen=True)
class Element:
    """One named piece of a numeric group of a LeafSystem's context.

    Attributes:
        name: Last part of the address.
        group: ``continuous``, ``discrete`` or ``parameter``.
        index: Number of the group.
        shape: ``()`` is a scalar; arrays lie in C order.
        start: First entry in the group.
        unit: SI unit; ``"1"`` if it has none.
        bounds: Closed interval, for every entry.
    """

    name: str
    group: str
    index: int
    shape: tuple[int, ...] = ()
    start: int = 0
    unit: str = "1"
    bounds: tuple[ArrayLike, ArrayLike] = (-inf, inf)


@dataclass(frozen=True)
class Codec:
    """A pair of functions that turn an abstract state into named arrays and back.

    Attributes:
        encode: Returns the arrays of a value, by name.
        decode: Returns the value of such arrays.
    """

    encode: Callable[[Any], Mapping[str, np.ndarray]]
    decode: Callable[[Mapping[str, np.ndarray]], Any]


@dataclass(frozen=True)
class Quantity:
    """The declaration of one piece of state or of parameters; its name is the last part of its address.

    Attributes:
        default: A number, or an array of the shape of the quantity.
        unit: SI unit; ``"1"`` if it has none.
        bounds: Closed interval, for every entry.
        addressed: Whether it is a variable of the Diagram.
    """

    default: ArrayLike = 0.0
    unit: str = "1"
    bounds: tuple[ArrayLike, ArrayLike] = (-inf, inf)
    addressed: bool = True


class NamedView:
    """The quantities of one array as attributes: numbers as float, others as views of their shape.

    It is made by `NamedVector.view`. What is assigned is written to the array, which ``np.asarray(view)`` returns.
    """

    __slots__ = ("_array",)
    _names: tuple[str, ...] = ()

    def __init__(self, array: np.ndarray) -> None:
        self._array = array

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self._array, dtype=dtype) if copy else np.asarray(self._array, dtype=dtype)

    def __repr__(self) -> str:
        return f"NamedView({', '.join(f'{name}={getattr(self, name)!r}' for name in self._names)})"

    # This is called where no property of the name exists.
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # numpy looks for some whenever it makes an array; suggestions would take 80 us.
            raise AttributeError(name)
        raise AttributeError(f"there is no {name!r} among {', '.join(self._names)}{suggestion(name, self._names)}")

    if TYPE_CHECKING:

        def __setattr__(self, name: str, value: Any) -> None: ...


class NamedVector:
    """A vector of quantities that lie behind one another in the order of their declaration, arrays in C order.

    ``NamedVector(angle=Quantity(0.0, unit="rad"), force=Quantity([0.0, 0.0], unit="N"))`` is Drake's ``namedview`` with
    shapes, defaults, units and bounds.

    Attributes:
        quantities: The quantities by name.
        size: Number of entries.

    Raises:
        ValueError: A default or a bound is no number, or a default lies outside its bounds.
    """

    def __init__(self, **quantities: Quantity) -> None:
        self.quantities = quantities
        self._defaults = {name: _checked_default(name, quantity) for name, quantity in quantities.items()}
        starts = np.cumsum([0, *(default.size for default in self._defaults.values())]).tolist()
        self._starts = dict(zip(quantities, starts, strict=False))
        self.size: int = starts[-1]
        accessors = {name: _accessor(self._starts[name], default.shape) for name, default in self._defaults.items()}
        self._view = type("NamedView", (NamedView,), {"__slots__": (), "_names": tuple(quantities), **accessors})

    def view(self, array: np.ndarray) -> NamedView:
        """Return the quantities in an array of shape (size,), to be read and written by name."""
        view: NamedView = self._view(array)
        return view

    def array(self, **values: ArrayLike) -> np.ndarray:
        """Return an array, shape (size,), with these values by name; the others have their defaults."""
        array = np.empty(self.size)
        view = self.view(array)
        for name, value in {**self._defaults, **values}.items():
            setattr(view, name, value)
        return array

    def slice_of(self, name: str) -> slice:
        """Return the slice of the entries of a quantity."""
        return slice(self._starts[name], self._starts[name] + self._defaults[name].size)

    def elements(self, group: str, index: int) -> Iterator[Element]:
        """Yield the pieces of the numeric group ``index`` that this vector describes.

        Args:
            group: Kind of the group: `CONTINUOUS`, `DISCRETE` or `PARAMETER`.
            index: Number of the group among the system's groups of this kind.
        """
        for name, quantity in self.quantities.items():
            if quantity.addressed:
                shape, start = self._defaults[name].shape, self._starts[name]
                yield Element(name, group, index, shape, start, quantity.unit, quantity.bounds)


def _checked_default(name: str, quantity: Quantity) -> np.ndarray:
    """Return the default of a quantity as an array; raise a ValueError if it or the bounds are not possible."""
    if not isinstance(quantity, Quantity):
        raise ValueError(f"declare {name} as {name}=Quantity(default, unit), not as {name}={quantity!r}")
    default = as_array(f"the default of {name}", quantity.default)
    try:
        lower, upper = quantity.bounds
    except (TypeError, ValueError):
        raise ValueError(f"the bounds of {name} are (lower, upper), not {quantity.bounds!r}") from None
    lower, upper = (as_array(f"each of the bounds of {name}", bound) for bound in (lower, upper))
    for bound in (lower, upper):
        if bound.shape not in ((), default.shape):
            raise ValueError(f"the bounds of {name} are numbers or have its shape {default.shape}, not {bound.shape}")
    if not np.all(lower <= upper):
        raise ValueError(f"the bounds of {name} are (lower, upper), not {quantity.bounds!r}")
    if np.any((default < lower) | (default > upper)):  # NaN is no value, such as no command.
        raise ValueError(f"the default of {name}, {quantity.default!r}, lies outside its bounds {quantity.bounds!r}")
    return default


def _accessor(start: int, shape: tuple[int, ...]) -> property:
    if not shape:

        def get(view: NamedView) -> Any:
            return view._array.item(start)

        def set_entry(view: NamedView, value: float) -> None:
            view._array[start] = value

        return property(get, set_entry)

    entries = slice(start, start + int(np.prod(shape)))

    def get_vector(view: NamedView) -> np.ndarray:
        return view._array[entries]

    def set_vector(view: NamedView, value: ArrayLike) -> None:
        view._array[entries] = value

    def get_array(view: NamedView) -> np.ndarray:
        return view._array[entries].reshape(shape)

    def set_array(view: NamedView, value: ArrayLike) -> None:
        view._array[entries].reshape(shape)[...] = value

    return property(get_vector, set_vector) if len(shape) == 1 else property(get_array, set_array)


class _Group:
    """A numeric group of a system's Context whose quantities have names."""

    def __init__(self, vector: NamedVector, number: int) -> None:
        self.vector = vector
        self._number = number
        self._view = vector.view


class ParameterGroup(_Group):
    """The parameters that `AddressedSystem.declare_parameters` has declared.

    Args:
        number: Drake's number of the group.

    Attributes:
        vector: Names, defaults and layout.
        index: Drake's index of the group.
    """

    def __init__(self, vector: NamedVector, number: int) -> None:
        super().__init__(vector, number)
        self.index = NumericParameterIndex(number)

    def array(self, context: Context) -> np.ndarray:
        """Return the values in the system's own context as one array, to be read."""
        values: np.ndarray = context.get_numeric_parameter(self._number).value()
        return values

    def view(self, context: Context) -> NamedView:
        """Return the values in the system's own context by name, to be read."""
        return self._view(context.get_numeric_parameter(self._number).value())

    def mutable(self, context: Context) -> NamedView:
        """Return the values in the system's own context by name, to be read and written."""
        return self._view(context.get_mutable_numeric_parameter(self._number).get_mutable_value())


class DiscreteGroup(_Group):
    """The discrete state that `AddressedSystem.declare_discrete_state` has declared.

    Args:
        number: Drake's number of the group.

    Attributes:
        vector: Names, defaults and layout.
        index: Drake's index of the group.
    """

    def __init__(self, vector: NamedVector, number: int) -> None:
        super().__init__(vector, number)
        self.index = DiscreteStateIndex(number)

    def array(self, context: Context) -> np.ndarray:
        """Return the values in the system's own context as one array, to be read."""
        values: np.ndarray = context.get_discrete_state(self._number).value()
        return values

    def view(self, context: Context) -> NamedView:
        """Return the values in the system's own context by name, to be read."""
        return self._view(context.get_discrete_state(self._number).value())

    def mutable_array(self, state: DiscreteValues) -> np.ndarray:
        """Return the values in ``state`` (see `mutable`) as one array, to be read and written."""
        values: np.ndarray = state.get_mutable_value(self._number)
        return values

    def mutable(self, state: DiscreteValues) -> NamedView:
        """Return the values in ``state`` by name, to be read and written.

        Args:
            state: The argument of a discrete update, which holds the present values at first; or
                ``context.get_mutable_discrete_state()``.
        """
        return self._view(state.get_mutable_value(self._number))


class ContinuousGroup(_Group):
    """The continuous state that `AddressedSystem.declare_continuous_state` has declared.

    Args:
        number: Drake's number of the group.

    Attributes:
        vector: Names, defaults and layout; ``derivatives.SetFromVector(group.vector.array(...))`` sets derivatives.
        index: Drake's index of the group.
    """

    def __init__(self, vector: NamedVector, number: int) -> None:
        super().__init__(vector, number)
        self.index = ContinuousStateIndex(number)

    def view(self, context: Context) -> NamedView:
        """Return a copy of the values in the system's own context by name."""
        return self._view(context.get_continuous_state_vector().CopyToVector())


def weakly(owner: Any, method: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that calls ``method(owner, ...)`` and does not keep ``owner`` alive.

    Drake keeps the functions of output ports and cache entries in C++, where Python's garbage collector cannot follow
    references. A bound method there holds its system, which holds the method: neither would ever be freed, nor the
    Diagram around.

    Args:
        owner: The object to which a weak reference is kept.
        method: The function to call with the owner before all other arguments.
    """
    reference = weakref.ref(owner)

    def call(*arguments: Any) -> Any:
        # The wrapper of a system lives as long as its Diagram does.
        return method(reference(), *arguments)

    return call


# The ``__slots__`` of every class that derives from LeafSystem. With an instance dict beside the one of Drake's class,
# the collector visits it twice (drake 1.51) and considers it referenced from outside. Attributes go into Drake's dict.
NO_DICT: tuple[str, ...] = ()

if TYPE_CHECKING:
    _LeafSystem: TypeAlias = LeafSystem
elif type(LeafSystem).__module__.startswith("nanobind"):
    # These classes have no dict of their own, and their metaclass has no subclasses.
    _LeafSystem = LeafSystem
else:

    class _WithoutDict(type(LeafSystem)):
        """Gives every subclass ``__slots__ = NO_DICT``."""

        def __new__(cls, name: str, bases: tuple[type, ...], namespace: dict[str, Any], **options: Any) -> type:
            return super().__new__(cls, name, bases, {"__slots__": NO_DICT, **namespace}, **options)

    _LeafSystem = _WithoutDict("_LeafSystem", (LeafSystem,), {})


class AddressedSystem(_LeafSystem):
    """A LeafSystem whose state and parameters have names, by which it reads and writes them, and addresses.

    Each ``declare_...`` takes the quantities of one numeric group by name, and returns that group. An update reads
    ``self.settings.view(context).gain`` and writes ``self.memory.mutable(state).torque = ...``.

    Output ports and cache entries can be declared with methods of the system. (A plain LeafSystem that does so is never
    freed by Python's garbage collector, nor the Diagram around it.)

    Attributes:
        variables: What has an address: all declared quantities, in the order of their declaration. A system without
            this attribute has its groups as variables. Subclasses may change it.
        entry_names: The names of the entries of all its variables of shape (len(entry_names),), such as names of its
            joints; empty if they have none.
        timings: The timings (period, offset) of the periodic updates that have been declared, in s. Drake does not tell
            the timings of unrestricted updates, nor of several.
    """

    __slots__ = NO_DICT

    variables: tuple[Element, ...]
    entry_names: tuple[str, ...] = ()
    timings: tuple[tuple[float, float], ...] = ()

    def declare_parameters(self, **quantities: Quantity) -> ParameterGroup:
        """Declare a group of parameters, part of a in s = [x, a]."""
        vector = NamedVector(**quantities)
        number = int(self.DeclareNumericParameter(BasicVector(vector.array())))
        return ParameterGroup(vector, self._named(vector, PARAMETER, number))

    def declare_discrete_state(self, **quantities: Quantity) -> DiscreteGroup:
        """Declare a group of discrete state, part of x in s = [x, a]."""
        vector = NamedVector(**quantities)
        return DiscreteGroup(vector, self._named(vector, DISCRETE, int(self.DeclareDiscreteState(vector.array()))))

    def declare_continuous_state(self, **quantities: Quantity) -> ContinuousGroup:
        """Declare the continuous state, part of x in s = [x, a].

        Raises:
            ValueError: The system has declared continuous state before; Drake systems have one vector of it.
        """
        if any(element.group == CONTINUOUS for element in getattr(self, "variables", ())):
            raise ValueError(f"{type(self).__name__} has one vector of continuous state: declare all of it at once")
        vector = NamedVector(**quantities)
        number = int(self.DeclareContinuousState(BasicVector(vector.array())))
        return ContinuousGroup(vector, self._named(vector, CONTINUOUS, number))

    def _named(self, vector: NamedVector, group: str, number: int) -> int:
        self.variables = (*getattr(self, "variables", ()), *vector.elements(group, number))
        return number

    def declare_cache(
        self, description: str, calc: Callable[[Context], Any], prerequisites: set[DependencyTicket]
    ) -> Callable[[Context], Any]:
        """Declare a cache entry, and return the function of the system's own context that evaluates it.

        Args:
            description: What the entry holds.
            calc: The function of the system's own context that computes it.
            prerequisites: What the result depends on.
        """
        compute = self._not_holding(calc)
        producer = ValueProducer(
            allocate=lambda: Value(object()), calc=lambda context, value: value.set_value(compute(context))
        )
        index = self.DeclareCacheEntry(description, producer, prerequisites).cache_index()
        # The entry itself would hold the system.
        return weakly(self, lambda system, context: system.get_cache_entry(index).Eval(context))

    if not TYPE_CHECKING:

        def DeclareVectorOutputPort(self, *arguments: Any, **options: Any) -> Any:
            """Declare a vector output port, as Drake does; its function may be a method of this system.

            Args:
                arguments: Positional arguments of Drake's method.
                options: Keyword arguments of Drake's method.
            """
            arguments, options = self._not_holding_any(arguments, options)
            return super().DeclareVectorOutputPort(*arguments, **options)

        def DeclareAbstractOutputPort(self, *arguments: Any, **options: Any) -> Any:
            """Declare an abstract output port, as Drake does; its functions may be methods of this system.

            Args:
                arguments: Positional arguments of Drake's method.
                options: Keyword arguments of Drake's method.
            """
            arguments, options = self._not_holding_any(arguments, options)
            return super().DeclareAbstractOutputPort(*arguments, **options)

        def DeclarePeriodicDiscreteUpdateEvent(self, period_sec: float, offset_sec: float, update: Any) -> None:
            """Declare a discrete update, as Drake does, and remember its timing.

            Args:
                period_sec: The time between two updates, in s.
                offset_sec: The time of the first update, in s.
                update: The function of the update.
            """
            super().DeclarePeriodicDiscreteUpdateEvent(period_sec, offset_sec, update)
            self._remember_timing(period_sec, offset_sec)

        def DeclarePeriodicUnrestrictedUpdateEvent(self, period_sec: float, offset_sec: float, update: Any) -> None:
            """Declare an unrestricted update, as Drake does, and remember its timing.

            Args:
                period_sec: The time between two updates, in s.
                offset_sec: The time of the first update, in s.
                update: The function of the update.
            """
            super().DeclarePeriodicUnrestrictedUpdateEvent(period_sec, offset_sec, update)
            self._remember_timing(period_sec, offset_sec)

    def _remember_timing(self, period: float, offset: float) -> None:
        self.timings = (*self.timings, (float(period), float(offset)))

    def _not_holding_any(
        self, arguments: Iterable[Any], options: Mapping[str, Any]
    ) -> tuple[list[Any], dict[str, Any]]:
        """Return the arguments with functions that do not keep the system alive in place of its methods."""
        return (
            [self._not_holding(argument) for argument in arguments],
            {name: self._not_holding(argument) for name, argument in options.items()},
        )

    def _not_holding(self, argument: Any) -> Any:
        is_method = getattr(argument, "__self__", None) is self and hasattr(argument, "__func__")
        return weakly(self, argument.__func__) if is_method else argument
