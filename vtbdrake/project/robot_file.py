"""The robot in a URDF, SDF or MJCF file: which joints it drives, within which limits, and what its file leaves out."""

from __future__ import annotations

import logging
import math
import os
import re
import tempfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import Joint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from scipy.optimize import least_squares

from vtbdrake.common.failures import one_line
from vtbdrake.components.compiled_plant import PlantDynamics, UnsupportedPlantError
from vtbdrake.components.standing import Stance, WholeBodyModel
from vtbdrake.project.model_copy import MJCF, URDF, ModelCopy, copy_model
from vtbdrake.project.rotors import FlyingRobot, flying_robot
from vtbdrake.project.stance import StanceError, StanceFinder, StandingRobot, named_postures, with_shift
from vtbdrake.project.xml_text import XmlText

SUFFIXES = (".urdf", ".sdf", ".xml")

REVOLUTE = "revolute"
PRISMATIC = "prismatic"
# What is assumed where a file says nothing, by the kind of joint: in rad or m, and per second.
_ASSUMED_REACH = {REVOLUTE: 2.0 * math.pi, PRISMATIC: 1.0}
_ASSUMED_SPEED = {REVOLUTE: 3.0, PRISMATIC: 0.5}
# An assumed drive carries the weight multiplied by this number.
_WEIGHTS = 2.0
# Beside the weight, an assumed drive accelerates to its speed within this time, in s.
_TIME_TO_SPEED = 0.02
# The share of the effort of a drive that the weight takes at home, where the file's posture takes more than all of it.
_CARRIED = 0.8
# On the way to the other posture of examples, the weight takes at most this share, or as much as at home.
_HEAVIEST = 0.9
# A weight in N that a joint of the base does not carry, so that the base falls.
_FALLS = 1e-3
# A joint that is this close to its home in the file stays there, in rad or m.
_UNMOVED = 0.005
# The share of the effort of a drive that the damping of its joint takes at most, at the speed of the reference.
_DAMPED = 0.5
# The other posture of examples lies at most this far from home, and this share of the way to the farther end.
_STEP = {REVOLUTE: 0.4, PRISMATIC: 0.1}
_SHARE = 0.15

# A joint that would need more than this time to cross its range, for its damping, counts as fixed, in s.
_LONGEST_RANGE = 100.0
# At its speed, a joint reaches the other posture of examples within this time, in s.
_LONGEST_WAY = 5.0

# The other posture is moved closer to home, and to its other sides, until nothing touches on the way and the drives
# carry it.
_SHARES_OF_THE_WAY = (1.0, 0.5, 0.2)
# The sides of the joints that are tried at random, beside all and none.
_RANDOM_SIDES = 4
# The postures that are looked at on the way.
_POSTURES = 12
# Bodies also touch at home if they do where joints are moved at random by up to this much, in rad or m: gains are soft.
_AROUND_HOME = 0.02
# The postures around home that are looked at.
_NEIGHBOURS = 8

# A robot that reaches less of a shift of its weight does not stand well, as a share of the shift.
_LEAST_REACHED = 0.1

# The file and the line with which a message of Drake's parser begins.
_PLACE = re.compile(r"([^\s:]*:\d+): ")
_SEE_ALSO = " See https://drake.mit.edu/troubleshooting.html for additional resources."


class RobotFileError(ValueError):
    """A file describes no robot that a project can be made for; the message names file, line and remedy."""


@dataclass(frozen=True)
class RobotJoint:
    """A joint with one degree of freedom: rad or m, per second, N m or N.

    Attributes:
        name: The name of the joint.
        kind: REVOLUTE or PRISMATIC.
        lower, upper: The ends of its range.
        speed: The largest speed.
        effort: 0: it has no drive.
        home: The position at the start.
        assumed: The names of the values that are not in the file.
    """

    name: str
    kind: str
    lower: float
    upper: float
    speed: float
    effort: float
    home: float
    assumed: tuple[str, ...]


@dataclass(frozen=True)
class Coupling:
    """A joint that follows another one: its velocity is ``multiplier`` times the velocity of ``leader``.

    Attributes:
        joint: The joint that follows.
        leader: The joint that it follows.
        multiplier: The ratio of their velocities.
    """

    joint: str
    leader: str
    multiplier: float


@dataclass
class ProjectRobot:
    """A robot as a project needs it.

    Attributes:
        model: The path of its file among ``files``.
        files: The files that the model consists of: path in the project's folder ``models`` -> source, or content.
        joints: Its joints, in the order of the plant's positions.
        driven: The names of the joints with drives, in the order of the plant's actuators.
        away: Another posture of the driven joints, for examples.
        packages: The packages to which the model refers, by name: their folders in ``models``.
        welded: The bodies that are free in the file, and where they are welded to the world.
        held: The joints of a base that would fall, and joints that damping holds: they are held where they are.
        added_drives: The joints without an actuator that Drake reads, which get one.
        servos: The names of actuators of the file with position or velocity controllers, which are left out.
        without_drive: The names of actuators of the file that are left out, with their joints' drives.
        sets_efforts: Whether the effort limits of some actuators differ from the file's.
        has_constraints: Whether there are constraints between joints or bodies.
        couplings: The joints that follow driven ones.
        motions: Where other constraints close loops: the velocities of all joints by the driven joints' velocities, at
            home, shape (joints, driven); otherwise None.
        touching: The names of bodies that touch each other at home.
        standing: How it stands, if its base is free and has legs.
        flying: How it flies, if its base is free and has rotors; then it has no joints.
        assumptions: The limits that the file does not give, each with the values that are assumed instead.
        notes: What else is missing or unusual in the file, and what is done about it.
    """

    model: Path
    files: dict[Path, Path | bytes]
    joints: tuple[RobotJoint, ...] = ()
    driven: tuple[str, ...] = ()
    away: tuple[float, ...] = ()
    packages: dict[str, Path] = field(default_factory=dict)
    welded: dict[str, RigidTransform] = field(default_factory=dict)
    held: tuple[str, ...] = ()
    added_drives: tuple[str, ...] = ()
    servos: tuple[str, ...] = ()
    without_drive: tuple[str, ...] = ()
    sets_efforts: bool = False
    has_constraints: bool = False
    couplings: tuple[Coupling, ...] = ()
    motions: NDArray[np.float64] | None = None
    touching: tuple[str, ...] = ()
    standing: StandingRobot | None = None
    flying: FlyingRobot | None = None
    assumptions: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        if self.flying is not None:
            return f"{self.model.name}, which flies with {len(self.flying.rotors)} rotors"
        legs = f", which stands on {', '.join(self.standing.feet)}" if self.standing is not None else ""
        return f"{self.model.name}, {len(self.driven)} of its {len(self.joints)} joints driven{legs}"


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
        return _ModelReader(path, packages, Path(folder)).robot()


