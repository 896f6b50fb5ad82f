"""The systems of a Diagram: their paths, their numeric groups and their variables."""

from __future__ import annotations

import itertools
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import Context, Diagram, OutputPort, System
from pydrake.systems.primitives import ConstantVectorSource

from vtbdrake.state.declarations import CONTINUOUS, DISCRETE, PARAMETER, Element
from vtbdrake.state.variables import A, Place, Variable, Variables, X

if TYPE_CHECKING:
    from pydrake.geometry import SceneGraph
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.systems.scalar_conversion import TemplateSystem
    from pydrake.systems.sensors import RgbdSensor

    from vtbdrake.state.multibody import Prefix

POSE_UNIT = "m, rad"
POSE_NAMES = ("x", "y", "z", "roll", "pitch", "yaw")  # names of the entries of `pose_to_array`
LEAST_TURN = 1e-150
"""The least angle of a turn that has an axis, in rad."""

# How groups are called in the addresses of systems that name no variables.
_GROUP_NAMES = {DISCRETE: "discrete_state", PARAMETER: "parameter"}
# Drake names a system without a name by its class and its address in memory.
UNNAMED = re.compile(r"@[0-9a-f]{8,16}$")


def class_for_float(template: TemplateSystem) -> Any:
    """Return the class that a template of systems has for float, and make it.

    Drake looks for the module of each class in the stack of all callers, whose sources it reads: a tenth of a second
    within an import. From a thread of its own, the stack is short.
    """
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(template.__getitem__, float).result()


def leaves(diagram: Diagram, *, path: str = "") -> Iterator[tuple[str, System]]:
    """Yield all leaf systems below ``diagram``, of any scalar, with their dotted paths, in the Diagram's order.

    Args:
        diagram: The Diagram, of any scalar.
        path: Dotted path of ``diagram``, which begins every path; empty by default, for a root.
    """
    for system in diagram.GetSystems():
        below = f"{path}.{system.get_name()}" if path else system.get_name()
        if hasattr(system, "GetSystems"):
            yield from leaves(system, path=below)
        else:
            yield below, system


def output_ports(system: System, *, path: str = "") -> dict[str, tuple[System, OutputPort]]:
    """Return the output ports of a system and of all systems below it, with their systems, by dotted address.

    Args:
        system: A leaf system or a Diagram.
        path: Dotted path of ``system``, which begins every address; empty by default, for a root.
    """
    prefix = f"{path}." if path else ""
    ports = {}
    for i in range(system.num_output_ports()):
        port = system.get_output_port(i)
        ports[f"{prefix}{port.get_name()}"] = system, port
    for below in system.GetSystems() if isinstance(system, Diagram) else ():
        ports |= output_ports(below, path=f"{prefix}{below.get_name()}")
    return ports


class Group(NamedTuple):
    """A numeric group of a leaf system.

    Attributes:
        kind: ``continuous``, ``discrete`` or ``parameter``.
        number: Its number among the groups of its kind.
        size: The number of its entries.
    """

    kind: str
    number: int
    size: int


class Leaf(NamedTuple):
    """A leaf system, with all numeric groups of its context.

    Attributes:
        path: The path of the system.
        system: The system.
        groups: Its numeric groups.
    """

    path: str
    system: System
    groups: tuple[Group, ...]

    @property
    def holds_ids(self) -> bool:
        """Return whether this is a SceneGraph or a camera: their contexts hold ids that differ from build to build."""
        return is_scene_graph(self.system) or is_camera(self.system)


def stateful_leaves(
    diagram: Diagram, context: Context | None = None, *, only: Callable[[str], bool] = lambda path: True
) -> Iterator[Leaf]:
    """Yield the leaf systems below ``diagram`` with their numeric groups, as snapshots, layouts and copies need them.

    Args:
        diagram: The Diagram.
        context: A root context, in which the groups are counted; by default in the default context of each system.
        only: Predicate of a path that selects the systems.
    """
    for path, system in leaves(diagram):
        if only(path):
            leaf = Leaf(path, system, ())
            # A context of a large scene takes long to make, and has no numeric group.
            if not leaf.holds_ids:
                made = system.CreateDefaultContext() if context is None else system.GetMyContextFromRoot(context)
                leaf = leaf._replace(groups=tuple(_numeric_groups(made)))
            yield leaf


