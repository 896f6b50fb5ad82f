"""The robot in a URDF, SDF or MJCF file: which joints it drives, within which limits, and what its file leaves out."""

from __future__ import annotations

import logging
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import Joint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from vtbdrake.components.compiled_plant import PlantDynamics, UnsupportedPlantError
from vtbdrake.failures import one_line

SUFFIXES = (".urdf", ".sdf", ".xml")

REVOLUTE, PRISMATIC = "revolute", "prismatic"
# What is assumed where a file says nothing, by the kind of joint: in rad or m, and per second.
_ASSUMED_REACH = {REVOLUTE: 2.0 * math.pi, PRISMATIC: 1.0}
_ASSUMED_SPEED = {REVOLUTE: 3.0, PRISMATIC: 0.5}
# An assumed drive carries so many times the weight, and beside it accelerates to its speed within this time, in s.
_WEIGHTS, _TIME_TO_SPEED = 2.0, 0.02
# The other posture of examples lies at most this far from home, and this share of the way to the farther end.
_STEP = {REVOLUTE: 0.4, PRISMATIC: 0.1}
_SHARE = 0.15

_MODEL_SUFFIXES = "urdf|sdf|xml|obj|mtl|stl|dae|gltf|glb|bin|vtk|png|jpe?g|ktx2|tga|bmp"
_QUOTED_FILE = re.compile(rf"""["'>]\s*([^"'<>]+?\.(?:{_MODEL_SUFFIXES}))\s*["'<]""", re.IGNORECASE)
_OBJ_FILE = re.compile(rf"^\s*(?:mtllib|map_\w+|bump|disp|norm)\b.*?(\S+\.(?:{_MODEL_SUFFIXES}))\s*$", re.M | re.I)


class RobotFileError(ValueError):
    """A file describes no robot that a project can be made for; the message names file, line and remedy."""


@dataclass(frozen=True)
class RobotJoint:
    """A joint with one degree of freedom: rad or m, per second, N m or N."""

    name: str
    kind: str  # REVOLUTE or PRISMATIC
    lower: float
    upper: float
    speed: float
    effort: float  # 0: it has no drive
    home: float
    assumed: tuple[str, ...]  # the names of the values that are not in the file


@dataclass(frozen=True)
class Coupling:
    """A joint that follows another one: its velocity is ``multiplier`` times that of ``leader``."""

    joint: str
    leader: str
    multiplier: float


@dataclass
class Robot:
    """A robot as a project needs it.

    Attributes:
        model: The path of its file among ``files``.
        files: The files that the model consists of: path in the project's folder ``models`` -> source.
        joints: Its joints, in the order of the plant's positions.
        driven: The names of the joints with drives, in the order of the plant's actuators.
        away: Another posture of the driven joints, for examples.
        packages: Whether the model refers to its files by ``package://``.
        welded: The bodies that are free in the file, and where they are welded to the world.
        adds_drives: Whether the file has no actuators, so that they are added.
        servos: The names of actuators of the file with position or velocity controllers, which are left out.
        without_drive: The names of actuators of the file that are left out, with their joints' drives.
        sets_efforts: Whether the effort limits of some actuators are not those of the file.
        has_constraints: Whether there are constraints between joints or bodies.
        couplings: The joints that follow driven ones.
        motions: Where other constraints close loops: the velocities of all joints by those of the driven ones, at home,
            shape (joints, driven); otherwise None.
        touching: The names of bodies that touch each other at home.
        notes: What is missing or unusual in the file, and what is done about it.
    """

    model: Path
    files: dict[Path, Path]
    joints: tuple[RobotJoint, ...] = ()
    driven: tuple[str, ...] = ()
    away: tuple[float, ...] = ()
    packages: bool = False
    welded: dict[str, RigidTransform] = field(default_factory=dict)
    adds_drives: bool = False
    servos: tuple[str, ...] = ()
    without_drive: tuple[str, ...] = ()
    sets_efforts: bool = False
    has_constraints: bool = False
    couplings: tuple[Coupling, ...] = ()
    motions: NDArray[np.float64] | None = None
    touching: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        return f"{self.model.name}, {len(self.driven)} of its {len(self.joints)} joints driven"


