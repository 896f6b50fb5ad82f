"""The robot in a URDF, SDF or MJCF file: which joints it drives, within which limits, and what its file leaves out."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import PackageMap
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from vtbdrake.common.failures import one_line
from vtbdrake.components.compiled_plant import PlantDynamics, UnsupportedPlantError
from vtbdrake.components.standing import Stance, WholeBodyModel
from vtbdrake.project.drives import choose_drives, falling_base, measured_joints, stuck_joints
from vtbdrake.project.limits import read_limits
from vtbdrake.project.parser import ModelParser
from vtbdrake.project.postures import let_drives_carry, move_away
from vtbdrake.project.robot import ProjectRobot, RobotFileError
from vtbdrake.project.rotors import FlyingRobot, flying_robot
from vtbdrake.project.stance import StanceError, StanceFinder, StandingRobot, named_postures, with_shift

SUFFIXES = (".urdf", ".sdf", ".xml")

# A robot that reaches less of a shift of its weight does not stand well, as a share of the shift.
_LEAST_REACHED = 0.1


def resolve(text: str) -> Path:
    """Return the path of a model file that is given by its path or as ``package://...``.

    Raises:
        RobotFileError: There is no such file, or its name has a suffix that is not in `SUFFIXES`.
    """
    path = Path(text)
    if "://" in text:
        try:
            path = Path(PackageMap().ResolveUrl(text))
        except RuntimeError as error:
            raise RobotFileError(
                f"{text} is not on this computer: {one_line(error)}. Drake's wheel brings few models, and downloads "
                "package://drake_models when it is used; give a file of your own"
            ) from error
    if not path.is_file():
        raise RobotFileError(f"there is no file {path}: give the path of a URDF, SDF or MJCF file")
    if path.suffix.lower() not in SUFFIXES:
        raise RobotFileError(
            f"{path} is not named like a URDF (.urdf), SDF (.sdf) or MJCF (.xml) file; convert it first (a .xacro by "
            "xacro FILE > robot.urdf)"
        )
    return path.resolve()


def read_robot(path: Path, packages: Mapping[str, Path] = MappingProxyType({})) -> ProjectRobot:
    """Return the robot in a model file.

    Meshes that Drake does not read are converted, and spellings that it refuses, and other programs take, are mended
    in the copy that the project gets; each change is in the notes.

    Args:
        path: A path of `resolve`.
        packages: The folders of packages by name, which are not searched for (see `find_packages`).

    Raises:
        RobotFileError: Drake cannot read it, it has no joints to drive, or joints or links of unsupported kinds.
    """
    with tempfile.TemporaryDirectory(prefix="vtbdrake-model-") as folder:
        return _RobotReader(path, packages, Path(folder)).robot()


class _RobotReader:
    """Finds out, step by step, what a project needs of the robot in a model file."""

    def __init__(self, path: Path, packages: Mapping[str, Path], folder: Path, *, stuck: tuple[str, ...] = ()) -> None:
        self._arguments, self._stuck = (path, packages, folder), stuck
        self._parser = ModelParser(path, packages, folder)
        if stuck:
            self._parser.notes.append(
                f"{self._parser.place(stuck[0])}: the damping of {', '.join(stuck)} holds them against drives that "
                "could carry the robot: they are fixed at zero (hold_joint in robot.py)"
            )

    def robot(self) -> ProjectRobot:
        parser = self._parser
        robot = ProjectRobot(parser.copy.model, parser.copy.files, packages=parser.copy.packages)
        robot.assumptions = list(parser.copy.assumptions)
        plant = parser.load()[0]
        parser.finalize(plant)
        if (flying := self._flying()) is not None:
            robot.flying = flying
            robot.assumptions += [f"{parser.shown} {assumption}" for assumption in flying.assumptions]
            robot.notes = [*parser.notes, *parser.warnings()]
            return robot
        joints = measured_joints(parser, plant)
        robot.held = (*falling_base(parser, plant, joints), *self._stuck)
        joints = [joint for joint in joints if joint.name() not in robot.held]
        robot.welded = self._free_bodies(plant)
        choose_drives(parser, plant, joints, robot)
        plant, scene_graph, diagram = self._as_in_project(robot)
        notes_on_homes = read_limits(parser, plant, joints, robot)
        if stuck := stuck_joints(robot):
            return _RobotReader(*self._arguments, stuck=(*self._stuck, *stuck)).robot()
        self._find_legs(robot)
        if robot.standing is None:
            let_drives_carry(parser, plant, robot)
        else:
            notes_on_homes = []
        if robot.has_constraints and plant.num_constraints() > len(robot.couplings):
            robot.motions = self._motions(robot)
        move_away(parser, plant, scene_graph, diagram, robot)
        robot.notes = [*parser.notes, *notes_on_homes, *parser.warnings()]
        return robot

    def _free_bodies(self, plant: MultibodyPlant) -> dict[str, RigidTransform]:
        free = [plant.get_body(index) for index in sorted(plant.GetFloatingBaseBodies())]
        return {body.name(): plant.GetDefaultFloatingBaseBodyPose(body) for body in free}

    def _flying(self) -> FlyingRobot | None:
        plant, scene_graph, builder = self._parser.load()
        self._parser.finalize(plant)
        root = builder.Build().CreateDefaultContext()
        context = plant.GetMyMutableContextFromRoot(root)
        return flying_robot(self._parser.path, self._parser.text, plant, scene_graph.model_inspector(), context)

    def _find_legs(self, robot: ProjectRobot) -> None:
        """Let a robot with legs stand on them; what moves freely otherwise is welded to the world, with a note."""
        reason = ", because it has neither legs below a trunk nor rotors"
        for base in tuple(robot.welded):
            X_WB = robot.welded.pop(base)
            try:
                robot.standing = self._standing(base, robot)
            except StanceError as error:
                reason = f", because it cannot stand on its legs: {error}"
            if robot.standing is not None:
                homes = robot.standing.posture
                robot.joints = tuple(replace(joint, home=homes[joint.name]) for joint in robot.joints)
                source = robot.standing.source or "a posture that was searched for"
                self._parser.notes.append(
                    f"{self._parser.place(base)}: {base} moves freely; the robot stands in {source}"
                )
                break
            robot.welded[base] = X_WB
        if robot.welded:
            self._parser.notes.append(
                f"{self._parser.place(next(iter(robot.welded)))}: {', '.join(robot.welded)} can move freely in the "
                f"file: welded to the world (WeldFrames in robot.py){reason}"
            )

    def _standing(self, base: str, robot: ProjectRobot) -> StandingRobot | None:
        """Return the stance of a robot whose base is free, or None if it has no legs."""
        plant, scene_graph, builder = self._parser.load()
        robot.change(plant)
        self._parser.finalize(plant)
        diagram = builder.Build()
        context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
        base_body, inspector = plant.GetBodyByName(base), scene_graph.model_inspector()
        postures = list(named_postures(self._parser.path, self._parser.text))

        def stance(*, soles: bool) -> StandingRobot | None:
            finder = StanceFinder(plant, context, inspector, base=base_body, joints=robot.joints, soles=soles)
            return finder.stance(postures)

        standing = stance(soles=True)
        if standing is None:
            return None
        if robot.has_constraints and plant.num_constraints() > len(robot.couplings):
            raise StanceError("constraints close loops between its links, which the controller does not know")
        names = [joint.name for joint in robot.joints]
        limit = np.array([robot.joints[names.index(driven)].effort for driven in robot.driven])

        def make_plant() -> MultibodyPlant:
            model = self._parser.load()[0]
            robot.change(model)
            for constraint in model.GetConstraintIds():
                model.RemoveConstraint(constraint)
            model.Finalize()
            return model

        def model(stance: Stance) -> WholeBodyModel:
            return WholeBodyModel(make_plant, stance, motions=robot.selection(), limit=limit)

        standing = with_shift(standing, model, names)
        if standing.reached < _LEAST_REACHED and (on_points := stance(soles=False)) is not None:
            # Legs of three joints cannot keep a sole level: their feet are balls, drawn by meshes.
            standing = with_shift(on_points, model, names)
        if standing.reached < _LEAST_REACHED:
            raise StanceError("it cannot shift its weight within the limits of its drives and joints")
        return standing

    def _as_in_project(self, robot: ProjectRobot) -> tuple[MultibodyPlant, SceneGraph, Diagram]:
        """Return the plant of the project's world: as the file has it, with the changes that ``robot`` lists."""
        plant, scene_graph, builder = self._parser.load()
        robot.change(plant)
        robot.add_drives(plant)
        drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        robot.driven = tuple(drive.joint().name() for drive in drives)
        robot.has_constraints = plant.num_constraints() > 0
        self._parser.finalize(plant)
        self._check_model(robot)
        return plant, scene_graph, builder.Build()

    def _check_model(self, robot: ProjectRobot) -> None:
        """Check that the controller can compute with the model, without the constraints."""
        plant = self._parser.load()[0]
        robot.change(plant)
        for constraint in plant.GetConstraintIds():
            plant.RemoveConstraint(constraint)
        self._parser.finalize(plant)
        context = plant.CreateDefaultContext()
        try:
            PlantDynamics(plant, context)
        except UnsupportedPlantError as error:
            raise RobotFileError(
                f"{self._parser.shown}: the controller needs a model of the robot, but {error}"
            ) from error

    def _motions(self, robot: ProjectRobot) -> NDArray[np.float64]:
        """Return the velocities at home that a small torque of each drive causes, by the driven joints' velocities.

        Drake's solver keeps the constraints, without gravity and contact.
        """
        plant = MultibodyPlant(0.001)
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self._parser.parse(plant)
        robot.change(plant)
        robot.add_drives(plant)
        self._parser.finalize(plant)
        index_of = {joint.name: k for k, joint in enumerate(robot.joints)}
        velocities = []
        for k in range(len(robot.driven)):
            context = plant.CreateDefaultContext()
            plant.SetPositions(context, [joint.home for joint in robot.joints])
            effort = np.zeros(len(robot.driven))
            effort[k] = 1e-3 * robot.joints[index_of[robot.driven[k]]].effort
            plant.get_actuation_input_port().FixValue(context, effort)
            simulator = Simulator(plant, context)
            simulator.AdvanceTo(plant.time_step())
            velocities.append(plant.GetVelocities(context))
        V = np.transpose(velocities)
        motions: NDArray[np.float64] = V @ np.linalg.inv(V[[index_of[name] for name in robot.driven]])
        self._parser.notes.append(
            f"{self._parser.shown} closes loops by constraints: the controller takes their motion at home (B in "
            "robot.py), and may be less accurate far from it"
        )
        return motions