def _numeric_groups(context: Context) -> Iterator[Group]:
    if size := context.num_continuous_states():
        yield Group(CONTINUOUS, 0, size)
    for index in range(context.num_discrete_state_groups()):
        yield Group(DISCRETE, index, context.get_discrete_state(index).size())
    for index in range(context.num_numeric_parameter_groups()):
        yield Group(PARAMETER, index, context.get_numeric_parameter(index).size())


def class_name(system: System) -> str:
    """Return the name of a system's class, without modules, namespaces and scalar types: ``ZeroOrderHold``."""
    bare = re.sub(r"<.*>|\[.*\]", "", system.GetSystemType())
    return re.split(r"::|\.", bare)[-1].rstrip("_")


def name_systems(diagram: Diagram) -> None:
    """Name every system below ``diagram`` that has no name by its class: ``ZeroOrderHold``, ``ZeroOrderHold_2``, ...

    The systems of one class are counted in the Diagram's order, so that two builds of one scenario get the same names.
    Drake itself names them by their addresses in memory.
    """
    systems = diagram.GetSystems()
    taken = {system.get_name() for system in systems if not UNNAMED.search(system.get_name())}
    for system in systems:
        if UNNAMED.search(system.get_name()):
            names = (class_name(system) + (f"_{count}" if count > 1 else "") for count in itertools.count(1))
            system.set_name(next(name for name in names if name not in taken))
            taken.add(system.get_name())
        if hasattr(system, "GetSystems"):
            name_systems(system)


def pose_to_array(X_PF: RigidTransform) -> np.ndarray:
    """Return ``[x, y, z, roll, pitch, yaw]``, in metres and radians, as in SDFormat's ``<pose>``."""
    return np.concatenate([X_PF.translation(), RollPitchYaw(X_PF.rotation()).vector()])


def pose_from_array(value: np.ndarray) -> RigidTransform:
    """Return the pose ``[x, y, z, roll, pitch, yaw]``, in metres and radians."""
    return RigidTransform(RollPitchYaw(value[3:]), value[:3])


def pose_later(pose: np.ndarray, velocity: np.ndarray, dt: float) -> np.ndarray:
    """Return the pose of a body after ``dt`` seconds of constant spatial velocity.

    Args:
        pose: Pose X_WB of the body, [x, y, z, roll, pitch, yaw] in m and rad, shape (6,).
        velocity: Spatial velocity V_WB of the body, [angular in rad/s, of Bo in m/s], shape (6,).
        dt: Time in seconds; negative for an earlier pose.
    """
    X_WB, turn = pose_from_array(pose), dt * np.asarray(velocity[:3])
    angle = float(np.linalg.norm(turn))
    # The norm of a smaller one is not exact, and its axis no unit vector.
    R = RotationMatrix(AngleAxis(angle, turn / angle)) if angle > LEAST_TURN else RotationMatrix()
    return pose_to_array(RigidTransform(R @ X_WB.rotation(), X_WB.translation() + dt * np.asarray(velocity[3:])))


def leaf_variables(path: str, system: System, *, declared: Iterable[Element] | None = None) -> Iterator[Variable]:
    """Yield the variables of a leaf system that is neither a plant nor a SceneGraph.

    ``declared`` names the elements of a system of Drake's, which has no declaration of its own.

    Args:
        path: Dotted path of the system, which begins every address.
        system: The leaf system.
        declared: The named elements of the system; by default its own declaration, or its whole groups if it has none.
    """
    if is_camera(system):
        yield from _camera_pose(path, system)
    declared = getattr(system, "variables", None) if declared is None else tuple(declared)
    if declared is not None and not declared:
        return
    groups = tuple(_numeric_groups(system.CreateDefaultContext()))
    sizes = {(group.kind, group.number): group.size for group in groups}
    elements = tuple(_unnamed_elements(system, groups) if declared is None else declared)
    names = Counter((element.group, element.index) for element in elements)
    for element in elements:
        address = f"{path}.{element.name}" if element.name else path
        group = element.group, element.index
        yield _numeric(address, system, element, alone=names[group] == 1, available=sizes.get(group, 0))


