"""The limits of a robot's joints: what its file states, and what is assumed where it states nothing."""

from __future__ import annotations

import math
from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint
from pydrake.systems.framework import Context

from vtbdrake.project.model_copy import MJCF, URDF, ModelCopy
from vtbdrake.project.parser import ModelParser
from vtbdrake.project.robot import PRISMATIC, REVOLUTE, ProjectRobot, RobotFileError, RobotJoint
from vtbdrake.project.xml_text import XmlText

# What is assumed where a file says nothing, by the kind of joint: in rad or m, and per second.
_ASSUMED_REACH = {REVOLUTE: 2.0 * math.pi, PRISMATIC: 1.0}
_ASSUMED_SPEED = {REVOLUTE: 3.0, PRISMATIC: 0.5}
# An assumed drive carries the weight multiplied by this number.
_WEIGHTS = 2.0
# Beside the weight, an assumed drive accelerates to its speed within this time, in s.
_TIME_TO_SPEED = 0.02
# The share of the effort of a drive that the damping of its joint takes at most, at the speed of the reference.
_DAMPED = 0.5


def read_limits(parser: ModelParser, plant: MultibodyPlant, joints: list[Joint], robot: ProjectRobot) -> list[str]:
    """Set ``robot.joints`` with their ranges, speeds, efforts and homes, and say what is assumed of them.

    Args:
        parser: The model file; its notes are added to.
        plant: The plant of the project's world, finalized.
        joints: The joints that it measures.
        robot: The robot with its drives; it learns whether the project must set the limits of some.

    Returns:
        Notes on homes, which do not matter where a robot stands in another posture.

    Raises:
        RobotFileError: A range is empty, or what a joint moves has no inertia.
    """
    names = [joint.name() for joint in joints]
    assumed: dict[str, list[str]] = {name: [] for name in names}
    ranges = {joint.name(): _range(parser, joint, assumed) for joint in joints}
    defaults = plant.GetDefaultPositions()
    homes, notes_on_homes = {}, []
    for name, default in zip(names, map(float, defaults), strict=True):
        lower, upper = ranges[name]
        homes[name] = default if lower <= default <= upper else 0.5 * (lower + upper)
        if homes[name] != default:
            notes_on_homes.append(
                f"{parser.place(name)}: the default position {default:g} of {name} is outside its range: its home "
                f"is {homes[name]:.4g}, in the middle"
            )
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, [homes[name] for name in names])
    _check_inertia(parser, plant, context, joints)
    efforts = _efforts(parser, plant, context, joints, robot, ranges=ranges, assumed=assumed)
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
        parser.notes.append(
            f"{parser.shown}: at the speed limit, the damping of joints takes more than half of the effort of their "
            f"drives; the speeds (rad/s or m/s) are therefore {', '.join(damped)}"
        )
    robot.joints = tuple(result)
    robot.assumptions += _assumptions(parser, result)
    return notes_on_homes


def _range(parser: ModelParser, joint: Joint, assumed: dict[str, list[str]]) -> tuple[float, float]:
    """Return the range of a joint; what the file does not state is noted as assumed."""
    name, reach = joint.name(), _ASSUMED_REACH[joint.type_name()]
    lower, upper = float(joint.position_lower_limit()), float(joint.position_upper_limit())
    if not (math.isfinite(lower) and math.isfinite(upper)):
        assumed[name].append("range")
        lower, upper = max(lower, -reach), min(upper, reach)
    if not lower < upper:
        raise RobotFileError(
            f"{parser.place(name)}: the range of {name} is empty, {lower:g} to {upper:g}: give it a lower and "
            "an upper limit, or make it a fixed joint"
        )
    return lower, upper


def _efforts(
    parser: ModelParser,
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
        parser: The model file.
        plant: The robot.
        context: A context of it, at home.
        joints: Its joints.
        robot: It learns whether the project must set the limits of its drives.
        ranges: Range of each joint.
        assumed: Names of the limits that the file does not state, by joint.
    """
    names = [joint.name() for joint in joints]
    weights = _weights(plant, context, ranges, names)
    M = plant.CalcMassMatrix(context)
    efforts = {name: 0.0 for name in names}
    stated = _stated_efforts(parser.copy.xml, parser.copy.included)
    forces = {name: force for name, force in _forces(parser.copy).items() if name in robot.servos}
    for index in plant.GetJointActuatorIndices():
        drive = plant.get_joint_actuator(index)
        name, limit = drive.joint().name(), drive.effort_limit()
        if parser.path.suffix == ".xml" and math.isfinite(limit) and drive.default_gear_ratio() != 1.0:
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


def _assumptions(parser: ModelParser, joints: list[RobotJoint]) -> list[str]:
    """Return a sentence for each kind of limit that the file does not state for every joint."""
    sentences = []
    for value in ("effort", "speed", "range"):
        if missing := [joint for joint in joints if value in joint.assumed]:
            values = ", ".join(f"{joint.name} {_limit(joint, value)}" for joint in missing)
            sentences.append(
                f"{parser.place(missing[0].name)} gives no limit of the {value}, assumed is {values}: compare "
                "JOINTS in robot.py with the data sheet"
            )
    return sentences


def _check_inertia(parser: ModelParser, plant: MultibodyPlant, context: Context, joints: list[Joint]) -> None:
    M = plant.CalcMassMatrix(context)
    values, vectors = np.linalg.eigh(M)
    if values[0] > 1e-12 * values[-1] and np.isfinite(M).all():
        return
    k = int(np.argmax(np.abs(vectors[:, 0])))
    joint = joints[k]
    link = joint.child_body().name()
    raise RobotFileError(
        f"{parser.place(link)}: nothing that the joint {joint.name()} moves has inertia, so that any torque would "
        f"accelerate it infinitely: give the link {link} an <inertial> with a mass and moments of inertia"
    )


def _weights(
    plant: MultibodyPlant, context: Context, ranges: dict[str, tuple[float, float]], names: list[str]
) -> NDArray[np.float64]:
    """Return the absolute torques of gravity in some postures within the ranges, shape (postures, joints)."""
    moved, random = context.Clone(), np.random.default_rng(0)
    lower, upper = np.transpose([ranges[name] for name in names])
    weights = []
    for share in (0.5, *random.uniform(size=(200, len(names)))):
        plant.SetPositions(moved, lower + share * (upper - lower))
        weights.append(np.abs(plant.CalcGravityGeneralizedForces(moved)))
    return np.array(weights)


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
