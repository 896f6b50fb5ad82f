"""The abstract state of a leaf system as named arrays, and back."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, System
from pydrake.systems.primitives import DiscreteTimeDelay

from vtbdrake.state.codecs import codec_of
from vtbdrake.state.element import Codec
from vtbdrake.state.kinds import is_camera, is_plant, is_scene_graph
from vtbdrake.state.systems import class_name

Arrays = Mapping[str, np.ndarray]


class SnapshotError(ValueError):
    """A snapshot that cannot be taken or applied."""


class AbstractState:
    """Reads and writes the abstract state of one leaf system.

    The system's attribute ``codecs`` says how a state becomes arrays; where it says nothing, `codec_of` the value that
    the state has does.

    Args:
        path: of the system, for messages.
        system: the leaf system.
        context: any context of this system.

    Raises:
        SnapshotError: the system keeps an abstract value that no codec can carry.
    """

    def __init__(self, path: str, system: System, context: Context) -> None:
        self._path = path
        self._system = system
        self._codecs: dict[int, Codec] = {}
        # What a snapshot needs of these is in their variables.
        if is_plant(system) or is_scene_graph(system) or is_camera(system):
            return
        if context.num_abstract_parameters():
            raise SnapshotError(
                f"{path} ({class_name(system)}) has an abstract parameter, which a snapshot cannot hold: use a system "
                "that keeps it in numeric parameters, or in abstract state with a codec"
            )
        declared: Mapping[int, Codec] = getattr(system, "codecs", {})
        for index in range(context.num_abstract_states()):
            self._codecs[index] = declared.get(index) or self._codec_of(context, index)

    def _codec_of(self, context: Context, index: int) -> Codec:
        try:
            return codec_of(context.get_abstract_state(index).get_value(), varying=True)
        # pydrake has a RuntimeError for a type of C++ that Python does not know.
        except (ValueError, RuntimeError) as error:
            reason = str(error) if isinstance(error, ValueError) else "Python does not know its type"
            raise SnapshotError(
                f"{self._path} keeps abstract state {index} and declares no codec for it: give the system, a "
                f"{class_name(self._system)}, an attribute codecs = {{{index}: Codec(encode, decode)}}, or use another "
                f"one ({reason})"
            ) from error

    def __bool__(self) -> bool:
        return bool(self._codecs)

    def read(self, context: Context) -> dict[str, np.ndarray]:
        """The arrays of the state in the system's own context, as ``<index>/<name>``.

        Raises:
            SnapshotError: the state has become something that its codec does not take.
        """
        arrays: dict[str, np.ndarray] = {}
        for index in self._codecs:
            arrays |= self._encode(index, context.get_abstract_state(index).get_value())
        return arrays

    def _encode(self, index: int, value: object) -> dict[str, np.ndarray]:
        try:
            parts = self._codecs[index].encode(value)
        except (ValueError, TypeError, AttributeError) as error:
            raise SnapshotError(f"abstract state {index} of {self._path}: {error}") from error
        return {f"{index}/{name}": np.asarray(array) for name, array in parts.items()}

    def writer(self, arrays: Arrays) -> Callable[[Context], None]:
        """What sets the state in the system's own context to what `read` gave.

        Raises:
            SnapshotError: the arrays are not those of such a state.
        """
        values = {index: self._decode(index, arrays) for index in self._codecs}

        def write(context: Context) -> None:
            for index, value in values.items():
                context.SetAbstractState(index, value)

        return write

    def _decode(self, index: int, arrays: Arrays) -> object:
        prefix = f"{index}/"
        parts = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
        try:
            return self._codecs[index].decode(parts)
        except Exception as error:  # The codec may be anybody's, and so may the arrays.
            raise SnapshotError(
                f"abstract state {index} of {self._path} cannot be made of the arrays {', '.join(parts) or 'none'}: "
                f"{type(error).__name__}: {error}"
            ) from error


class DelayState(AbstractState):
    """Reads and writes the state of a DiscreteTimeDelay of abstract values.

    Drake keeps it as a ring whose beginning Python cannot read. So the delayed values are read at the output, oldest
    first, by stepping a copy; and another copy is filled through its input.
    """

    def __init__(self, path: str, system: DiscreteTimeDelay, context: Context) -> None:
        self._path = path
        self._system = system
        # The last abstract state is the beginning of the ring.
        self._codecs = dict.fromkeys(range(context.num_abstract_states() - 1), self._codec_of(context, 0))

    def read(self, context: Context) -> dict[str, np.ndarray]:
        """The arrays of the delayed values, as ``<index>/<name>``, the oldest with the index 0."""
        own = self._system.CreateDefaultContext()
        own.SetStateAndParametersFrom(context)
        self._feed(own, own.get_abstract_state(0).get_value())
        arrays: dict[str, np.ndarray] = {}
        for index in self._codecs:
            parts = self._encode(index, self._system.get_output_port().Eval(own))
            # The next step overwrites what is shown.
            arrays |= {name: np.array(array) for name, array in parts.items()}
            self._step(own)
        return arrays

    def writer(self, arrays: Arrays) -> Callable[[Context], None]:
        own = self._system.CreateDefaultContext()
        for index in self._codecs:
            self._feed(own, self._decode(index, arrays))
            self._step(own)
        return lambda context: context.SetStateAndParametersFrom(own)

    def _feed(self, own: Context, value: object) -> None:
        port = self._system.get_input_port()
        wrapped = port.Allocate()
        wrapped.set_value(value)
        port.FixValue(own, wrapped)

    def _step(self, own: Context) -> None:
        own.SetTime(0.0)  # The first time at which the input is sampled.
        Simulator(self._system, own).AdvancePendingEvents()


def abstract_state(path: str, system: System, context: Context) -> AbstractState:
    """How the abstract state of the leaf system at ``path`` is read and written; ``context`` is any of its own.

    Raises:
        SnapshotError: the system keeps an abstract value that no codec can carry.
    """
    if isinstance(system, DiscreteTimeDelay) and context.num_abstract_states():
        return DelayState(path, system, context)
    return AbstractState(path, system, context)