def resolve(text: str) -> Path:
    """Return the path of a model file that is given by its path or as ``package://...``.

    Raises:
        RobotFileError: There is no such file, or its name has another suffix than those of `SUFFIXES`.
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


def read_robot(path: Path) -> Robot:
    """Return the robot in a model file.

    Args:
        path: A path of `resolve`.

    Raises:
        RobotFileError: Drake cannot read it, it has no joints to drive, or joints or links of unsupported kinds.
    """
    return _Reader(path).robot()


class _Reader:
    """Reads one model file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._shown = min(str(path), os.path.relpath(path), key=len)
        self._text = path.read_text(encoding="utf-8", errors="replace")
        self._notes: list[str] = []

    def robot(self) -> Robot:
        files, packages = self._files()
        robot = Robot(next(p for p, source in files.items() if source == self._path), files, packages=packages)
        with self._warnings():
            plant = self._load()[0]
            self._finalize(plant)
        joints = self._joints(plant)
        robot.welded = self._free_bodies(plant)
        robot.couplings = self._couplings(joints)
        self._choose_drives(plant, joints, robot)
        plant, scene_graph, diagram = self._as_in_project(robot, [joint.name() for joint in joints])
        self._read_limits(plant, joints, robot)
        if robot.has_constraints and plant.num_constraints() > len(robot.couplings):
            robot.motions = self._motions(robot)
        robot.touching = self._touching(plant, scene_graph, diagram, robot)
        robot.notes = self._notes
        return robot

    # -- Drake's parser

    def _load(self) -> tuple[MultibodyPlant, SceneGraph, DiagramBuilder]:
        builder = DiagramBuilder()
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
        self._parse(plant)
        return plant, scene_graph, builder

    def _parse(self, plant: MultibodyPlant) -> None:
        parser = Parser(plant)
        for root in _package_roots(self._path, self._text).values():
            parser.package_map().AddPackageXml(str(root / "package.xml"))
        try:
            parser.AddModels(str(self._path))
        except RuntimeError as error:
            raise self._error(one_line(error)) from error

    def _finalize(self, plant: MultibodyPlant) -> None:
        try:
            plant.Finalize()
        except (RuntimeError, SystemExit) as error:
            remedy = ""
            if "loop" in str(error):
                remedy = "; open each loop at one joint, and close it by a <drake:ball_constraint> or a <mimic>"
            raise self._error(f"{one_line(error)}{remedy}") from error

    def _error(self, message: str) -> RobotFileError:
        """Return an error with file, line (where Drake gives one) and remedy."""
        if "does not exist" in message:
            message += " Put the file there, or take its <visual> or <collision> out"
        elif "unknown package" in message:
            message += ". Put the package's folder, with its package.xml, around the model file"
        if str(self._path) not in message:
            message = f"{self._path}: {message}"
        return RobotFileError(message.replace(str(self._path), self._shown))

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
            messages = (message.replace(str(self._path), self._shown) for message in handler.messages)
            self._notes += [message for message in dict.fromkeys(messages) if message not in self._notes]

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
                "object, not a robot; add it to the world of a scenario (Parser(plant).AddModels in add_world)"
            )
        names = [joint.name() for joint in moving]
        if twins := sorted({name for name in names if names.count(name) > 1}):
            raise RobotFileError(
                f"{self._place(twins[0])}: several joints are named {', '.join(twins)}; give each joint its own name"
            )
        return sorted(moving, key=lambda joint: int(joint.position_start()))

    def _free_bodies(self, plant: MultibodyPlant) -> dict[str, RigidTransform]:
        free = [plant.get_body(index) for index in sorted(plant.GetFloatingBaseBodies())]
        poses = {body.name(): plant.GetDefaultFloatingBaseBodyPose(body) for body in free}
        if poses:
            self._notes.append(
                f"{self._place(next(iter(poses)))}: {_listed(poses)} can move freely in the file: welded to the world "
                "(WeldFrames in robot.py). A robot that walks or flies needs sensors of its pose, another controller"
            )
        return poses

    def _couplings(self, joints: list[Joint]) -> tuple[Coupling, ...]:
        names = {joint.name() for joint in joints}
        return tuple(c for c in _mimics(self._text) if c.joint in names and c.leader in names)

    def _choose_drives(self, plant: MultibodyPlant, joints: list[Joint], robot: Robot) -> None:
        followers = {coupling.joint for coupling in robot.couplings}
        drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
        controlled = [drive for drive in drives if drive.has_controller()]
        robot.servos = tuple(drive.name() for drive in controlled if drive.joint().name() not in followers)
        if robot.servos:
            self._notes.append(
                f"{self._place(robot.servos[0])}: the actuators {_listed(robot.servos)} control positions or "
                "velocities; the DPS commands torques or forces instead"
            )
        if not drives:
            self._notes.append(
                f"{self._shown} has no actuators (a <transmission> in URDF, an <effort> in SDF, a <motor> in MJCF): "
                "every joint gets one (take those that move freely out of DRIVEN in robot.py)"
            )
            robot.adds_drives = True
        joints_with_drive = [drive.joint().name() for drive in drives] or [joint.name() for joint in joints]
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

    def _as_in_project(self, robot: Robot, joint_names: list[str]) -> tuple[MultibodyPlant, SceneGraph, Diagram]:
        """Return the plant of the project's world: as the file has it, with the changes that ``robot`` lists."""
        with self._warnings():
            plant, scene_graph, builder = self._load()
            self._change(plant, robot)
            followers = {coupling.joint for coupling in robot.couplings}
            for name in joint_names if robot.adds_drives else ():
                if name not in followers:
                    plant.AddJointActuator(name, plant.GetJointByName(name))
            drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
            robot.driven = tuple(drive.joint().name() for drive in drives)
            robot.has_constraints = plant.num_constraints() > 0
            self._finalize(plant)
            self._check_model(robot)
            return plant, scene_graph, builder.Build()

    @staticmethod
    def _change(plant: MultibodyPlant, robot: Robot) -> None:
        """Make the changes that ``robot`` lists, but for the drives that are added."""
        for name, X_WB in robot.welded.items():
            plant.WeldFrames(plant.world_frame(), plant.GetBodyByName(name).body_frame(), X_WB)
        for name in robot.without_drive:
            plant.RemoveJointActuator(plant.GetJointActuatorByName(name))
        for name in robot.servos:
            replace_servo(plant, name)

    def _check_model(self, robot: Robot) -> None:
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

    def _motions(self, robot: Robot) -> NDArray[np.float64]:
        """Return the velocities at home that a small torque of each drive causes, by those of the driven joints.

        Drake's solver keeps the constraints, without gravity and contact.
        """
        plant = MultibodyPlant(0.001)
        plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self._parse(plant)
        self._change(plant, robot)
        for name in robot.driven if robot.adds_drives else ():
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

    def _read_limits(self, plant: MultibodyPlant, joints: list[Joint], robot: Robot) -> None:
        names = [joint.name() for joint in joints]
        kinds = {joint.name(): joint.type_name() for joint in joints}
        context = plant.CreateDefaultContext()
        defaults = plant.GetDefaultPositions()
        ranges: dict[str, tuple[float, float]] = {}
        homes: dict[str, float] = {}
        assumed: dict[str, list[str]] = {name: [] for name in names}
        for joint, default in zip(joints, defaults, strict=True):
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
            ranges[name] = (lower, upper)
            homes[name] = float(default) if lower <= default <= upper else 0.5 * (lower + upper)
            if homes[name] != default:
                self._notes.append(
                    f"{self._place(name)}: the default position {default:g} of {name} is outside its range: its home "
                    f"is {homes[name]:.4g}, in the middle"
                )
        plant.SetPositions(context, [homes[name] for name in names])
        self._check_inertia(plant, context, joints)
        weights = self._weights(plant, context, ranges, names)
        M = plant.CalcMassMatrix(context)
        efforts = {name: 0.0 for name in names}
        for index in plant.GetJointActuatorIndices():
            drive = plant.get_joint_actuator(index)
            name, limit = drive.joint().name(), drive.effort_limit()
            if self._path.suffix == ".xml" and math.isfinite(limit) and drive.default_gear_ratio() != 1.0:
                # In MuJoCo the gear multiplies the command, in Drake it does not.
                limit *= abs(drive.default_gear_ratio())
                robot.sets_efforts = True
            if not math.isfinite(limit):
                k = names.index(name)
                acceleration = _speed(joints[k]) / _TIME_TO_SPEED
                limit = _rounded_up(_WEIGHTS * weights[:, k].max() + acceleration * M[k, k])
                assumed[name].append("effort")
                robot.sets_efforts |= not robot.adds_drives
            efforts[name] = limit
        at_home = self._weights(plant, context, {name: (homes[name], homes[name]) for name in names}, names)[0]
        for name in robot.driven:
            if at_home[names.index(name)] > efforts[name]:
                self._notes.append(
                    f"{self._place(name)}: the drive of {name} cannot carry the robot at home: its limit is "
                    f"{efforts[name]:g}, the weight {at_home[names.index(name)]:.3g} (N m or N)"
                )
        result = []
        for joint in joints:
            name, speed = joint.name(), _speed(joint)
            if speed != joint.velocity_upper_limit():
                assumed[name].append("speed")
            result.append(
                RobotJoint(
                    name, kinds[name], *ranges[name], speed, efforts[name], homes[name], tuple(sorted(assumed[name]))
                )
            )
        robot.joints = tuple(result)
        by_name = {joint.name: joint for joint in result}
        robot.away = tuple(_away(by_name[name]) for name in robot.driven)
        for value in ("range", "speed", "effort"):
            if missing := [name for name in names if value in assumed[name]]:
                self._notes.append(
                    f"{self._place(missing[0])}: no limit of the {value} of {_listed(missing)}: assumed, see JOINTS in "
                    "robot.py"
                )

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
        self, plant: MultibodyPlant, scene_graph: SceneGraph, diagram: Diagram, robot: Robot
    ) -> tuple[str, ...]:
        context = diagram.CreateDefaultContext()
        plant.SetPositions(plant.GetMyMutableContextFromRoot(context), [joint.home for joint in robot.joints])
        query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
        frame_of = query.inspector().GetFrameId
        touching: set[str] = set()
        for pair in query.ComputePointPairPenetration():
            bodies = [plant.GetBodyFromFrameId(frame_of(geometry)) for geometry in (pair.id_A, pair.id_B)]
            touching.update(body.name() for body in bodies)
        if touching:
            self._notes.append(
                f"{self._shown}: {_listed(sorted(touching))} touch each other at home: their contact is left out "
                "(TOUCHING in robot.py)"
            )
        return tuple(sorted(touching))

    # -- files

    def _files(self) -> tuple[dict[Path, Path], bool]:
        """Return the files of the model by their paths in the project, and whether it refers to packages."""
        roots = _package_roots(self._path, self._text)
        sources = closure(self._path, roots)
        homeless = [path for path in sources if not any(path.is_relative_to(root) for root in roots.values())]
        top = _common_folder(homeless)
        files = {path.relative_to(top): path for path in homeless}
        for root in roots.values():
            files[Path(root.name) / "package.xml"] = root / "package.xml"
            files |= {Path(root.name) / p.relative_to(root): p for p in sources if p.is_relative_to(root)}
        return files, bool(roots)


