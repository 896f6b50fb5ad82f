"""The function of a slow part, from arrays to arrays, as it is sent to another process; its arguments as arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from vtbdrake.state import Codec

Arrays = Mapping[str, np.ndarray]

MEMORY = "memory"
_T = TypeVar("_T")


class SlowPartError(ValueError):
    """A result of a slow part does not match its declaration."""


@dataclass(frozen=True)
class SlowFunction:
    """A slow part's function with the codecs that turn its arguments and results into arrays.

    The arrays of a value are named ``<name>`` or, where its codec makes several, ``<name>.<part>``.

    Attributes:
        function: The user's function, see `SlowPart`.
        inputs, outputs: The codecs, by port.
        memory: The codec of the memory, under its name; empty if there is none.
        makes: The names of all arrays of a result.
    """

    function: Callable[..., Any]
    inputs: Mapping[str, Codec]
    outputs: Mapping[str, Codec]
    memory: Mapping[str, Codec]
    makes: frozenset[str]

    def __call__(self, arrays: Arrays) -> dict[str, np.ndarray]:
        """Return the arrays of the outputs and the memory, for the arrays of the inputs and the memory.

        If the function returns None for the outputs, there is no result, and no arrays of outputs.

        Raises:
            SlowPartError: The function did not return the declared outputs.
            Exception: Any exception of the function.
        """
        codecs = {**self.inputs, **self.memory}
        result = self.function(**{name: decode(arrays, name, codec) for name, codec in codecs.items()})
        if result is None:
            return {}
        remembered = {}
        if self.memory:
            if not (isinstance(result, tuple) and len(result) == 2):
                raise SlowPartError(f"a slow part with a memory returns (outputs, memory), not {result!r}")
            result, memory = result
            remembered = encode({MEMORY: memory}, self.memory)
            if result is None:
                return remembered
        made = encode(self._by_name(result), self.outputs) | remembered
        if made.keys() != self.makes:
            raise SlowPartError(
                f"a result's codecs make the arrays {', '.join(sorted(self.makes))} at first, and now {', '.join(made)}"
            )
        return made

    def prepare(self) -> None:
        """Call the method ``prepare`` of the user's function, if it has one."""
        prepare = getattr(self.function, "prepare", None)
        if prepare is not None:
            prepare()

    def _by_name(self, outputs: Any) -> Mapping[str, Any]:
        if not isinstance(outputs, Mapping) and len(self.outputs) == 1:
            return dict.fromkeys(self.outputs, outputs)
        if not isinstance(outputs, Mapping) or set(outputs) != set(self.outputs):
            returned = ", ".join(map(str, outputs)) if isinstance(outputs, Mapping) else repr(outputs)
            raise SlowPartError(f"a slow part returns its outputs by name ({', '.join(self.outputs)}), not {returned}")
        return outputs


def encode(values: Mapping[str, Any], codecs: Mapping[str, Codec]) -> dict[str, np.ndarray]:
    """Return the values as read-only arrays of their own.

    Args:
        values: The values by name; every codec needs one.
        codecs: The codec of each value, by its name.

    Raises:
        SlowPartError: A value is not of its codec's type.
    """
    arrays = {}
    for name, codec in codecs.items():
        try:
            parts = codec.encode(values[name])
        except (ValueError, TypeError, AttributeError) as error:
            raise SlowPartError(f"{name}: {error}") from error
        for part, value in parts.items():
            arrays[f"{name}.{part}" if part else name] = _read_only_copy(value)
    return arrays


def read_only(arrays: Arrays) -> dict[str, np.ndarray]:
    """Return the arrays as `encode` makes them; read-only ones are not copied."""
    return {name: _read_only_copy(array) if array.flags.writeable else array for name, array in arrays.items()}


def _read_only_copy(value: np.ndarray) -> np.ndarray:
    array = np.array(value)
    array.flags.writeable = False
    return array


def decode(arrays: Arrays, name: str, codec: Codec) -> Any:
    """Return one of the values that the arrays hold.

    Args:
        arrays: The arrays by ``name`` or ``name.part``, as `encode` returns them.
        name: The name of the value.
        codec: The codec of the value.
    """
    return codec.decode(parts_of(arrays, name))


def parts_of(arrays: Arrays, name: str) -> dict[str, np.ndarray]:
    """Return the arrays of one value, by part; empty if it is not there.

    Args:
        arrays: The arrays by ``name`` or ``name.part``, as `encode` returns them.
        name: The name of the value.
    """
    prefix = f"{name}."
    parts = {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}
    return {"": arrays[name]} if name in arrays else parts


def split_memory(arrays: Mapping[str, _T]) -> tuple[dict[str, _T], dict[str, _T]]:
    """Return the arrays of the memory and the arrays of the outputs in a result."""
    memory = {name: array for name, array in arrays.items() if name.partition(".")[0] == MEMORY}
    return memory, {name: array for name, array in arrays.items() if name not in memory}