class _ModelReader:
    """Reads one model file, by the copy that a project gets."""

    def __init__(self, path: Path, packages: Mapping[str, Path], folder: Path, *, stuck: tuple[str, ...] = ()) -> None:
        self._path = path = path.resolve()
        self._packages, self._stuck = packages, stuck
        self._shown = min(str(path), os.path.relpath(path), key=len)
        self._text = path.read_text(encoding="utf-8", errors="replace")
        self._copy = copy_model(path, self._shown, packages)
        self._written = self._copy.write(folder)
        self._folders = {name: folder / root for name, root in self._copy.packages.items()}
        self._parser_notes = _Grouped()
        self._notes: list[str] = list(self._copy.notes)
        self._folder = folder
        if stuck:
            self._notes.append(
                f"{self._place(stuck[0])}: the damping of {_listed(stuck)} holds them against drives that could carry "
                "the robot: they are fixed at zero (hold_joint in robot.py)"
            )
        self._home_notes: list[str] = []  # they do not matter where a robot stands in another posture

    def robot(self) -> ProjectRobot:
        robot = ProjectRobot(self._copy.model, self._copy.files, packages=self._copy.packages)
        robot.assumptions = list(self._copy.assumptions)
        plant = self._load()[0]
        self._finalize(plant)
        if (flying := self._flying()) is not None:
            robot.flying = flying
            robot.assumptions += [f"{self._shown} {assumption}" for assumption in flying.assumptions]
            robot.notes = [*self._notes, *self._parser_notes.sentences()]
            return robot
        joints = self._joints(plant)
        robot.held = (*self._falling_base(plant, joints), *self._stuck)
        joints = [joint for joint in joints if joint.name() not in robot.held]
        robot.welded = self._free_bodies(plant)
        robot.couplings = self._couplings(joints)
        self._choose_drives(plant, joints, robot)
        plant, scene_graph, diagram = self._as_in_project(robot)
        self._read_limits(plant, joints, robot)
        if stuck := self._stuck_joints(robot):
            return _ModelReader(self._path, self._packages, self._folder, stuck=(*self._stuck, *stuck)).robot()
        self._find_legs(robot)
        if robot.standing is None:
            self._let_drives_carry(plant, robot)
        by_name = {joint.name: joint for joint in robot.joints}
        robot.away = tuple(_away(by_name[name]) for name in robot.driven)
        if robot.has_constraints and plant.num_constraints() > len(robot.couplings):
            robot.motions = self._motions(robot)
        robot.touching = self._touching(plant, scene_graph, diagram, robot)
        robot.notes = [*self._notes, *self._home_notes, *self._parser_notes.sentences()]
        return robot

    # -- Drake's parser

    def _load(self) -> tuple[MultibodyPlant, SceneGraph, DiagramBuilder]:
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        self._parse(plant)
        return plant, scene_graph, builder

    def _parse(self, plant: MultibodyPlant) -> None:
        with self._warnings():
            try:
                parse(plant, self._written, self._folders)
            except (RuntimeError, SystemExit) as error:
                raise self._error(one_line(error)) from error

    def _finalize(self, plant: MultibodyPlant) -> None:
        try:
            with self._warnings():
                plant.Finalize()
        except (RuntimeError, SystemExit) as error:
            if "loop" not in str(error):
                raise self._error(one_line(error)) from error
            where, joint = self._closing_joint()
            raise RobotFileError(
                f"{where}: joints form a loop{joint}, which Drake takes as a constraint only: open each loop at one "
                "joint, and close it by a <drake:ball_constraint> or a <mimic>"
            ) from error

    def _closing_joint(self) -> tuple[str, str]:
        """Return the place of a joint whose child is already the child of another one, and text with its name."""
        children: dict[str, str] = {}
        for joint in self._copy.xml.root.iter("joint") if self._copy.xml is not None else ():
            child = joint.find("child")
            if child is not None:
                link, name = child.get("link") or child.text.strip(), joint.get("name")
                if children.setdefault(link, name) != name:
                    return f"{self._shown}:{joint.line}", f" that {name} closes"
        return self._shown, ""

    def _error(self, message: str) -> RobotFileError:
        """Return an error with file, line (where Drake gives one) and remedy."""
        if "does not exist" in message or "could not be found" in message:
            message += " Put the file there, or take what refers to it out"
        elif "not supported for joint" in message:
            message += " Take it out, or replace it by a fixed, revolute or prismatic joint"
        elif package := re.search(r"unknown package '([^']+)'", message):
            message += f": {self._copy.missing.get(package[1], '')}"
        message = self._in_original(message.replace(_SEE_ALSO, ""))
        return RobotFileError(message if self._shown in message else f"{self._shown}: {message}")

    def _in_original(self, message: str) -> str:
        """Return a message of Drake about the copy as one about the file."""
        message = re.sub(rf"/*{re.escape(str(self._written))}", self._shown, message)
        return message.replace(str(self._folder), str(self._copy.original_folder))

    @contextmanager
    def _warnings(self) -> Iterator[None]:
        """Turn the warnings of Drake's parser into notes."""
        logger, handler = logging.getLogger("drake"), _Collector()
        level, propagate = logger.level, logger.propagate
        logger.addHandler(handler)
        logger.setLevel(logging.WARNING)
        logger.propagate = False
        try:
            yield
        finally:
            logger.removeHandler(handler)
            logger.setLevel(level)
            logger.propagate = propagate
            for message in handler.messages:
                self._parser_notes.add(self._in_original(message))

    def _place(self, name: str) -> str:
        """Return file and line where ``name`` is defined, or the file alone."""
        for number, line in enumerate(self._text.splitlines(), 1):
            if re.search(rf"""\bname\s*=\s*["']{re.escape(name)}["']""", line):
                return f"{self._shown}:{number}"
        return self._shown

    # -- joints and drives

    def _joints(self, plant: MultibodyPlant) -> list[Joint]:
        """Return the joints with one degree of freedom, in the order of the plant's positions."""
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        bases = {int(index) for index in plant.GetFloatingBaseBodies()}
        free = {joint.name() for joint in joints if int(joint.child_body().index()) in bases}
        moving = [joint for joint in joints if joint.num_positions() and joint.name() not in free]
        for joint in moving:
            if joint.type_name() not in (REVOLUTE, PRISMATIC):
                raise RobotFileError(
                    f"{self._place(joint.name())}: the joint {joint.name()} is {joint.type_name()}, but only revolute "
                    "and prismatic joints are measured and driven: replace it by several of these, or fix it"
                )
        if not moving:
            raise RobotFileError(
                f"{self._shown} has no joints to drive: its links are fixed to each other, or move freely. It is an "
                "object, not a robot; add it to the world of a scenario (Parser(plant).AddModels in add_world). "
                "A drone is known by motors at sites, bodies named rotor or propeller, or its own name"
            )
        names = [joint.name() for joint in moving]
        if twins := sorted({name for name in names if names.count(name) > 1}):
            raise RobotFileError(
                f"{self._place(twins[0])}: several joints are named {', '.join(twins)}; give each joint its own name"
            )
        return sorted(moving, key=lambda joint: int(joint.position_start()))

    def _free_bodies(self, plant: MultibodyPlant) -> dict[str, RigidTransform]:
        free = [plant.get_body(index) for index in sorted(plant.GetFloatingBaseBodies())]
        return {body.name(): plant.GetDefaultFloatingBaseBodyPose(body) for body in free}

    def _flying(self) -> FlyingRobot | None:
        plant, scene_graph, builder = self._load()
        self._finalize(plant)
        root = builder.Build().CreateDefaultContext()
        context = plant.GetMyMutableContextFromRoot(root)
        return flying_robot(self._path, self._text, plant, scene_graph.model_inspector(), context)

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
                self._home_notes.clear()
                self._notes.append(f"{self._place(base)}: {base} moves freely; the robot stands in {source}")
                break
            robot.welded[base] = X_WB
        if robot.welded:
            self._notes.append(
                f"{self._place(next(iter(robot.welded)))}: {_listed(robot.welded)} can move freely in the file: welded "
                f"to the world (WeldFrames in robot.py){reason}"
            )

    def _standing(self, base: str, robot: ProjectRobot) -> StandingRobot | None:
        """Return the stance of a robot whose base is free, or None if it has no legs."""
        plant, scene_graph, builder = self._load()
        self._change(plant, robot)
        self._finalize(plant)
        diagram = builder.Build()
        context = plant.GetMyMutableContextFromRoot(diagram.CreateDefaultContext())
        base_body, inspector = plant.GetBodyByName(base), scene_graph.model_inspector()
        postures = list(named_postures(self._path, self._text))

        def stance(*, soles: bool) -> StandingRobot | None:
            finder = StanceFinder(plant, context, inspector, base=base_body, joints=robot.joints, soles=soles)
            return finder.stance(postures)

        standing = stance(soles=True)
        if standing is None:
            return None
        if robot.has_constraints and plant.num_constraints() > len(robot.couplings):
            raise StanceError("constraints close loops between its links, which the controller does not know")
        names = [joint.name for joint in robot.joints]
        motions = np.array([[float(name == driven) for driven in robot.driven] for name in names])
        for coupling in robot.couplings:
            motions[names.index(coupling.joint), robot.driven.index(coupling.leader)] = coupling.multiplier
        limit = np.array([robot.joints[names.index(driven)].effort for driven in robot.driven])

        def make_plant() -> MultibodyPlant:
            model = self._load()[0]
            self._change(model, robot)
            for constraint in model.GetConstraintIds():
                model.RemoveConstraint(constraint)
            model.Finalize()
            return model

        def model(stance: Stance) -> WholeBodyModel:
            return WholeBodyModel(make_plant, stance, motions=motions, limit=limit)

        standing = with_shift(standing, model, names)
        if standing.reached < _LEAST_REACHED and (on_points := stance(soles=False)) is not None:
            # Legs of three joints cannot keep a sole level: their feet are balls, drawn by meshes.
            standing = with_shift(on_points, model, names)
        if standing.reached < _LEAST_REACHED:
            raise StanceError("it cannot shift its weight within the limits of its drives and joints")
        return standing

    def _falling_base(self, plant: MultibodyPlant, joints: list[Joint]) -> tuple[str, ...]:
        """Return the joints between the world and the first drive, if none of them carries the robot's weight.

        Such a base moves in a plane, as simulated walkers' do; it is held, as free bases without a stance are welded.
        """
        drives = {plant.get_joint_actuator(index).joint().name() for index in plant.GetJointActuatorIndices()}
        drives.update(self._transmitted(joints))
        context = plant.CreateDefaultContext()
        weights = plant.CalcGravityGeneralizedForces(context)
        by_parent: dict[int, list[Joint]] = {}
        for index in plant.GetJointIndices():
            by_parent.setdefault(int(plant.get_joint(index).parent_body().index()), []).append(plant.get_joint(index))
        base, body = [], int(plant.world_body().index())
        names = {joint.name() for joint in joints}
        while len(further := by_parent.get(body, [])) == 1 and further[0].name() in names - drives:
            base.append(further[0])
            body = int(further[0].child_body().index())
        falls = any(j.type_name() == PRISMATIC and abs(weights[int(j.velocity_start())]) > _FALLS for j in base)
        if not (drives and falls):
            return ()
        held = tuple(joint.name() for joint in base)
        self._notes.append(
            f"{self._place(held[0])}: no actuator carries {_listed(held)} of the base, which would fall: they are held "
            "at home (hold_joint in robot.py)"
        )
        return held

    def _couplings(self, joints: list[Joint]) -> tuple[Coupling, ...]:
        names = {joint.name() for joint in joints}
        return tuple(c for c in _mimics(self._copy.xml) if c.joint in names and c.leader in names)

    def _transmitted(self, joints: list[Joint]) -> list[str]:
        """Return the joints that the transmissions of a URDF name, also transmissions that Drake leaves out.

        A differential has two joints, and some types have tags of their own, such as ``<flexJoint>``.
        """
        xml, moving = self._copy.xml, {joint.name() for joint in joints}
        transmissions = xml.root.iter("transmission") if xml is not None and xml.root.tag == URDF else ()
        tags = [part for transmission in transmissions for part in transmission.iter()]
        names = [tag.get("name") for tag in tags if re.search("^(?!passive).*joint$", tag.tag, re.IGNORECASE)]
        return [name for name in dict.fromkeys(names) if name in moving]

    def _choose_drives(self, plant: MultibodyPlant, joints: list[Joint], robot: ProjectRobot) -> None:
        followers = {coupling.joint for coupling in robot.couplings}
        drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        controlled = [drive for drive in drives if drive.has_controller()]
        robot.servos = tuple(drive.name() for drive in controlled if drive.joint().name() not in followers)
        if robot.servos:
            self._notes.append(
                f"{self._place(robot.servos[0])}: the actuators {_listed(robot.servos)} control positions or "
                "velocities; the DPS commands torques or forces instead"
            )
        driven_by_drake = {drive.joint().name() for drive in drives}
        transmitted = [name for name in self._transmitted(joints) if name not in followers | driven_by_drake]
        robot.added_drives = tuple(transmitted)
        if transmitted:
            self._notes.append(
                f"{self._place(transmitted[0])}: Drake leaves out the <transmission> of {_listed(transmitted)}, which "
                "has several joints or a type of its own: each of them gets a drive of its own"
            )
        if not drives and not transmitted:
            self._notes.append(
                f"{self._shown} has no actuators (a <transmission> in URDF, an <effort> in SDF, a <motor> in MJCF): "
                "every joint gets one (take those that move freely out of DRIVEN in robot.py)"
            )
            robot.added_drives = tuple(joint.name() for joint in joints if joint.name() not in followers)
        joints_with_drive = [drive.joint().name() for drive in drives] + [*robot.added_drives]
        robot.without_drive = tuple(drive.name() for drive in drives if drive.joint().name() in followers)
        driven = [name for name in joints_with_drive if name not in followers]
        if twins := sorted({name for name in driven if driven.count(name) > 1}):
            raise RobotFileError(f"{self._place(twins[0])}: the joint {twins[0]} has several actuators; give it one")
        if not driven:
            raise RobotFileError(f"{self._shown} has no joints to drive: those with actuators follow other joints")
        robot.couplings = tuple(coupling for coupling in robot.couplings if coupling.leader in driven)
        for coupling in robot.couplings:
            self._notes.append(
                f"{self._place(coupling.joint)}: {coupling.joint} follows {coupling.leader}, whose drive moves both"
            )
        passive = [j.name() for j in joints if j.name() not in driven and j.name() not in followers]
        if passive:
            self._notes.append(
                f"{self._place(passive[0])}: no actuator of {_listed(passive)}, which moves freely: measured, but not "
                "controlled. Give it an actuator in the file if it has a drive"
            )

    def _as_in_project(self, robot: ProjectRobot) -> tuple[MultibodyPlant, SceneGraph, Diagram]:
        """Return the plant of the project's world: as the file has it, with the changes that ``robot`` lists."""
        plant, scene_graph, builder = self._load()
        self._change(plant, robot)
        for name in robot.added_drives:
            plant.AddJointActuator(name, plant.GetJointByName(name))
        drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        robot.driven = tuple(drive.joint().name() for drive in drives)
        robot.has_constraints = plant.num_constraints() > 0
        self._finalize(plant)
        self._check_model(robot)
        return plant, scene_graph, builder.Build()

    @staticmethod
    def _change(plant: MultibodyPlant, robot: ProjectRobot) -> None:
        """Make the changes that ``robot`` lists, but for the drives that are added."""
        for name, X_WB in robot.welded.items():
            plant.WeldFrames(plant.world_frame(), plant.GetBodyByName(name).body_frame(), X_WB)
        for name in robot.held:
            hold_joint(plant, name)
        for name in robot.without_drive:
            plant.RemoveJointActuator(plant.GetJointActuatorByName(name))
        for name in robot.servos:
            replace_servo(plant, name)

    def _check_model(self, robot: ProjectRobot) -> None:
        """Check that the controller can compute with the model, without the constraints."""
        plant = self._load()[0]
        self._change(plant, robot)
        for constraint in plant.GetConstraintIds():
            plant.RemoveConstraint(constraint)
        self._finalize(plant)
        context = plant.CreateDefaultContext()
        try:
            PlantDynamics(plant, context)
        except UnsupportedPlantError as error:
            raise RobotFileError(f"{self._shown}: the controller needs a model of the robot, but {error}") from error

    def _motions(self, robot: ProjectRobot) -> NDArray[np.float64]:
        """Return the velocities at home that a small torque of each drive causes, by the driven joints' velocities.

        Drake's solver keeps the constraints, without gravity and contact.
        """
        plant = MultibodyPlant(0.001)
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self._parse(plant)
        self._change(plant, robot)
        for name in robot.added_drives:
            plant.AddJointActuator(name, plant.GetJointByName(name))
        self._finalize(plant)
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
        self._notes.append(
            f"{self._shown} closes loops by constraints: the controller takes their motion at home (B in robot.py), "
            "and may be less accurate far from it"
        )
        return motions

    # -- numbers

    def _read_limits(self, plant: MultibodyPlant, joints: list[Joint], robot: ProjectRobot) -> None:
        names = [joint.name() for joint in joints]
        assumed: dict[str, list[str]] = {name: [] for name in names}
        ranges = {joint.name(): self._range(joint, assumed) for joint in joints}
        defaults = plant.GetDefaultPositions()
        homes = {name: self._home(name, float(q), ranges[name]) for name, q in zip(names, defaults, strict=True)}
        context = plant.CreateDefaultContext()
        plant.SetPositions(context, [homes[name] for name in names])
        self._check_inertia(plant, context, joints)
        efforts = self._efforts(plant, context, joints, robot, ranges=ranges, assumed=assumed)
        result, damped = [], []
        for joint in joints:
            name, speed = joint.name(), _speed(joint)
            if speed != joint.velocity_upper_limit():
                assumed[name].append("speed")
            braked = _braked(speed, efforts[name], float(joint.default_damping()))
            if braked < speed:
                damped.append(f"{name} {braked:g}")
                speed = braked
            gaps = tuple(sorted(assumed[name]))
            result.append(
                RobotJoint(name, joint.type_name(), *ranges[name], speed, efforts[name], homes[name], assumed=gaps)
            )
        if damped:
            self._notes.append(
                f"{self._shown}: at the speed limit, the damping of joints takes more than half of the effort of their "
                f"drives; the speeds (rad/s or m/s) are therefore {_listed(damped)}"
            )
        robot.joints = tuple(result)
        robot.assumptions += self._assumptions(result)

    @staticmethod
    def _stuck_joints(robot: ProjectRobot) -> tuple[str, ...]:
        """Return the joints without an actuator in the file that damping holds: authors write it for a fixed joint."""
        stuck = tuple(
            joint.name
            for joint in robot.joints
            if joint.name in robot.added_drives and joint.upper - joint.lower > _LONGEST_RANGE * joint.speed
        )
        return stuck if len(stuck) < len(robot.driven) else ()

    def _let_drives_carry(self, plant: MultibodyPlant, robot: ProjectRobot) -> None:
        """Move the home of a robot whose drives cannot hold it there to the nearest posture in which they can."""
        homes = np.array([joint.home for joint in robot.joints])
        B, context = _selection(robot), plant.CreateDefaultContext()
        weak = np.flatnonzero(_loads(plant, context, robot, homes) > 1.0)
        if not weak.size:
            return
        moved = np.array([k for k, joint in enumerate(robot.joints) if joint.name in robot.driven])
        lower, upper = np.transpose([(robot.joints[k].lower, robot.joints[k].upper) for k in moved])
        follow = B @ np.eye(len(robot.driven))[[robot.driven.index(robot.joints[k].name) for k in moved]].T

        def errors(x: NDArray[np.float64]) -> NDArray[np.float64]:
            excess = np.maximum(_loads(plant, context, robot, homes + follow @ (x - homes[moved])) - _CARRIED, 0.0)
            return np.concatenate([10.0 * excess, 0.1 * (x - homes[moved]) / (upper - lower)])

        start = np.clip(homes[moved], lower + 1e-6 * (upper - lower), upper - 1e-6 * (upper - lower))
        solution = least_squares(errors, start, bounds=(lower, upper), diff_step=1e-3, max_nfev=100)
        q = homes + follow @ (solution.x - homes[moved])
        name = robot.driven[weak[0]]
        cannot = (
            f"{self._place(name)}: the drives of {_listed(robot.driven[k] for k in weak)} cannot carry the robot in "
            "the file's posture"
        )
        if _loads(plant, context, robot, q).max() > 1.0:
            self._notes.append(f"{cannot}, nor in one near it: they sink. Give them higher limits in the file")
            return
        q = np.where(np.abs(q - homes) < _UNMOVED, homes, np.round(q, 4))
        robot.joints = tuple(
            replace(joint, home=float(np.clip(value, joint.lower, joint.upper)))
            for joint, value in zip(robot.joints, q, strict=True)
        )
        self._notes.append(f"{cannot}: its home is the nearest one in which they can")

    def _range(self, joint: Joint, assumed: dict[str, list[str]]) -> tuple[float, float]:
        """Return the range of a joint; what the file does not state is noted as assumed."""
        name, reach = joint.name(), _ASSUMED_REACH[joint.type_name()]
        lower, upper = float(joint.position_lower_limit()), float(joint.position_upper_limit())
        if not (math.isfinite(lower) and math.isfinite(upper)):
            assumed[name].append("range")
            lower, upper = max(lower, -reach), min(upper, reach)
        if not lower < upper:
            raise RobotFileError(
                f"{self._place(name)}: the range of {name} is empty, {lower:g} to {upper:g}: give it a lower and "
                "an upper limit, or make it a fixed joint"
            )
        return lower, upper

    def _home(self, name: str, default: float, ends: tuple[float, float]) -> float:
        """Return the home position of a joint: its default, or the middle of its range if that lies outside."""
        lower, upper = ends
        home = default if lower <= default <= upper else 0.5 * (lower + upper)
        if home != default:
            self._home_notes.append(
                f"{self._place(name)}: the default position {default:g} of {name} is outside its range: its home "
                f"is {home:.4g}, in the middle"
            )
        return home

    def _efforts(
        self,
        plant: MultibodyPlant,
        context: Context,
        joints: list[Joint],
        robot: ProjectRobot,
        *,
        ranges: dict[str, tuple[float, float]],
        assumed: dict[str, list[str]],
    ) -> dict[str, float]:
        """Return the limit of the effort of each joint, 0 if it has no drive; unstated ones are noted as assumed.

        Args:
            plant: The robot.
            context: A context of it, at home.
            joints: Its joints.
            robot: It learns whether the project must set the limits of its drives.
            ranges: Range of each joint.
            assumed: Names of the limits that the file does not state, by joint.
        """
        names = [joint.name() for joint in joints]
        weights = self._weights(plant, context, ranges, names)
        M = plant.CalcMassMatrix(context)
        efforts = {name: 0.0 for name in names}
        stated = _stated_efforts(self._copy.xml, self._copy.included)
        forces = {name: force for name, force in _forces(self._copy).items() if name in robot.servos}
        for index in plant.GetJointActuatorIndices():
            drive = plant.get_joint_actuator(index)
            name, limit = drive.joint().name(), drive.effort_limit()
            if self._path.suffix == ".xml" and math.isfinite(limit) and drive.default_gear_ratio() != 1.0:
                # In MuJoCo the gear multiplies the command, in Drake it does not.
                limit *= abs(drive.default_gear_ratio())
                robot.sets_efforts = True
            if drive.name() in forces:
                # Drake takes the ctrlrange for a torque or force, but it is one of positions or velocities.
                limit = forces[drive.name()]
                robot.sets_efforts = True
            if not math.isfinite(limit) and name in stated:
                # Drake takes over a URDF's limit for the joint of a <transmission> only, and none of a joint in MJCF.
                limit = stated[name]
                robot.sets_efforts |= name not in robot.added_drives
            if not math.isfinite(limit):
                k = names.index(name)
                acceleration = _speed(joints[k]) / _TIME_TO_SPEED
                limit = _rounded_up(_WEIGHTS * weights[:, k].max() + acceleration * M[k, k])
                assumed[name].append("effort")
                robot.sets_efforts |= name not in robot.added_drives
            efforts[name] = limit
        return efforts

    def _assumptions(self, joints: list[RobotJoint]) -> list[str]:
        """Return a sentence for each kind of limit that the file does not state for every joint."""
        sentences = []
        for value in ("effort", "speed", "range"):
            if missing := [joint for joint in joints if value in joint.assumed]:
                values = _listed(f"{joint.name} {_limit(joint, value)}" for joint in missing)
                sentences.append(
                    f"{self._place(missing[0].name)} gives no limit of the {value}, assumed is {values}: compare "
                    "JOINTS in robot.py with the data sheet"
                )
        return sentences

    def _check_inertia(self, plant: MultibodyPlant, context: Context, joints: list[Joint]) -> None:
        M = plant.CalcMassMatrix(context)
        values, vectors = np.linalg.eigh(M)
        if values[0] > 1e-12 * values[-1] and np.isfinite(M).all():
            return
        k = int(np.argmax(np.abs(vectors[:, 0])))
        joint = joints[k]
        link = joint.child_body().name()
        raise RobotFileError(
            f"{self._place(link)}: nothing that the joint {joint.name()} moves has inertia, so that any torque would "
            f"accelerate it infinitely: give the link {link} an <inertial> with a mass and moments of inertia"
        )

    def _weights(
        self, plant: MultibodyPlant, context: Context, ranges: dict[str, tuple[float, float]], names: list[str]
    ) -> NDArray[np.float64]:
        """Return the absolute torques of gravity in some postures within the ranges, shape (postures, joints)."""
        moved, random = context.Clone(), np.random.default_rng(0)
        lower, upper = np.transpose([ranges[name] for name in names])
        weights = []
        for share in (0.5, *random.uniform(size=(200, len(names)))):
            plant.SetPositions(moved, lower + share * (upper - lower))
            weights.append(np.abs(plant.CalcGravityGeneralizedForces(moved)))
        return np.array(weights)

    def _touching(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, diagram: Diagram, robot: ProjectRobot
    ) -> tuple[str, ...]:
        """Return the bodies that touch each other at home, and change ``robot.away`` until no others do on the way."""
        contacts = _Contacts(plant, scene_graph, diagram)
        home = np.array([joint.home for joint in robot.joints])
        random = np.random.default_rng(0)
        moves = random.uniform(-_AROUND_HOME, _AROUND_HOME, (_NEIGHBOURS, len(robot.driven))) @ _selection(robot).T
        touching = set().union(*(contacts.touching(q) for q in (home, *(home + moves))))
        if touching:
            self._notes.append(
                f"{self._shown}: {_listed(sorted(touching))} touch each other at home: their contact is left out "
                "(TOUCHING in robot.py)"
            )
        names = [joint.name for joint in robot.joints]
        speed = np.array([robot.joints[names.index(driven)].speed for driven in robot.driven])
        B = _selection(robot)
        start = home[[names.index(driven) for driven in robot.driven]]
        away = np.array(robot.away)
        met: set[str] = set()
        context = plant.CreateDefaultContext()
        carried = max(_HEAVIEST, _loads(plant, context, robot, home).max())
        for step in _steps(robot, start, away - start):
            seconds = np.linspace(0.0, (np.abs(step) / speed).max(), _POSTURES)[1:]
            postures = [home + B @ np.clip(step, -t * speed, t * speed) for t in seconds]
            met = set().union(*(contacts.touching(q, among=touching) for q in postures))
            robot.away = tuple(float(f"{value:.4g}") for value in start + step)
            if not met and max(_loads(plant, context, robot, q).max() for q in postures) <= carried:
                break
        if met:
            self._notes.append(
                f"{self._shown}: {_listed(sorted(met))} touch something wherever the robot moves from home: their "
                "contact is left out (TOUCHING in robot.py)"
            )
        return tuple(sorted(touching | met))


