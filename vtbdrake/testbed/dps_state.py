"""The state of the whole DPS, as one of its slow parts samples it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, InputPort, LeafSystem, System

from vtbdrake.state import Codec
from vtbdrake.state.layout import FlatState, StateLayout


@dataclass(frozen=True, eq=False)
class DpsState:
    """The state of a DPS at one instant, before the updates of that instant.

    Attributes:
        time: The instant, in seconds.
        contents: State and parameters of the DPS's systems.
        commands: The commands u that are set from outside, by name.
        received: The vector sensor values that the DPS has at its ports at this instant, by name; without those never
            fed.
    """

    time: float
    contents: FlatState
    commands: Mapping[str, np.ndarray]
    received: Mapping[str, np.ndarray]


def _encode(state: DpsState) -> dict[str, np.ndarray]:
    names = np.frombuffer("\n".join(state.contents.names).encode(), dtype=np.uint8)
    numbers = {"time": np.array(state.time), "names": names, "numbers": state.contents.numbers}
    commands = {f"u.{name}": value for name, value in state.commands.items()}
    received = {f"received.{name}": value for name, value in state.received.items()}
    return numbers | commands | received | {f"abstract.{key}": array for key, array in state.contents.abstract.items()}


def _decode(arrays: Mapping[str, np.ndarray]) -> DpsState:
    names = tuple(arrays["names"].tobytes().decode().split("\n"))
    contents = FlatState(names, arrays["numbers"], _below("abstract.", arrays))
    return DpsState(arrays["time"].item(), contents, _below("u.", arrays), _below("received.", arrays))


def _below(prefix: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key.removeprefix(prefix): array for key, array in arrays.items() if key.startswith(prefix)}


DPS_STATE_CODEC = Codec(_encode, _decode)


class DpsReader:
    """Reads the state of a DPS in root contexts of its Diagram.

    Args:
        layout: Layout of the DPS's systems.
        commands: Functions of a root context that read the commands u that are set from outside, by name.
        sensors: The DPS's input ports of sensor signals that are vectors, by name.
    """

    def __init__(
        self,
        layout: StateLayout,
        commands: Mapping[str, Callable[[Context], Any]],
        sensors: Mapping[str, tuple[System, InputPort]],
    ) -> None:
        self._layout = layout
        self._commands = dict(commands)
        self._sensors = dict(sensors)

    def __call__(self, root: Context) -> DpsState:
        commands = {name: np.array(read(root), dtype=float) for name, read in self._commands.items()}
        received = {}
        for name, (dps, port) in self._sensors.items():
            dps_context = dps.GetMyContextFromRoot(root)
            if port.HasValue(dps_context):
                received[name] = np.array(port.Eval(dps_context))
        return DpsState(root.get_time(), self._layout.take(root), commands, received)


class RootReference:
    """A reference from the context of one system to the root context, which Drake does not show to a system.

    It is the value of an input port of that system. A Clone of the root context shares it, which `find` detects.

    Args:
        root: The root context, which is not kept alive; None is a reference to nothing.
    """

    def __init__(self, root: Context | None = None) -> None:
        self._find: Callable[[], Context | None] = weakref.ref(root) if root is not None else lambda: None

    def __deepcopy__(self, memo: dict[int, Any]) -> RootReference:
        return self

    def find(self, system: LeafSystem, context: Context) -> Context:
        """Return the root context.

        Args:
            system: The system.
            context: The context of the system.

        Raises:
            ValueError: ``context`` is not part of the root context.
        """
        root = self._find()
        # There is one Python object for one context of Drake's, as long as that object is alive.
        if root is None or system.GetMyContextFromRoot(root) is not context:
            raise ValueError(
                f"{system.GetSystemPathname()} samples the state of the whole DPS, which it does not find from this "
                "context (a Clone, or one that Drake has made): make the context with testbed.default_context(), or "
                "the simulator with testbed.simulator(context)"
            )
        return root