def _unnamed_elements(system: System, groups: Iterable[Group]) -> Iterator[Element]:
    """Yield the whole groups of a system that declares no variables."""
    for kind, index, size in groups:
        # The parameter of a constant source is its output value.
        is_value = kind == PARAMETER and isinstance(system, ConstantVectorSource)
        name = "continuous_state" if kind == CONTINUOUS else f"{_GROUP_NAMES[kind]}_{index}"
        yield Element("value" if is_value else name, kind, index, (size,))


def read_group(context: Context, group: str, index: int) -> np.ndarray:
    """Return a copy of a numeric group of a leaf context, of any scalar.

    Args:
        context: The context of a leaf system.
        group: Kind of the group: `CONTINUOUS`, `DISCRETE` or `PARAMETER`.
        index: Number of the group among the system's groups of this kind; the continuous state ignores it.
    """
    if group == CONTINUOUS:
        vector = context.get_continuous_state_vector()
    else:
        vector = context.get_discrete_state(index) if group == DISCRETE else context.get_numeric_parameter(index)
    return vector.CopyToVector()


def write_group(context: Context, group: str, index: int, value: np.ndarray) -> None:
    """Set a whole numeric group of a leaf context.

    Args:
        context: The context of a leaf system, which is changed.
        group: Kind of the group: `CONTINUOUS`, `DISCRETE` or `PARAMETER`.
        index: Number of the group among the system's groups of this kind; the continuous state ignores it.
        value: All numbers of the group, shape (n,).
    """
    if group == CONTINUOUS:
        context.SetContinuousState(value)
    elif group == DISCRETE:
        context.SetDiscreteState(index, value)
    else:
        context.get_mutable_numeric_parameter(index).SetFromVector(value)


def _numeric(address: str, system: System, element: Element, *, alone: bool, available: int) -> Variable:
    """Return the variable of an element, which is ``alone`` or not in its group of ``available`` entries."""
    size = int(np.prod(element.shape, dtype=int))
    if element.start + size > available:
        raise ValueError(
            f"{address} is declared as entries {element.start} to {element.start + size - 1} of {element.group} "
            f"group {element.index} of {system.get_name()}, which has {available} entries"
        )
    if alone and element.shape == () and element.start == 0 and available > 1:
        raise ValueError(
            f"{address} is declared as one number, but {element.group} group {element.index} of {system.get_name()} "
            f"has {available} entries, and no other name: give shape=({available},), or name the others, too"
        )
    entries = slice(element.start, element.start + size)
    whole = size == available

    def read(root: Context) -> np.ndarray:
        value = read_group(system.GetMyContextFromRoot(root), element.group, element.index)
        return value[entries].reshape(element.shape)

    def write(root: Context, value: np.ndarray) -> None:
        context = system.GetMyMutableContextFromRoot(root)
        group = np.empty(size) if whole else read_group(context, element.group, element.index)
        group[entries] = value.ravel()
        write_group(context, element.group, element.index, group)

    kind = A if element.group == PARAMETER else X
    names = getattr(system, "entry_names", ())
    return Variable(
        address,
        kind,
        element.shape,
        element.unit,
        read,
        write,
        bounds=element.bounds,
        place=Place(system, element.group, element.index, element.start),
        entry_names=names if element.shape == (len(names),) else (),
    )