class _Contacts:
    """Which bodies touch each other in a posture."""

    def __init__(self, plant: MultibodyPlant, scene_graph: SceneGraph, diagram: Diagram) -> None:
        self._plant = plant
        context = diagram.CreateDefaultContext()
        self._context = plant.GetMyMutableContextFromRoot(context)
        self._query = scene_graph.get_query_output_port()
        self._query_context = scene_graph.GetMyContextFromRoot(context)

    def touching(self, positions: NDArray[np.float64], among: Collection[str] = ()) -> set[str]:
        """Return the names of bodies that touch each other, but for pairs of two that are in ``among``."""
        self._plant.SetPositions(self._context, positions)
        query = self._query.Eval(self._query_context)
        frame_of = query.inspector().GetFrameId
        bodies: set[str] = set()
        for pair in query.ComputePointPairPenetration():
            names = {self._plant.GetBodyFromFrameId(frame_of(geometry)).name() for geometry in (pair.id_A, pair.id_B)}
            if not names <= set(among):
                bodies |= names
        return bodies


def parse(plant: MultibodyPlant, model: Path, packages: Mapping[str, Path] = MappingProxyType({})) -> None:
    """Add a model file to a plant.

    Args:
        plant: The plant, which is changed.
        model: The file.
        packages: The folders of the packages that it names.
    """
    parser = Parser(plant)
    for name, folder in packages.items():
        parser.package_map().Add(name, str(folder))
    parser.AddModels(str(model))


