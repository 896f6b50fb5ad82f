"""Which systems of a Diagram depend on which, through its connections."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

from pydrake.systems.framework import Diagram, InputPortIndex, OutputPortIndex, System

from vtbdrake.state.systems import leaves


def followers(diagram: Diagram, sources: Iterable[str]) -> dict[str, str]:
    """Return the leaf systems that depend on the sources through connections, in order of distance.

    Every output of a system is assumed to depend on all its inputs, its state and its parameters.

    Args:
        diagram: The Diagram.
        sources: Paths of leaf systems.

    Returns:
        Path of each follower -> path of the system from which it was reached first; a source is mapped to itself.
    """
    paths = {system: path for path, system in leaves(diagram)}
    readers: dict[str, list[str]] = {path: [] for path in paths.values()}
    for source, reader in _connections(diagram):
        readers[paths[source]].append(paths[reader])
    predecessors = {source: source for source in sources}
    waiting = deque(predecessors)
    while waiting:
        path = waiting.popleft()
        for reader in readers[path]:
            if reader not in predecessors:
                predecessors[reader] = path
                waiting.append(reader)
    return predecessors


def chain(predecessors: dict[str, str], path: str) -> list[str]:
    """Return the paths from a source to the follower ``path``, both included, in what `followers` returned."""
    passed = [path]
    while predecessors[passed[-1]] != passed[-1]:
        passed.append(predecessors[passed[-1]])
    return passed[::-1]


def _connections(diagram: Diagram) -> Iterator[tuple[System, System]]:
    """Yield (writer, reader) of all connections between leaf systems, in ``diagram`` and below."""
    for (reader, input_port), (writer, output_port) in diagram.connection_map().items():
        source = _writer(writer, output_port)
        for leaf in _readers(reader, input_port):
            yield source, leaf
    for system in diagram.GetSystems():
        if isinstance(system, Diagram):
            yield from _connections(system)


def _writer(system: System, port: OutputPortIndex) -> System:
    while isinstance(system, Diagram):
        system, port = system.get_output_port_locator(port)
    return system


def _readers(system: System, port: InputPortIndex) -> Iterator[System]:
    if not isinstance(system, Diagram):
        yield system
        return
    for inner, inner_port in system.GetInputPortLocators(port):
        yield from _readers(inner, inner_port)
