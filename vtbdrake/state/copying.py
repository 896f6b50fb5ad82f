"""Copies s(t) from context to context, within one Diagram or between two builds of one recipe."""

from __future__ import annotations

from collections.abc import Callable, Collection

import numpy as np
from pydrake.systems.framework import Context, Diagram, System

from vtbdrake.state.kinds import is_camera, is_scene_graph
from vtbdrake.state.systems import leaves
from vtbdrake.state.variables import Variables


class StateCopier:
    """Copies time, state and parameters leaf by leaf.

    SceneGraph and cameras are left out: they hold ids that differ from build to build, and copying them makes Drake
    compute anew what has not changed. What is hidden there is copied by address, and only where it differs.

    Args:
        source, target: the Diagrams; they may be the same one.
        source_variables, target_variables: theirs.
        only: says of the path of a system of the target whether it is copied; left out, all are.

    Raises:
        ValueError: the two are not built alike.
    """

    def __init__(
        self,
        source: Diagram,
        source_variables: Variables,
        target: Diagram,
        target_variables: Variables,
        *,
        only: Callable[[str], bool] = lambda path: True,
    ) -> None:
        from_paths, to_paths = dict(leaves(source)), dict(leaves(target))
        self._pairs = []
        for path, system in to_paths.items():
            if is_scene_graph(system) or is_camera(system) or _is_empty(system) or not only(path):
                continue
            if path not in from_paths:
                raise ValueError(f"the testbed to copy from has no system {path}")
            self._pairs.append((from_paths[path], system))
        self._hidden = [
            (source_variables[v.address], v)
            for v in target_variables.values()
            if v.hidden and not v.derived and v.address in source_variables
        ]

    def copy(self, source: Context, target: Context, *, hidden: Collection[str] | None = None) -> None:
        """Makes ``target`` continue as ``source`` would.

        ``hidden`` names the hidden variables that can differ; left out, all are compared.
        """
        target.SetTime(source.get_time())
        for from_system, to_system in self._pairs:
            to_system.GetMyMutableContextFromRoot(target).SetStateAndParametersFrom(
                from_system.GetMyContextFromRoot(source)
            )
        for from_variable, to_variable in self._hidden:
            if hidden is not None and to_variable.address not in hidden:
                continue
            value = np.asarray(from_variable.get(source))
            if not np.array_equal(to_variable.get(target), value):
                to_variable.set(target, value)


def _is_empty(system: System) -> bool:
    """True for a system that has neither state nor parameters."""
    context = system.CreateDefaultContext()
    return bool(
        context.num_continuous_states() == 0
        and context.num_discrete_state_groups() == 0
        and context.num_abstract_states() == 0
        and context.num_numeric_parameter_groups() == 0
        and context.num_abstract_parameters() == 0
    )