def replace_servo(plant: MultibodyPlant, name: str) -> None:
    """Replace an actuator that has a controller by one that takes a torque or force, with the same rotor."""
    servo = plant.GetJointActuatorByName(name)
    joint, limit = servo.joint(), servo.effort_limit()
    rotor, gear = servo.default_rotor_inertia(), servo.default_gear_ratio()
    plant.RemoveJointActuator(servo)
    drive = plant.AddJointActuator(name, joint, limit)
    drive.set_default_rotor_inertia(rotor)
    drive.set_default_gear_ratio(gear)


class _Collector(logging.Handler):
    """Collects the first line of each message."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage().partition("\n")[0].replace(": warning:", ":"))


def _listed(names: object) -> str:
    return ", ".join(map(str, names))  # type: ignore[call-overload]


def _speed(joint: Joint) -> float:
    limit = float(joint.velocity_upper_limit())  # 0 is what exporters write where they know none
    return limit if math.isfinite(limit) and limit > 0.0 else _ASSUMED_SPEED[joint.type_name()]


def _rounded_up(value: float) -> float:
    """Return the next larger number with two digits."""
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit) * unit:.6g}")


def _away(joint: RobotJoint) -> float:
    """Return another position of a joint, towards its farther end."""
    end = joint.upper if joint.upper - joint.home > joint.home - joint.lower else joint.lower
    step = min(_SHARE * abs(end - joint.home), _STEP[joint.kind])
    return float(f"{joint.home + math.copysign(step, end - joint.home):.4g}")


def _mimics(text: str) -> Iterator[Coupling]:
    """Yield the couplings in a URDF (<mimic> in a joint) or SDF (<drake:mimic> in a joint)."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return
    mimic = ("mimic",) if root.tag == "robot" else ("{http://drake.mit.edu}mimic",)
    for joint in root.iter("joint"):
        for element in joint.iter():
            # Drake has no couplings for the <mimic> of SDF, only for its own.
            if element.tag in mimic and "joint" in element.attrib:
                multiplier = float(element.get("multiplier", "1"))
                yield Coupling(joint.get("name", ""), element.get("joint", ""), multiplier)