def _camera_pose(path: str, camera: RgbdSensor) -> Iterator[Variable]:
    """Yield ``pose`` for the user, and the matrix that carries it: angles would not come back to the last bit."""
    matrix = f"{path}.pose_matrix"

    def read_matrix(root: Context) -> np.ndarray:
        return camera.GetX_PB(camera.GetMyContextFromRoot(root)).GetAsMatrix34()

    def write_matrix(root: Context, value: np.ndarray) -> None:
        pose = RigidTransform(RotationMatrix(value[:, :3]), value[:, 3])
        camera.SetX_PB(camera.GetMyMutableContextFromRoot(root), pose)

    def read(root: Context) -> np.ndarray:
        return pose_to_array(camera.GetX_PB(camera.GetMyContextFromRoot(root)))

    def write(root: Context, value: np.ndarray) -> None:
        camera.SetX_PB(camera.GetMyMutableContextFromRoot(root), pose_from_array(value))

    yield Variable(f"{path}.pose", A, (6,), POSE_UNIT, read, write, carried_by=matrix, entry_names=POSE_NAMES)
    yield Variable(matrix, A, (3, 4), "1, 1, 1, m", read_matrix, write_matrix, carried_by=matrix)


def is_python(system: System) -> bool:
    """Return whether a system is written in Python, so that it holds the interpreter lock while it computes."""
    return not type(system).__module__.startswith("pydrake")


def is_plant(system: System) -> TypeGuard[MultibodyPlant]:
    """Return whether a system is a MultibodyPlant."""
    return _is_a(system, "pydrake.multibody.plant", "MultibodyPlant")


def is_scene_graph(system: System) -> TypeGuard[SceneGraph]:
    """Return whether a system is a SceneGraph."""
    return _is_a(system, "pydrake.geometry", "SceneGraph")


def is_camera(system: System) -> TypeGuard[RgbdSensor]:
    """Return whether a system is an RgbdSensor."""
    return _is_a(system, "pydrake.systems.sensors", "RgbdSensor")


def _is_a(system: System, module: str, name: str) -> bool:
    loaded: Any = sys.modules.get(module)
    return loaded is not None and isinstance(system, getattr(loaded, name))


def collect(
    diagram: Diagram,
    *,
    plant_prefix: Callable[[str, str], str] | None = None,
    skip: Callable[[str], bool] = lambda path: False,
    extra: Iterable[Variable] = (),
    by_demand: Mapping[str, Callable[[], Variable]] | None = None,
) -> Variables:
    """Return the variables of every system of ``diagram``.

    Args:
        diagram: The Diagram to search.
        plant_prefix: Function of (path of a plant, name of a model instance) that returns the prefix of the addresses
            of that instance. By default the path of the plant.
        skip: Predicate of a path that selects the leaf systems to leave out.
        extra: Further variables of the diagram.
        by_demand: Functions that make further variables, which are not listed, by address.

    Raises:
        ValueError: The system is no Diagram.
    """
    if not hasattr(diagram, "GetSystems"):
        raise ValueError(f"collect takes a Diagram; {class_name(diagram)} is one system: build a Diagram that has it")
    plant_prefix = plant_prefix or (lambda path, instance: path)
    systems = [(path, system) for path, system in leaves(diagram) if not skip(path)]
    scene_graphs = [system for _, system in systems if is_scene_graph(system)]
    listed: list[Variable] = list(extra)
    unlisted = dict(by_demand or {})
    for path, system in systems:
        if is_plant(system):
            # Imported here: heavy, and already imported where there is a plant.
            from vtbdrake.state.multibody import friction_variables, multibody_variables, pose_entries_by_demand

            prefix = _prefix_of(plant_prefix, path)
            listed.extend(multibody_variables(system, prefix=prefix))
            source = system.get_source_id()
            for scene_graph in scene_graphs:
                if source is not None and scene_graph.model_inspector().SourceIsRegistered(source):
                    listed.extend(friction_variables(system, scene_graph, prefix=prefix))
            unlisted |= pose_entries_by_demand(system, prefix=prefix)
        elif not is_scene_graph(system):
            listed.extend(leaf_variables(path, system))
    return Variables(listed, by_demand=unlisted)


def _prefix_of(plant_prefix: Callable[[str, str], str], path: str) -> Prefix:
    return lambda instance: plant_prefix(path, instance)
