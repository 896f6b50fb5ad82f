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
    for (source, _), (reader, _) in connections(diagram):
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
    """Return the paths from a source to the follower ``path``, both included, in what `followers` returned.

    Args:
        predecessors: Path of each follower -> path of the system before it, see `followers`.
        path: Path of the follower, one of the keys.
    """
    passed = [path]
    while predecessors[passed[-1]] != passed[-1]:
        passed.append(predecessors[passed[-1]])
    return passed[::-1]


def connections(diagram: Diagram) -> Iterator[tuple[tuple[System, int], tuple[System, int]]]:
    """Yield all connections between leaf systems, in ``diagram`` and below.

    Each is ((writer, number of its output port), (reader, number of its input port)).
    """
    for (reader, input_port), (writer, output_port) in diagram.connection_map().items():
        source = writer_of(writer, output_port)
        for leaf in _readers(reader, input_port):
            yield source, leaf
    for system in diagram.GetSystems():
        if isinstance(system, Diagram):
            yield from connections(system)


def writer_of(system: System, port: OutputPortIndex) -> tuple[System, int]:
    """Return the leaf system that computes an output port, and the number of its own port.

    Args:
        system: A leaf system or a Diagram.
        port: The number of the output port of ``system``.
    """
    while isinstance(system, Diagram):
        system, port = system.get_output_port_locator(port)
    return system, int(port)


def _readers(system: System, port: InputPortIndex) -> Iterator[tuple[System, int]]:
    if not isinstance(system, Diagram):
        yield system, int(port)
        return
    for inner, inner_port in system.GetInputPortLocators(port):
        yield from _readers(inner, inner_port)