def _package_roots(path: Path, text: str) -> dict[str, Path]:
    """Return the folders of the packages that a model refers to, by name; Drake's own are not among them."""
    named = set(re.findall(r"package://([^/\"'<>\s]+)/", text)) - {"drake", "drake_models"}
    roots: dict[str, Path] = {}
    for folder in path.parents if named else ():
        for xml in (folder / "package.xml", *sorted(folder.glob("*/package.xml"))):
            match = re.search(r"<name>\s*([^<\s]+)\s*</name>", xml.read_text("utf-8")) if xml.is_file() else None
            if match and match[1] in named:
                roots.setdefault(match[1], xml.parent)
        if named <= roots.keys():
            break
    return roots


def closure(path: Path, roots: dict[str, Path]) -> list[Path]:
    """Return a model file and the files that it needs, directly or through others."""
    files, waiting = [path], [path]
    while waiting:
        for target in _references(waiting.pop(), roots):
            if target not in files:
                files.append(target)
                waiting.append(target)
    return files


def _references(path: Path, roots: dict[str, Path]) -> Iterator[Path]:
    if path.suffix.lower() not in (".urdf", ".sdf", ".xml", ".obj", ".mtl", ".gltf"):
        return
    text = path.read_text(encoding="utf-8", errors="replace")
    pattern = _OBJ_FILE if path.suffix.lower() in (".obj", ".mtl") else _QUOTED_FILE
    folders = [path.parent, *(path.parent / name for name in re.findall(r'(?:mesh|texture|asset)dir="([^"]+)"', text))]
    for name in pattern.findall(text):
        if match := re.match(r"(?:package|model)://([^/]+)/(.*)", name):
            candidates = [roots[match[1]] / match[2]] if match[1] in roots else []
        else:
            candidates = [folder / name.removeprefix("file://") for folder in folders]
        yield from (candidate.resolve() for candidate in candidates if candidate.is_file())


def _common_folder(paths: list[Path]) -> Path:
    """Return the innermost folder that holds all files."""
    parents = [path.parent for path in paths]
    folder = parents[0] if parents else Path()
    while not all(parent.is_relative_to(folder) for parent in parents):
        folder = folder.parent
    return folder
