"""A scenario that shows a model file: its joints are commands, so that a page has a slider for each."""

from __future__ import annotations

import os
import re
import tempfile
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import PackageMap
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint
from pydrake.systems.framework import Context, LeafSystem, System
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from vtbdrake.common.failures import one_line
from vtbdrake.project.model_copy import copy_model
from vtbdrake.project.parser import add_model
from vtbdrake.project.robot import PRISMATIC, RobotFileError
from vtbdrake.project.robot_file import SUFFIXES, resolve
from vtbdrake.station import Station
from vtbdrake.testbed import Interface, Scenario, Signal, VirtualTestbedBuilder

DIRECTIVES = (".dmd.yaml", ".dmd.yml")

# The range of the slider of a joint whose file gives none, in m and rad.
_UNKNOWN_REACH = {PRISMATIC: 1.0}
_UNKNOWN_TURN = np.pi


@dataclass
class ModelFileScenario(Scenario):
    """A model file as it is: a command ``u.<joint>`` moves each of its joints, without dynamics.

    Attributes:
        file: A URDF, SDF or MJCF file, model directives of Drake (.dmd.yaml), or the models of a station, as
            ``FILE.yaml`` or ``FILE.yaml#KEY``.
        packages: Folders of packages, by name.
    """

    file: str = ""
    packages: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, text: str) -> ModelFileScenario:
        """Return the scenario of a file; a model may be given as ``package://...``, too.

        Raises:
            RobotFileError: There is no such file.
        """
        if not text.lower().endswith(SUFFIXES):
            return cls(file=text)
        path = resolve(text)
        return cls(file=min(str(path), os.path.relpath(path), key=len))

    def interface(self) -> Interface:
        plant = _plant(self.file, tuple(self.packages.items()))
        return Interface(
            sense=[],
            act=[
                Signal(
                    "positions",
                    plant.num_positions(),
                    unit="m, rad",
                    lower=-np.inf,
                    upper=np.inf,
                    idle=0.0,
                    entry_names=plant.GetPositionNames(),
                )
            ],
            commands=[
                Signal(name, 1, unit=_unit(joint), lower=lower, upper=upper, default=default)
                for name, (joint, lower, upper, default) in _sliders(plant).items()
            ],
        )

    def make_dps(self) -> System:
        return _Posture(_plant(self.file, tuple(self.packages.items())))

    def add_world(self, builder: VirtualTestbedBuilder) -> None:
        # The plant only computes the poses of the geometries: it is no part of the Diagram.
        scene_graph = builder.diagram_builder.AddNamedSystem("scene_graph", SceneGraph())
        plant = MultibodyPlant(0.0)
        plant.RegisterAsSourceForSceneGraph(scene_graph)
        _add_models(plant, self.file, tuple(self.packages.items()))
        source = plant.get_source_id()
        poses = builder.add("sys", "poses", MultibodyPositionToGeometryPose(plant))
        builder.connect(poses.get_output_port(), scene_graph.get_source_pose_port(source))
        builder.scene_graph = scene_graph
        builder.sim_actuator("positions", poses.get_input_port())


class _Posture(LeafSystem):
    """The positions of a plant, in which inputs move some joints.

    .. pydrake_system::

        name: _Posture
        input_ports:
        - one for each joint that is moved, size 1
        output_ports:
        - positions
    """

    __slots__ = ("_default", "_starts")

    def __init__(self, plant: MultibodyPlant) -> None:
        super().__init__()
        self._default = plant.GetDefaultPositions()
        self._starts = []
        for name, (joint, *_) in _sliders(plant).items():
            self.DeclareVectorInputPort(name, 1)
            self._starts.append(int(joint.position_start()))
        self.DeclareVectorOutputPort("positions", len(self._default), self._calc_positions)

    def _calc_positions(self, context: Context, output: Value) -> None:
        positions = self._default.copy()
        for index, start in enumerate(self._starts):
            positions[start] = self.get_input_port(index).Eval(context)[0]
        output.SetFromVector(positions)


def _add_models(plant: MultibodyPlant, file: str, packages: tuple[tuple[str, str], ...]) -> None:
    """Add what a file describes to a plant, and finalize it."""
    if not file.lower().endswith((*SUFFIXES, *DIRECTIVES)):
        station = Station(file)
        station.packages = {**station.packages, **dict(packages)}
        station.add_models_to(plant)
        return
    model, folders = _readable(file, packages)
    try:
        add_model(plant, model, folders)
        plant.Finalize()
    except (RuntimeError, SystemExit) as error:
        message = one_line(error).replace(str(model), file).replace("/" + file, file)
        raise RobotFileError(f"{file} cannot be shown: {message}") from error


@cache
def _plant(file: str, packages: tuple[tuple[str, str], ...]) -> MultibodyPlant:
    plant = MultibodyPlant(0.0)
    _add_models(plant, file, packages)
    return plant


# The folders of copies that are shown, until the process ends: meshes are read when they are drawn.
_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []


@cache
def _readable(file: str, packages: tuple[tuple[str, str], ...]) -> tuple[Path, dict[str, Path]]:
    """Return a file that Drake reads, and the folders of its packages: the file itself, or a copy of a model."""
    named = {name: Path(folder) for name, folder in packages}
    path = Path(file)
    if path.name.lower().endswith(DIRECTIVES):
        around = PackageMap.MakeEmpty()
        for folder in path.resolve().parents:
            if (folder / "package.xml").is_file():
                around.AddPackageXml(str(folder / "package.xml"))
                break
        return path, {name: Path(around.GetPath(name)) for name in around.GetPackageNames()} | named
    copy = copy_model(path.resolve(), file, named)
    if copy.fault:
        raise RobotFileError(copy.fault)
    for name, remedy in copy.missing.items():
        raise RobotFileError(f"{file} refers to the package {name}: {remedy}")
    temporary = tempfile.TemporaryDirectory(prefix="vtbdrake-view-")
    _FOLDERS.append(temporary)
    root = Path(temporary.name)
    return copy.write(root), {name: root / folder for name, folder in copy.packages.items()}


def _sliders(plant: MultibodyPlant) -> dict[str, tuple[Joint, float, float, float]]:
    """Return the joints with one position by the names of their commands, with range and default position."""
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    moved = [joint for joint in joints if joint.num_positions() == 1]
    names = [joint.name() for joint in moved]
    defaults = plant.GetDefaultPositions()
    sliders = {}
    for joint in moved:
        name = joint.name()
        if names.count(name) > 1:
            name = f"{plant.GetModelInstanceName(joint.model_instance())}_{name}"
        name = re.sub(r"\W", "_", name, flags=re.ASCII)
        name = f"joint_{name}" if not name.isidentifier() or name in sliders else name
        lower, upper = float(joint.position_lower_limit()), float(joint.position_upper_limit())
        reach = _UNKNOWN_REACH.get(joint.type_name(), _UNKNOWN_TURN)
        lower, upper = (lower if np.isfinite(lower) else -reach), (upper if np.isfinite(upper) else reach)
        default = float(np.clip(defaults[int(joint.position_start())], lower, upper))
        sliders[name] = (joint, lower, upper, default)
    return sliders


def _unit(joint: Joint) -> str:
    return "m" if joint.type_name() == PRISMATIC else "rad"
