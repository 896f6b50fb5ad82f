"""Which of Drake's heavy classes a system is of, asked without importing them.

Geometry, plants and cameras cost a process some thirty megabytes; a DPS on a robot does without. Who has not imported
the module of a class has no object of it.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, TypeGuard

from pydrake.systems.framework import System

if TYPE_CHECKING:
    from pydrake.geometry import SceneGraph
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.systems.sensors import RgbdSensor


def is_plant(system: System) -> TypeGuard[MultibodyPlant]:
    """Whether a system is a MultibodyPlant."""
    return _is_a(system, "pydrake.multibody.plant", "MultibodyPlant")


def is_scene_graph(system: System) -> TypeGuard[SceneGraph]:
    """Whether a system is a SceneGraph."""
    return _is_a(system, "pydrake.geometry", "SceneGraph")


def is_camera(system: System) -> TypeGuard[RgbdSensor]:
    """Whether a system is an RgbdSensor."""
    return _is_a(system, "pydrake.systems.sensors", "RgbdSensor")


def _is_a(system: System, module: str, name: str) -> bool:
    found: Any = sys.modules.get(module)
    return found is not None and isinstance(system, getattr(found, name))
