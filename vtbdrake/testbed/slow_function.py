"""What a slow part computes, from arrays to arrays: the same in a simulation and in another process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from vtbdrake.state import Codec

Arrays = Mapping[str, np.ndarray]

MEMORY = "memory"
T = TypeVar("T")


class SlowPartError(ValueError):
    """What a slow part's function returned, or what was handed in as its result, is not what it declares."""


@dataclass(frozen=True)
class SlowFunction:
    """A slow part's function with what turns its arguments and results into arrays.

    The arrays of a value are named ``<name>`` or, where its codec makes several, ``<name>.<part>``.

    Attributes:
        function: the user's, see `SlowPart`.
        inputs, outputs: the codecs, by port.
        memory: that of the memory, under its name; empty if there is none.
        makes: the names of all arrays of a result.
    """

    function: Callable[..., Any]
    inputs: Mapping[str, Codec]
    outputs: Mapping[str, Codec]
    memory: Mapping[str, Codec]
    makes: frozenset[str]

    def __call__(self, arrays: Arrays) -> dict[str, np.ndarray]:
        """The arrays of the outputs and the memory, for those of the inputs and the memory.

        Raises:
            SlowPartError: the function did not return what it should; what it raises itself passes.
        """
        codecs = {**self.inputs, **self.memory}
        result = self.function(**{name: decode(arrays, name, codec) for name, codec in codecs.items()})
        remembered = {}
        if self.memory:
            if not (isinstance(result, tuple) and len(result) == 2):
                raise SlowPartError(f"a slow part with a memory returns (outputs, memory), not {result!r}")
            result, memory = result
            remembered = encode({MEMORY: memory}, self.memory)
        made = encode(self._by_name(result), self.outputs) | remembered
        if made.keys() != self.makes:
            raise SlowPartError(
                f"a result's codecs make the arrays {', '.join(sorted(self.makes))} at first, and now {', '.join(made)}"
            )
        return made

    def _by_name(self, outputs: Any) -> Mapping[str, Any]:
        if not isinstance(outputs, Mapping) and len(self.outputs) == 1:
            return dict.fromkeys(self.outputs, outputs)
        if not isinstance(outputs, Mapping) or set(outputs) != set(self.outputs):
            found = ", ".join(map(str, outputs)) if isinstance(outputs, Mapping) else repr(outputs)
            raise SlowPartError(f"a slow part returns its outputs by name ({', '.join(self.outputs)}), not {found}")
        return outputs


def encode(values: Mapping[str, Any], codecs: Mapping[str, Codec]) -> dict[str, np.ndarray]:
    """The values as arrays of their own, which nobody can change any more.

    Raises:
        SlowPartError: a value is not of its codec's type.
    """
    arrays = {}
    for name, codec in codecs.items():
        try:
            parts = codec.encode(values[name])
        except (ValueError, TypeError, AttributeError) as error:
            raise SlowPartError(f"{name}: {error}") from error
        for part, value in parts.items():
            arrays[f"{name}.{part}" if part else name] = _own(value)
    return arrays


def kept(arrays: Arrays) -> dict[str, np.ndarray]:
    """The arrays, as `encode` makes them; those that cannot be changed are not copied."""
    return {name: _own(array) if array.flags.writeable else array for name, array in arrays.items()}


def _own(value: np.ndarray) -> np.ndarray:
    array = np.array(value)
    array.flags.writeable = False
    return array


def decode(arrays: Arrays, name: str, codec: Codec) -> Any:
    """One of the values that the arrays are of."""
    return codec.decode(parts_of(arrays, name))


def parts_of(arrays: Arrays, name: str) -> dict[str, np.ndarray]:
    """The arrays of one value, by part; empty if it is not there."""
    prefix = f"{name}."
    parts = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
    return {"": arrays[name]} if name in arrays else parts


def split_memory(arrays: Mapping[str, T]) -> tuple[dict[str, T], dict[str, T]]:
    """The arrays of the memory and those of the outputs in a result."""
    memory = {name: array for name, array in arrays.items() if name.partition(".")[0] == MEMORY}
    return memory, {name: array for name, array in arrays.items() if name not in memory}
