"""Which joints of a model file a project drives, which follow others, and which are held."""

from __future__ import annotations

import re
from collections.abc import Iterator

from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint

from vtbdrake.project.model_copy import URDF
from vtbdrake.project.parser import ModelParser
from vtbdrake.project.robot import PRISMATIC, REVOLUTE, Coupling, ProjectRobot, RobotFileError
from vtbdrake.project.xml_text import XmlText

# A weight in N that a joint of the base does not carry, so that the base falls.
_FALLS = 1e-3
# A joint that would need more than this time to cross its range, for its damping, counts as fixed, in s.
_LONGEST_RANGE = 100.0


def measured_joints(parser: ModelParser, plant: MultibodyPlant) -> list[Joint]:
    """Return the joints with one degree of freedom, in the order of the plant's positions.

    Args:
        parser: The model file.
        plant: The model, finalized.

    Raises:
        RobotFileError: There are none, some have more degrees of freedom, or several have one name.
    """
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    bases = {int(index) for index in plant.GetFloatingBaseBodies()}
    free = {joint.name() for joint in joints if int(joint.child_body().index()) in bases}
    moving = [joint for joint in joints if joint.num_positions() and joint.name() not in free]
    for joint in moving:
        if joint.type_name() not in (REVOLUTE, PRISMATIC):
            raise RobotFileError(
                f"{parser.place(joint.name())}: the joint {joint.name()} is {joint.type_name()}, but only revolute "
                "and prismatic joints are measured and driven: replace it by several of these, or fix it"
            )
    if not moving:
        raise RobotFileError(
            f"{parser.shown} has no joints to drive: its links are fixed to each other, or move freely. It is an "
            "object, not a robot; add it to the world of a scenario (Parser(plant).AddModels in add_world). "
            "A drone is known by motors at sites, bodies named rotor or propeller, or its own name"
        )
    names = [joint.name() for joint in moving]
    if twins := sorted({name for name in names if names.count(name) > 1}):
        raise RobotFileError(
            f"{parser.place(twins[0])}: several joints are named {', '.join(twins)}; give each joint its own name"
        )
    return sorted(moving, key=lambda joint: int(joint.position_start()))


def falling_base(parser: ModelParser, plant: MultibodyPlant, joints: list[Joint]) -> tuple[str, ...]:
    """Return the joints between the world and the first drive, if none of them carries the robot's weight.

    Such a base moves in a plane, as simulated walkers' do; it is held, as free bases without a stance are welded.

    Args:
        parser: The model file; its notes are added to.
        plant: The model, finalized.
        joints: The joints that are measured.
    """
    drives = {plant.get_joint_actuator(index).joint().name() for index in plant.GetJointActuatorIndices()}
    drives.update(_transmitted(parser, joints))
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
    base_joints = tuple(joint.name() for joint in base)
    parser.notes.append(
        f"{parser.place(base_joints[0])}: no actuator carries {', '.join(base_joints)} of the base, which would fall: "
        "they are held at home (hold_joint in robot.py)"
    )
    return base_joints


def choose_drives(parser: ModelParser, plant: MultibodyPlant, joints: list[Joint], robot: ProjectRobot) -> None:
    """Set which joints of ``robot`` have drives, which follow others, and which actuators of the file are replaced.

    Args:
        parser: The model file; its notes are added to.
        plant: The model, finalized.
        joints: The joints that are measured.
        robot: The robot, which learns its drives and couplings.

    Raises:
        RobotFileError: Nothing is driven, or a joint has several actuators.
    """
    names = {joint.name() for joint in joints}
    couplings = [c for c in _mimics(parser.copy.xml) if c.joint in names and c.leader in names]
    followers = {coupling.joint for coupling in couplings}
    drives = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    controlled = [drive for drive in drives if drive.has_controller()]
    robot.servos = tuple(drive.name() for drive in controlled if drive.joint().name() not in followers)
    if robot.servos:
        parser.notes.append(
            f"{parser.place(robot.servos[0])}: the actuators {', '.join(robot.servos)} control positions or "
            "velocities; the DPS commands torques or forces instead"
        )
    driven_by_drake = {drive.joint().name() for drive in drives}
    transmitted = [name for name in _transmitted(parser, joints) if name not in followers | driven_by_drake]
    robot.added_drives = tuple(transmitted)
    if transmitted:
        parser.notes.append(
            f"{parser.place(transmitted[0])}: Drake leaves out the <transmission> of {', '.join(transmitted)}, which "
            "has several joints or a type of its own: each of them gets a drive of its own"
        )
    if not drives and not transmitted:
        parser.notes.append(
            f"{parser.shown} has no actuators (a <transmission> in URDF, an <effort> in SDF, a <motor> in MJCF): "
            "every joint gets one (take those that move freely out of DRIVEN in robot.py)"
        )
        robot.added_drives = tuple(joint.name() for joint in joints if joint.name() not in followers)
    joints_with_drive = [drive.joint().name() for drive in drives] + [*robot.added_drives]
    robot.without_drive = tuple(drive.name() for drive in drives if drive.joint().name() in followers)
    driven = [name for name in joints_with_drive if name not in followers]
    if twins := sorted({name for name in driven if driven.count(name) > 1}):
        raise RobotFileError(f"{parser.place(twins[0])}: the joint {twins[0]} has several actuators; give it one")
    if not driven:
        raise RobotFileError(f"{parser.shown} has no joints to drive: those with actuators follow other joints")
    robot.couplings = tuple(coupling for coupling in couplings if coupling.leader in driven)
    for coupling in robot.couplings:
        parser.notes.append(
            f"{parser.place(coupling.joint)}: {coupling.joint} follows {coupling.leader}, whose drive moves both"
        )
    passive = [j.name() for j in joints if j.name() not in driven and j.name() not in followers]
    if passive:
        parser.notes.append(
            f"{parser.place(passive[0])}: no actuator of {', '.join(passive)}, which moves freely: measured, but not "
            "controlled. Give it an actuator in the file if it has a drive"
        )


def stuck_joints(robot: ProjectRobot) -> tuple[str, ...]:
    """Return the joints without an actuator in the file that damping holds: authors write it for a fixed joint."""
    stuck = tuple(
        joint.name
        for joint in robot.joints
        if joint.name in robot.added_drives and joint.upper - joint.lower > _LONGEST_RANGE * joint.speed
    )
    return stuck if len(stuck) < len(robot.driven) else ()


def _transmitted(parser: ModelParser, joints: list[Joint]) -> list[str]:
    """Return the joints that the transmissions of a URDF name, also transmissions that Drake leaves out.

    A differential has two joints, and some types have tags of their own, such as ``<flexJoint>``.
    """
    xml, moving = parser.copy.xml, {joint.name() for joint in joints}
    transmissions = xml.root.iter("transmission") if xml is not None and xml.root.tag == URDF else ()
    tags = [part for transmission in transmissions for part in transmission.iter()]
    names = [tag.get("name") for tag in tags if re.search("^(?!passive).*joint$", tag.tag, re.IGNORECASE)]
    return [name for name in dict.fromkeys(names) if name in moving]


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
