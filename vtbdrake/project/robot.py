"""A robot as a project needs it: its joints and drives, how it stands or flies, and what its file leaves out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from vtbdrake.project.rotors import FlyingRobot
from vtbdrake.project.stance import StandingRobot

REVOLUTE = "revolute"
PRISMATIC = "prismatic"


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

    def selection(self) -> NDArray[np.float64]:
        """Return the velocities of all joints by the driven joints' velocities, shape (joints, driven)."""
        if self.motions is not None:
            return self.motions
        names = [joint.name for joint in self.joints]
        B = np.array([[float(name == driven) for driven in self.driven] for name in names])
        for coupling in self.couplings:
            B[names.index(coupling.joint), self.driven.index(coupling.leader)] = coupling.multiplier
        return B

    def change(self, plant: MultibodyPlant) -> None:
        """Make the changes in a plant of the model that this robot lists, but for the drives that are added."""
        for name, X_WB in self.welded.items():
            plant.WeldFrames(plant.world_frame(), plant.GetBodyByName(name).body_frame(), X_WB)
        for name in self.held:
            hold_joint(plant, name)
        for name in self.without_drive:
            plant.RemoveJointActuator(plant.GetJointActuatorByName(name))
        for name in self.servos:
            replace_servo(plant, name)

    def add_drives(self, plant: MultibodyPlant) -> None:
        """Add an actuator to each of the `added_drives`, in a plant with the changes of `change`."""
        for name in self.added_drives:
            plant.AddJointActuator(name, plant.GetJointByName(name))


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
