"""Geometry that a program has changed in a Context: no variable and no numeric group holds it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from copy import copy
from typing import Any

import numpy as np
from pydrake.geometry import GeometryId, GeometryVersion, Role, SceneGraph, SceneGraphInspector
from pydrake.systems.framework import Context, Diagram

from vtbdrake.state.codecs import SnapshotError
from vtbdrake.state.multibody import FRICTION
from vtbdrake.state.systems import is_scene_graph, leaves

_REMEMBERED = 8
"""The number of versions that are remembered because they differ in friction alone."""

_READERS = {
    Role.kProximity: SceneGraphInspector.GetProximityProperties,
    Role.kPerception: SceneGraphInspector.GetPerceptionProperties,
}
"""The roles that a simulation and its cameras depend on, each with the reader of a geometry's properties."""

# Shape and properties of the geometries of a role.
_Looks = dict[GeometryId, tuple[str, dict[tuple[str, str], Any]]]


class GeometryWatch:
    """Finds geometry that differs between a context and the default context of its Diagram.

    Drake changes the geometry in a context by `ChangeShape`, `AssignRole`, `RemoveRole`, `RemoveGeometry` and by
    collision filters. Coefficients of friction are left out, as they are variables.

    Args:
        diagram: The root Diagram.
    """

    def __init__(self, diagram: Diagram) -> None:
        self._scene_graphs = [_WatchedScene(system) for _, system in leaves(diagram) if is_scene_graph(system)]

    def remember(self, context: Context) -> None:
        """Take a default context of the Diagram, in which nothing has been changed, for later comparisons."""
        for scene in self._scene_graphs:
            scene.remember(context)

    def check(self, context: Context) -> None:
        """Check that nothing differs but friction.

        Args:
            context: A root context of the Diagram.

        Raises:
            SnapshotError: Something differs, and a snapshot would lose it.
        """
        for scene in self._scene_graphs:
            scene.check(context)


class _WatchedScene:
    def __init__(self, scene_graph: SceneGraph) -> None:
        self._scene_graph = scene_graph
        self._same: deque[GeometryVersion] = deque(maxlen=_REMEMBERED)  # in which nothing differs

    def _inspector(self, context: Context) -> SceneGraphInspector:
        return self._scene_graph.get_query_output_port().Eval(context).inspector()

    def remember(self, context: Context) -> None:
        if not self._same:
            self._same.append(copy(self._inspector(self._scene_graph.GetMyContextFromRoot(context)).geometry_version()))

    def check(self, context: Context) -> None:
        inspector = self._inspector(self._scene_graph.GetMyContextFromRoot(context))
        version = inspector.geometry_version()
        if any(all(version.IsSameAs(same, role) for role in _READERS) for same in self._same):
            return
        default = self._inspector(self._scene_graph.CreateDefaultContext())
        if difference := next(_differences(default, inspector), ""):
            raise SnapshotError(
                f"in this context {difference}, which no snapshot holds: make it a field of the scenario, or change "
                "what is a variable, such as the friction"
            )
        self._same.append(copy(version))  # Drake's own changes with the context.


def _differences(default: SceneGraphInspector, present: SceneGraphInspector) -> Iterator[str]:
    for role, read in _READERS.items():
        name = role.name[1:].lower()
        before, after = _looks(default, role, read), _looks(present, role, read)
        if before.keys() != after.keys():
            yield f"{len(before.keys() ^ after.keys())} geometries have got or lost their {name} role"
            continue
        for geometry, (shape, properties) in after.items():
            if shape != before[geometry][0]:
                yield f"{present.GetName(geometry)} has another shape, {shape}"
            if properties != before[geometry][1]:
                yield f"{present.GetName(geometry)} has other {name} properties"
    if default.GetCollisionCandidates() != present.GetCollisionCandidates():
        yield "collision filters have been changed"


def _looks(
    inspector: SceneGraphInspector, role: Role, read: Callable[[SceneGraphInspector, GeometryId], Any]
) -> _Looks:
    return {
        geometry: (repr(inspector.GetShape(geometry)), dict(_properties(read(inspector, geometry))))
        for geometry in inspector.GetAllGeometryIds(role)
    }


def _properties(properties: Any) -> Iterator[tuple[tuple[str, str], Any]]:
    for group in properties.GetGroupNames():
        for name, wrapped in properties.GetPropertiesInGroup(group).items():
            try:
                value = wrapped.get_value()
            except (AttributeError, RuntimeError):  # of a C++ type without bindings
                value = None
            if (group, name) != FRICTION:
                yield (group, name), value.tolist() if isinstance(value, np.ndarray) else value