def add_model(plant: MultibodyPlant, model: Path, packages: Mapping[str, Path] = MappingProxyType({})) -> None:
    """Add the model file of a project to a plant, without the parser's warnings, which ``vtbdrake new`` printed.

    Args:
        plant: The plant, which is changed.
        model: The file.
        packages: The folders of the packages that it names.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        parse(plant, model, packages)
    finally:
        logger.setLevel(level)


def replace_servo(plant: MultibodyPlant, name: str) -> None:
    """Replace an actuator that has a controller by one that takes a torque or force, with the same rotor.

    Args:
        plant: The plant, before it is finalized; it is changed.
        name: Name of the actuator, which only one model instance has.
    """
    servo = plant.GetJointActuatorByName(name)
    joint, limit = servo.joint(), servo.effort_limit()
    rotor, gear = servo.default_rotor_inertia(), servo.default_gear_ratio()
    plant.RemoveJointActuator(servo)
    drive = plant.AddJointActuator(name, joint, limit)
    drive.set_default_rotor_inertia(rotor)
    drive.set_default_gear_ratio(gear)


def hold_joint(plant: MultibodyPlant, name: str) -> None:
    """Replace a joint by a weld, in which its two frames coincide: the joint's zero position.

    Args:
        plant: The plant, before it is finalized; it is changed.
        name: Name of the joint, which only one model instance has.
    """
    joint = plant.GetJointByName(name)
    on_parent, on_child = joint.frame_on_parent(), joint.frame_on_child()
    plant.RemoveJoint(joint)
    plant.WeldFrames(on_parent, on_child)


class _Grouped:
    """Messages about places, those that are alike in one sentence."""

    def __init__(self) -> None:
        self._groups: dict[str, dict[str, None]] = {}

    def add(self, message: str) -> None:
        """Add a message ``FILE:LINE: ...``, unless it is there."""
        _, _, text = message.rpartition(": ") if not _PLACE.match(message) else ("", "", _PLACE.sub("", message))
        key = re.sub(r"'[^']*'|\"[^\"]*\"|[-+.\d]+", "*", text)
        self._groups.setdefault(key, {})[message] = None

    def sentences(self) -> Iterator[str]:
        """Yield the first message of each group, with the number of the further."""
        for messages in self._groups.values():
            first, *further = messages
            place = _PLACE.match(first)
            if further and place:
                yield f"{place[1]} and {len(further)} more of the kind: {_PLACE.sub('', first)}"
            else:
                yield f"{first} ({len(further)} more of the kind)" if further else first


class _Collector(logging.Handler):
    """Collects the first line of each message."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage().partition("\n")[0].replace(": warning:", ":"))


