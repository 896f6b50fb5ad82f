"""All variables of a Diagram, gathered from its systems."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from pydrake.systems.framework import Diagram

from vtbdrake.state.kinds import is_plant, is_scene_graph
from vtbdrake.state.systems import leaf_variables, leaves
from vtbdrake.state.variable import Variable
from vtbdrake.state.variables import Variables

if TYPE_CHECKING:
    from vtbdrake.state.multibody import Prefix


def collect(
    diagram: Diagram,
    *,
    plant_prefix: Callable[[str, str], str] | None = None,
    skip: Callable[[str], bool] = lambda path: False,
    extra: Iterable[Variable] = (),
) -> Variables:
    """The variables of every system of ``diagram``.

    Args:
        plant_prefix: (path of a plant, name of a model instance) -> prefix of the addresses of what belongs to
            that instance. By default the path of the plant.
        skip: says of the path of a leaf system whether its variables are left out.
        extra: further variables of the diagram.
    """
    plant_prefix = plant_prefix or (lambda path, instance: path)
    systems = [(path, system) for path, system in leaves(diagram) if not skip(path)]
    scene_graphs = [system for _, system in systems if is_scene_graph(system)]
    listed: list[Variable] = list(extra)
    by_demand: dict[str, Callable[[], Variable]] = {}
    for path, system in systems:
        if is_plant(system):
            # They need the modules that such a system has brought with it.
            from vtbdrake.state.friction import friction_variables
            from vtbdrake.state.multibody import multibody_variables, pose_entries_by_demand

            prefix = _prefix_of(plant_prefix, path)
            listed.extend(multibody_variables(system, prefix=prefix))
            source = system.get_source_id()
            for scene_graph in scene_graphs:
                if source is not None and scene_graph.model_inspector().SourceIsRegistered(source):
                    listed.extend(friction_variables(system, scene_graph, prefix=prefix))
            by_demand |= pose_entries_by_demand(system, prefix=prefix)
        elif not is_scene_graph(system):
            listed.extend(leaf_variables(path, system))
    return Variables(listed, derived_by_demand=by_demand)


def _prefix_of(plant_prefix: Callable[[str, str], str], path: str) -> Prefix:
    return lambda instance: plant_prefix(path, instance)
