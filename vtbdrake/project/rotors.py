"""The rotors of a robot that flies, from the thrust sites of a MJCF file or the names of its bodies."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context

from vtbdrake.project.stance import lowest_point, parsed

# What drones are called, in the file's name or in the robot's.
_DRONE = re.compile(r"quad_?rotor|quad_?copter|multi_?rotor|hexa_?copter|octo_?copter|drone|(?:^|_)uav|crazyflie", re.I)
# What bodies of rotors are called.
_ROTOR = re.compile(r"rotor_?\d|propell?er|(?:^|_)prop_?\d", re.I)
# The fewest rotors with which a robot hovers.
_LEAST_ROTORS = 4
# What is assumed where a file says nothing: all rotors together carry the weight multiplied by this number,
_WEIGHTS = 2.0
# and a thrust of 1 N turns the drone against its rotor with this moment in N m, as Drake's examples have it.
_MOMENT = 0.0245
# Four rotors that a file does not place are this far from the middle, in radii of gyration about the vertical axis.
_ARM = 2.5
# A base lies at least this high on the ground, in m.
_LEAST_HEIGHT = 0.02


@dataclass(frozen=True)
class Rotor:
    """A rotor that pushes its base upwards, along the base's z-axis.

    Attributes:
        name: What the file calls it.
        position: Where, in the frame of the base in m, shape (3,).
        moment: The moment about the base's z-axis by which it turns the base, in N m for each N of thrust.
        most: Its largest thrust in N.
    """

    name: str
    position: NDArray[np.float64]
    moment: float
    most: float


@dataclass(frozen=True)
class FlyingRobot:
    """How a robot with a free base flies.

    Attributes:
        base: Name of the body that the rotors push.
        rotors: Its rotors.
        height: How far its lowest point lies below the origin of the base, in m.
        assumptions: What the file does not say about the rotors, with what is assumed.
    """

    base: str
    rotors: tuple[Rotor, ...]
    height: float
    assumptions: tuple[str, ...]


def flying_robot(
    path: Path, text: str, plant: MultibodyPlant, inspector: SceneGraphInspector, context: Context
) -> FlyingRobot | None:
    """Return the rotors of a robot and the body that they push, or None if it has no rotors.

    Args:
        path: Its model file.
        text: The text of the file.
        plant: The robot, finalized.
        inspector: What knows its geometries.
        context: A context of the plant, in its default state.
    """
    bases = [plant.get_body(index) for index in plant.GetFloatingBaseBodies()]
    if len(bases) != 1:
        return None
    base = bases[0]
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    turning = [joint for joint in joints if joint.num_velocities() and joint.child_body().name() != base.name()]
    if any(not _ROTOR.search(joint.child_body().name()) for joint in turning):
        return None
    mass = plant.CalcTotalMass(context)
    weight = mass * float(np.linalg.norm(plant.gravity_field().gravity_vector()))
    plant.SetFreeBodyPose(context, base, RigidTransform())
    height = max(-(lowest_point(plant, inspector, context) or 0.0), _LEAST_HEIGHT)
    if len(sites := list(_thrust_sites(text, base.name()))) >= _LEAST_ROTORS:
        most = _WEIGHTS * weight / len(sites)
        rotors = tuple(Rotor(name, p, moment, limit or most) for name, p, moment, limit in sites)
        missing = [rotor.name for rotor, site in zip(rotors, sites, strict=True) if not site[3]]
        sentence = f"gives no ctrlrange of {', '.join(missing)}: assumed is a thrust of at most {most:.3g} N each"
        return FlyingRobot(base.name(), rotors, height, (sentence,) if missing else ())
    bodies = [body for body in _bodies(plant) if _ROTOR.search(body.name())]
    if len(bodies) >= _LEAST_ROTORS:
        X_WB = plant.EvalBodyPoseInWorld(context, base)
        places = [X_WB.InvertAndCompose(plant.EvalBodyPoseInWorld(context, body)).translation() for body in bodies]
        rotors = _alternating([body.name() for body in bodies], np.array(places), weight)
        sentence = "says of the rotors where they are only"
    elif not turning and _DRONE.search(f"{path.stem} {plant.GetModelInstanceName(base.model_instance())}"):
        inertia = plant.CalcSpatialInertia(context, base.body_frame(), [body.index() for body in _bodies(plant)])
        gyration = math.sqrt(inertia.CalcRotationalInertia().get_moments()[2] / mass)
        angles = 0.25 * math.pi + 0.5 * math.pi * np.arange(4)
        places = [_ARM * gyration * np.array([math.cos(angle), math.sin(angle), 0.0]) for angle in angles]
        rotors = _alternating([f"rotor_{k}" for k in range(4)], np.array(places), weight)
        sentence = f"has no rotors: assumed are four, {_ARM * gyration:.3g} m from the middle"
    else:
        return None
    numbers = f"a thrust of at most {rotors[0].most:.3g} N, and a moment of {_MOMENT:g} N m for each N, in turns"
    return FlyingRobot(base.name(), rotors, height, (f"{sentence}; assumed for each is {numbers}",))


def _bodies(plant: MultibodyPlant) -> list[RigidBody]:
    return [plant.get_body(BodyIndex(k)) for k in range(1, plant.num_bodies())]


def _alternating(names: list[str], places: NDArray[np.float64], weight: float) -> tuple[Rotor, ...]:
    """Return rotors that turn in turns around their middle."""
    middle = places - places.mean(axis=0)
    order = np.argsort(np.arctan2(middle[:, 1], middle[:, 0])).tolist()
    most = float(f"{_WEIGHTS * weight / len(names):.3g}")
    return tuple(
        Rotor(name, place, _MOMENT * (-1.0) ** order.index(k), most)
        for k, (name, place) in enumerate(zip(names, places, strict=True))
    )


def _thrust_sites(text: str, base: str) -> Iterator[tuple[str, NDArray[np.float64], float, float]]:
    """Yield name, position (m), moment (N m per N) and largest thrust (N, or 0) of the motors at sites of a base."""
    root = parsed(text)
    if root is None or root.tag != "mujoco":
        return
    bodies = [body for world in root.iter("worldbody") for body in world.iter("body")]
    sites = {site.get("name", ""): site for body in bodies if body.get("name") == base for site in body.findall("site")}
    ranges = {
        default.get("class", ""): motor.get("ctrlrange", "")
        for default in root.iter("default")
        for motor in default.findall("motor")
    }
    for motor in [motor for actuators in root.iter("actuator") for motor in actuators.findall("motor")]:
        gear = np.array([float(value) for value in motor.get("gear", "1").split()] + [0.0] * 6)[:6]
        site = sites.get(motor.get("site", ""))
        if site is None or gear[2] == 0.0 or gear[[0, 1, 3, 4]].any():
            continue
        place = np.array([float(value) for value in site.get("pos", "0 0 0").split()])
        ends = motor.get("ctrlrange") or ranges.get(motor.get("class", ""), "")
        most = float(ends.split()[1]) * gear[2] if ends else 0.0
        yield motor.get("name", motor.get("site", "")), place, float(gear[5] / gear[2]), float(most)