def _selection(robot: ProjectRobot) -> NDArray[np.float64]:
    """Return the velocities of all joints by the driven joints' velocities, shape (joints, driven)."""
    if robot.motions is not None:
        return robot.motions
    names = [joint.name for joint in robot.joints]
    B = np.array([[float(name == driven) for driven in robot.driven] for name in names])
    for coupling in robot.couplings:
        B[names.index(coupling.joint), robot.driven.index(coupling.leader)] = coupling.multiplier
    return B


def _steps(robot: ProjectRobot, start: NDArray[np.float64], step: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield ways of the driven joints from home, shorter ones and to other sides, within their ranges."""
    joints = {joint.name: joint for joint in robot.joints}
    lower, upper = np.transpose([(joints[name].lower, joints[name].upper) for name in robot.driven])
    random = np.random.default_rng(0)
    sides = [np.ones(len(step)), -np.ones(len(step)), *random.choice([-1.0, 1.0], (_RANDOM_SIDES, len(step)))]
    for share in _SHARES_OF_THE_WAY:
        for side in sides:
            end = start + share * side * step
            yield np.where((lower <= end) & (end <= upper), share * side, share) * step


def _loads(
    plant: MultibodyPlant, context: Context, robot: ProjectRobot, positions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the shares of the limits of the drives that the weight takes in a posture, shape (driven,)."""
    plant.SetPositions(context, positions)
    names = [joint.name for joint in robot.joints]
    limit = np.array([robot.joints[names.index(driven)].effort for driven in robot.driven])
    loads: NDArray[np.float64] = np.abs(_selection(robot).T @ plant.CalcGravityGeneralizedForces(context)) / limit
    return loads


def _listed(names: object) -> str:
    return ", ".join(map(str, names))  # type: ignore[call-overload]


def _limit(joint: RobotJoint, value: str) -> str:
    """Return an effort, speed or range with its unit."""
    unit = "m" if joint.kind == PRISMATIC else "rad"
    if value == "range":
        return f"{joint.lower:.3g} to {joint.upper:.3g} {unit}"
    if value == "speed":
        return f"{joint.speed:g} {unit}/s"
    return f"{joint.effort:g} {'N' if joint.kind == PRISMATIC else 'N m'}"


def _speed(joint: Joint) -> float:
    limit = float(joint.velocity_upper_limit())  # 0 is what exporters write where they know none
    return limit if math.isfinite(limit) and limit > 0.0 else _ASSUMED_SPEED[joint.type_name()]


def _braked(speed: float, effort: float, damping: float) -> float:
    """Return the speed at which the damping of a joint takes half of the effort of its drive, if it is slower."""
    if not effort or damping * speed <= _DAMPED * effort:
        return speed
    return float(f"{_DAMPED * effort / damping:.2g}")


def _rounded_up(value: float) -> float:
    """Return the next larger number with two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit) * unit:.6g}")


def _away(joint: RobotJoint) -> float:
    """Return another position of a joint, towards its farther end."""
    end = joint.upper if joint.upper - joint.home > joint.home - joint.lower else joint.lower
    step = min(_SHARE * abs(end - joint.home), _STEP[joint.kind], _LONGEST_WAY * joint.speed)
    return float(f"{joint.home + math.copysign(step, end - joint.home):.4g}")


def _stated_efforts(xml: XmlText | None, included: Collection[XmlText]) -> dict[str, float]:
    """Return the effort limits (N m or N) by joint that Drake leaves out; 0 is what exporters write for unknown ones.

    These are <limit effort> in a URDF, and actuatorfrcrange in MJCF.
    """
    efforts: dict[str, float] = {}
    if xml is None or xml.root.tag not in (URDF, MJCF):
        return efforts
    for joint in [joint for text in (xml, *included) for joint in text.root.iter("joint")]:
        limit = joint.find("limit")
        text = limit.get("effort") if limit is not None else joint.get("actuatorfrcrange")
        effort = max((abs(float(number)) for number in text.split()), default=0.0)
        if effort > 0.0:
            efforts[joint.get("name")] = effort
    return efforts


def _forces(copy: ModelCopy) -> dict[str, float]:
    """Return the largest force or torque of each actuator in MJCF by its forcerange, infinite where it has none."""
    forces: dict[str, float] = {}
    texts = [xml for xml in (copy.xml, *copy.included) if xml is not None]
    defaults = [child for xml in texts for part in xml.root.iter("default") for child in part.children]
    defaults = [child for child in defaults if child.get("forcerange")]
    for actuator in [child for xml in texts for part in xml.root.iter("actuator") for child in part.children]:
        of_class = next((default.get("forcerange") for default in defaults if default.tag == actuator.tag), "")
        numbers = (actuator.get("forcerange") or of_class).split()
        forces[actuator.get("name")] = max((abs(float(number)) for number in numbers), default=math.inf)
    return forces


def _mimics(xml: XmlText | None) -> Iterator[Coupling]:
    """Yield the couplings in a URDF (<mimic> in a joint) or SDF (<drake:mimic> in a joint)."""
    if xml is None:
        return
    # Drake has no couplings for the <mimic> of SDF, only for its own.
    tag = "mimic" if xml.root.tag == URDF else "drake:mimic"
    for joint in xml.root.iter("joint"):
        for element in joint.iter(tag):
            if "joint" in element.attributes:
                yield Coupling(joint.get("name"), element.get("joint"), float(element.get("multiplier", "1")))
